"""The trained model of a run folder, ready to render: with motion where that stage ran, else at rest."""

from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera
from devrf.reconstruct.evaluate import Render


def model_files(run_dir: Path) -> list[Path]:
    """The files a viewer needs: the canonical model and, where there are any, the motion's."""
    return [path for name in ("canonical", "deformation") for path in (run_dir / name).glob("*.safetensors")]


def load_renderer(run_dir: Path, device: str) -> Render:
    """`render(camera, time)` of the run's model; cameras are in the box frame."""
    from devrf.reconstruct.model import render_view
    from devrf.reconstruct.model_io import load_model

    model = load_model(run_dir, device)

    def render(camera: Camera, time: float | None) -> np.ndarray:
        return render_view(model, camera, time)

    return render
