"""The trained model of a run folder, ready to render: with motion where that stage ran, else at rest."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devrf.capture.camera import Camera
from devrf.reconstruct.evaluate import Render

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.model import DynamicModel


def model_files(run_dir: Path) -> list[Path]:
    """The files a viewer needs: the canonical model and, where there are any, the motion's."""
    return [path for name in ("canonical", "deformation") for path in (run_dir / name).glob("*.safetensors")]


def load_trained(run_dir: Path, device: str) -> "DynamicModel":
    """The run's model, on cpu or cuda."""
    from devrf.reconstruct.model_io import load_model

    return load_model(run_dir, device)


def renderer(model: "DynamicModel") -> Render:
    """`render(camera, time)` of a model; cameras are in the box frame."""
    from devrf.reconstruct.model import render_view

    def render(camera: Camera, time: float | None) -> np.ndarray:
        return render_view(model, camera, time)

    return render
