"""Render a data set by the DeVRF paper's protocol: a model at rest from all around, then in motion for fixed cameras.

`simulate_dataset` writes the published inward layout and the exact truth:

    static/{train,val,test}/r_NNN.png, transforms_{train,val,test}.json      at rest (time 0)
    dynamic_<N>views/{train,val,test}/r_NNN.png, transforms_....json         times 0 to 1
    dynamic_<N>views/train_flow/NNN_bwd.npz, train_depth/NNN.npz             of the training pictures
    scene.yaml, made_by.json

Training pictures are listed time-major (all views of the first time, then of the second), their files are
numbered camera by camera. Flow and depth carry the number of the picture in that list. The first cameras of
a set are the same whatever their number, and so are its test views.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.formats import FLIP_YZ
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions, ForwardOptions
from devrf.lab.simulate.render.filmed import MomentCache
from devrf.lab.simulate.render.folder import OutputFolder
from devrf.lab.simulate.render.studio import Studio
from devrf.lab.simulate.scenes.models import MODELS
from devrf.lab.simulate.scenes.simulation import Simulation

RADIUS = 4.0  # of the cameras' hemisphere; the models stay within 1.35 of its centre
ANGLE = 0.6911112  # of view over the picture's shorter side, radians; Blender's for the NeRF data sets
VALIDATION_VIEWS = 2
# Azimuth and elevation of the fixed cameras, degrees: four all around, then four between them.
PLACES = ((-60, 28), (30, 40), (120, 24), (210, 36), (-15, 55), (165, 50), (75, 20), (255, 30))
PLACE_JITTER_DEG = 6.0


@dataclass(frozen=True)
class Made:
    """What was made: the scene.yaml, and how many pictures were rendered for it now."""

    scene_yaml: Path
    rendered: int


@dataclass(frozen=True)
class _Shot:
    """One picture: its file without ending, relative to the data set; where and when it is taken."""

    name: str
    camera: Camera
    moment: int


def simulate_dataset(
    out: Path, simulation: Simulation[DatasetOptions], *, progress: Progress = no_progress
) -> Made:
    """Render a data set with known truth, or go on with one that was begun for the same simulation.

    Args:
        out: Folder to write: new, empty, or begun earlier.
        simulation: Of a scene out of `MODELS`, with 1 to 8 cameras.
        progress: Told after every picture.
    Raises:
        InputError: Unknown scene, bad numbers, folder that holds something else, or mitsuba not installed.
    """
    check_simulation("devrf", simulation, len(PLACES))
    folder = OutputFolder(out, made_by("devrf", simulation))
    scene, cameras, seed, size = simulation.scene, simulation.cameras, simulation.seed, simulation.size
    options = simulation.options
    path = out / "scene.yaml"
    if folder.complete:
        return Made(path, 0)
    times = np.linspace(0, 1, options.times)
    model = MODELS[scene].build(np.random.default_rng([seed, 0]), options.motion_scale)
    film = MomentCache(Studio(options.spp), model, times)
    folder.begin()
    dynamic = f"dynamic_{cameras}views"
    fixed = [_fixed_camera(seed, i, size) for i in range(cameras)]
    digits = max(3, len(str(cameras * options.times - 1)))
    train = [
        _Shot(f"{dynamic}/train/r_{view * options.times + moment:0{digits}d}", camera, moment)
        for moment in range(options.times)
        for view, camera in enumerate(fixed)
    ]
    per_time = options.test_views_per_time
    moments = [i // per_time for i in range(options.times * per_time)]
    splits = {
        "static/train": _around(seed, size, "static/train", [0] * options.static_views),
        "static/val": _around(seed, size, "static/val", [0] * VALIDATION_VIEWS),
        "static/test": _around(seed, size, "static/test", [0] * options.static_test_views),
        f"{dynamic}/train": train,
        f"{dynamic}/val": _around(seed, size, f"{dynamic}/val", [0] * VALIDATION_VIEWS),
        f"{dynamic}/test": _around(seed, size, f"{dynamic}/test", moments),
    }
    number = {shot.name: i for i, shot in enumerate(train)}
    rendered = done = 0
    shots = sorted((shot for split in splits.values() for shot in split), key=lambda shot: shot.moment)
    for shot in shots:
        file = f"{shot.name}.png"
        if not folder.has(file):
            sample_seed = folder.seed_of(file.replace(dynamic, "dynamic"))  # the same with more cameras
            folder.picture(file, film.stage(shot.moment).picture(shot.camera, sample_seed))
            rendered += 1
        if shot.name in number:
            n = f"{number[shot.name]:0{digits}d}"
            view = f"view{number[shot.name] % cameras}"
            depth, flow = f"{dynamic}/train_depth/{n}.npz", f"{dynamic}/train_flow/{n}_bwd.npz"
            film.write_truth(folder, shot.moment, view, shot.camera, depth, flow)
        done += 1
        progress(done / len(shots), f"{file}: picture {done} of {len(shots)}")
    for split, listed in splits.items():
        part, name = split.split("/")
        folder.text(f"{part}/transforms_{name}.json", _transforms(listed, part, times))
    folder.text("scene.yaml", scene_yaml(scene, "devrf"))
    folder.finish()
    return Made(path, rendered)


def made_by(
    protocol: str, simulation: Simulation[DatasetOptions] | Simulation[ForwardOptions]
) -> dict[str, Any]:
    """What is written beside a data set, and compared before it is gone on with."""
    how = {name: getattr(simulation, name) for name in ("scene", "seed", "cameras", "size")}
    return {"protocol": protocol, **how, "options": simulation.options.model_dump(mode="json")}


def check_simulation(
    protocol: str, simulation: Simulation[DatasetOptions] | Simulation[ForwardOptions], most_cameras: int
) -> None:
    """Refuse what no data set can be made of.

    Raises:
        InputError: Unknown scene, a picture too small or too large, too few or too many cameras.
    """
    scene, cameras, size = simulation.scene, simulation.cameras, simulation.size
    if scene not in MODELS:
        expected = f"expected one of {', '.join(MODELS)} (--protocol {protocol})"
        text = f"simulate --scene {scene}: unknown scene, {expected}"
        raise InputError("scene-unknown", text)
    if not 1 <= cameras <= most_cameras:
        text = f"simulate --cameras {cameras}: expected 1 to {most_cameras} (--protocol {protocol})"
        raise InputError("option-out-of-range", text)
    if not all(16 <= n <= 4096 for n in size):
        text = f"simulate --size {size[0]}x{size[1]}: expected 16 to 4096 pixels each way"
        raise InputError("option-out-of-range", text)


def lens(size: tuple[int, int]) -> np.ndarray:
    """K [3, 3] of every camera: `ANGLE` over the shorter side, the principal point in the middle."""
    focal = min(size) / 2 / np.tan(ANGLE / 2)
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])


def scene_yaml(scene: str, dataset_format: str) -> str:
    """A configuration that runs the data set beside it."""
    return f"name: {scene}\ndataset: {{format: {dataset_format}, path: .}}\n"


def _fixed_camera(seed: int, number: int, size: tuple[int, int]) -> Camera:
    rng = np.random.default_rng([seed, 1, number])
    return _camera(size, *(np.array(PLACES[number]) + PLACE_JITTER_DEG * rng.uniform(-1, 1, 2)))


def _around(seed: int, size: tuple[int, int], split: str, moments: Sequence[int]) -> list[_Shot]:
    """Pictures from random places, evenly spread over the upper hemisphere."""
    # By what is shown, not by the folder's name, so that sets with more cameras have the same test views.
    key = [int(split.startswith("static")), ("train", "val", "test").index(split.split("/")[1])]
    rng = np.random.default_rng([seed, 2, *key])
    digits = max(3, len(str(len(moments) - 1)))
    shots = []
    for i, moment in enumerate(moments):
        azimuth, height = rng.uniform(0, 360), rng.uniform(0.04, 0.97)
        camera = _camera(size, azimuth, float(np.degrees(np.arcsin(height))))
        shots.append(_Shot(f"{split}/r_{i:0{digits}d}", camera, moment))
    return shots


def _camera(size: tuple[int, int], azimuth_deg: float, elevation_deg: float) -> Camera:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    position = RADIUS * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return Camera(*size, lens(size), look_at(position, np.zeros(3)))


def _transforms(shots: Sequence[_Shot], part: str, times: np.ndarray) -> str:
    camera = shots[0].camera
    frames = [
        {
            "file_path": "." + shot.name[len(part) :],
            "time": float(times[shot.moment]),
            "transform_matrix": (shot.camera.world_from_cam @ FLIP_YZ).tolist(),
        }
        for shot in shots
    ]
    angle_x = 2 * float(np.arctan(camera.width / 2 / camera.K[0, 0]))
    return json.dumps({"camera_angle_x": angle_x, "frames": frames}, indent=1) + "\n"
