"""A run folder with a scene and a trained model, written without a run: what exports of the model read."""

from pathlib import Path

import cv2
import numpy as np
import yaml
from tests.make.models import AABB, moving_ball
from tests.make.scenes import scene_of
from tests.reconstruct.conftest import around, look_at

from devrf.capture.formats import write_scene
from devrf.capture.scene import PosedFrame
from devrf.pipelines.stamps.stamp import STAMP
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.storage.model_io import FILE, save_deformation, save_rest

SCALE = 2.0  # box units in a metre


def write_trained(folder: Path, *, moves: bool = True, model: DynamicModel | None = None) -> Path:
    """Write `scene.yaml` and a finished run of the moving ball (or of one at rest) into a folder.

    Args:
        folder: Where.
        moves: Something moves.
        model: Another one than the ball, in the same box.
    Returns:
        scene.yaml.
    """
    run, model = folder / "run", model or moving_ball()
    picture = run / "grey.png"
    picture.parent.mkdir(parents=True)

    def frame(name: str, n: int, eye: np.ndarray, time: float | None) -> PosedFrame:
        camera = look_at(eye).scaled(2.0)
        cv2.imwrite(str(picture), np.full((camera.height, camera.width, 3), 128, np.uint8))
        return PosedFrame(
            picture, camera.moved(np.diag([1 / SCALE] * 3 + [1.0])), name, n, time, time, "train"
        )

    sweep = [frame("static", n, eye, None) for n, eye in enumerate(around(8, 0.0, 0.4))]
    fixed = [frame(f"cam{c}", n, eye, n / 2) for c, eye in enumerate(around(3, 0.5, 0.3)) for n in range(3)]
    box = {"aabb": AABB.double().numpy(), "near": 0.3, "far": 9.0, "background": "white", "metric": True}
    scene = scene_of(sweep, fixed if moves else (), SCALE, **box)
    write_scene(run / "scene", scene)
    (run / "canonical").mkdir()
    save_rest(run / "canonical" / FILE, model.rest)
    if moves:
        (run / "deformation").mkdir()
        save_deformation(run / "deformation", model)
    for stage in run.iterdir():
        if stage.is_dir():
            (stage / STAMP).write_text("{}")
    value = {
        "name": "ball <1>",
        "output": "run",
        "preset": "tiny",
        "dataset": {"format": "nerfstudio", "path": "data"},
    }
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(value))
    return path


def boxed_model() -> DynamicModel:
    """The model of `write_trained`, for cameras in its box frame."""
    return moving_ball()
