"""The trained model of a run folder, ready to render: with motion where that stage ran, else at rest."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devrf.capture.camera import Camera
from devrf.reconstruct.evaluate import Render

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.model import DynamicModel

PIECES = 8  # where memory is short, rays are rendered in parts as small as an eighth of the usual number


def model_files(run_dir: Path) -> list[Path]:
    """The files a viewer needs: the canonical model and, where there are any, the motion's."""
    return [path for name in ("canonical", "deformation") for path in (run_dir / name).glob("*.safetensors")]


def load_trained(run_dir: Path, device: str, pieces: int | None = None) -> "DynamicModel":
    """The run's model.

    Args:
        run_dir: The run folder.
        device: cpu or cuda.
        pieces: How many of `PIECES` parts of the rays that are usually rendered at once; None: all.
    """
    from devrf.reconstruct.model_io import load_model
    from devrf.reconstruct.options import CHUNK

    model = load_model(run_dir, device)
    model.chunk = CHUNK * (pieces or PIECES) // PIECES
    return model


def renderer(model: "DynamicModel") -> Render:
    """`render(camera, time)` of a model; cameras are in the box frame."""
    from devrf.reconstruct.model import render_view

    def render(camera: Camera, time: float | None) -> np.ndarray:
        return render_view(model, camera, time)

    return render


def load_renderer(run_dir: Path, device: str, pieces: int | None = None) -> Render:
    """Both; arguments as `load_trained`'s."""
    return renderer(load_trained(run_dir, device, pieces))
