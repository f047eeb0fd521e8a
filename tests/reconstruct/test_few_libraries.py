"""Training, rendering and evaluation need no vision, video, viewer or console library."""

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
ABSENT = (
    "cv2", "av", "pycolmap", "viser", "rawpy", "rich", "typer", "yaml", "matplotlib", "mitsuba", "ray",
)  # fmt: skip
BLOCK = f"import sys\nfor name in {ABSENT!r}: sys.modules[name] = None\n"
WORK = """
from pathlib import Path
import numpy as np
from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import write_png, to_8_bits
from devrf.capture.view_axes import look_at
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.evaluation.evaluate import LpipsNets, evaluate
from devrf.reconstruct.geometry.paths import orbit
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.film.times import film_times
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.options import CanonicalOptions, MotionOptions
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

folder = Path(sys.argv[1])
REST = CanonicalOptions(
    resolution=16, iterations=3, rays=128, samples=2048, channels=3, mlp_width=8, scale_at=(0.5,),
    hull_resolution=16, occupancy_every=2, alpha_threshold=1e-5, weight_threshold=1e-5,
)
MOTION = MotionOptions(levels=(2, 4), iterations=(2, 2), rays=64, importance=0.7, most_keys=3)


def frame(name, index, angle, time, split):
    eye = 3 * np.array([np.cos(angle), np.sin(angle), 0.3])
    camera = Camera(32, 24, np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), look_at(eye, np.zeros(3)))
    picture = np.full((24, 32, 4), (200, 90, 30, 0), np.uint8)
    left = 8 + int(4 * (time or 0))
    picture[6:18, left : left + 14, 3] = 255
    path = folder / f"{name}{index}.png"
    write_png(path, picture)
    return PosedFrame(path, camera, name, index, time, time, split)


scene = Scene(
    static=tuple(frame("static", n, 0.8 * n, None, "test" if n == 3 else "train") for n in range(8)),
    dynamic=tuple(
        frame(f"cam{c}", n, 2.1 * c, n / 2, "test" if c == 2 else "train") for c in range(3) for n in range(3)
    ),
    box_from_world=np.eye(4), aabb=np.array([[-1.0] * 3, [1.0] * 3]), near=0.5, far=6.0, kind="inward",
    background="white", t0_s=0.0, t1_s=1.0, rest_time=0.0, image_scale=0.75,
)
rest = train_canonical(scene, REST)
motion, _ = train_motion(scene, rest, {}, MOTION)
model = DynamicModel(rest, motion)
render = lambda camera, time: render_view(model, camera, time)
scores = evaluate(scene, render, LpipsNets.load(None), folder / "out")
assert scores["test"]["views"] == 3 and 0 < scores["test"]["psnr"] < 60, scores
assert len(list((folder / "out").rglob("*_error.png"))) == 4
cameras = film_cameras(scene)
path = orbit(cameras, scene.aabb, 2, film_lens(cameras, 400))
for camera, time in zip(path, film_times(scene, 2), strict=True):
    assert to_8_bits(render(camera, time)).any()
"""


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BLOCK + program, *arguments], capture_output=True, text=True, timeout=600
    )


@pytest.mark.full
def test_every_module_is_imported_without_them() -> None:
    files = sorted((REPOSITORY / "reconstruct").rglob("*.py"))
    names = [".".join(("devrf", *f.relative_to(REPOSITORY).with_suffix("").parts)) for f in files]
    names = [name.removesuffix(".__init__") for name in names]
    result = run("import importlib\n" + "".join(f"importlib.import_module({name!r})\n" for name in names))
    assert len(names) > 20 and result.returncode == 0, result.stderr


@pytest.mark.full
def test_a_scene_is_learned_rendered_and_evaluated_without_them(tmp_path: Path) -> None:
    result = run(WORK, str(tmp_path))
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("statement", ["import cv2", "from rich.console import Console", "import av"])
def test_the_block_holds(statement: str) -> None:
    result = run(statement)
    assert result.returncode != 0 and "ModuleNotFoundError" in result.stderr
