"""A finished run whose model is made by hand: a coloured ball before white that moves along a straight line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from PIL import Image
from tests.make.models import canonical, straight
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.formats import write_scene
from devrf.capture.scene import PosedFrame, Scene, Split
from devrf.capture.view_axes import look_at
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.movers import Movers
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.storage.model_io import FILE, save_motion, save_rest

AABB = np.array([[-1.0, -1, -1], [1, 1, 1]])
RADIUS = 0.4
TRAVEL = np.array([0.3, 0.0, 0.2])  # of the ball from time 0 to time 1, box units
WORLD_PER_BOX = 0.5  # metres
WIDTH, HEIGHT, FOCAL = 48, 36, 50.0


def ball_model() -> DynamicModel:
    """The ball as a trained model would hold it."""
    aabb = torch.tensor(AABB, dtype=torch.float32)
    ball = canonical(aabb, 24, channels=3, alpha_threshold=1e-3, weight_threshold=1e-3)
    inside = vertices(aabb, ball.shape).norm(dim=-1) < RADIUS
    ball.density[..., 0] = torch.where(inside, 30.0, -30.0)
    ball.features += vertices(aabb, ball.shape)
    ball.rebuild_occupancy()
    ball.net.requires_grad_(False)
    return DynamicModel(RestModel(ball, None, "white", 0.3, 9.0, {}), straight(aabb, TRAVEL, keys=3))


def halves_model() -> DynamicModel:
    """The same ball of two rigid parts, the lower one first, which stay where they are."""
    rest = ball_model().rest
    canonical = rest.canonical
    upper = vertices(canonical.aabb, canonical.shape)[..., 2] > 0
    labels = torch.where(canonical.distance <= 1, 1 + upper.int(), 0).to(torch.uint8)
    stands = canonical.only(torch.zeros_like(upper))
    turns, shifts = torch.eye(3).expand(3, 2, 3, 3).clone(), torch.zeros(3, 2, 3)
    movers = Movers(canonical, labels, torch.linspace(0, 1, 3), turns, shifts)
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, 3, 0.0)


def ring_camera(angle: float, height: float = 0.6, distance: float = 3.0) -> Camera:
    """A camera that looks at the origin; +z is up, lengths are box units."""
    eye = distance * np.array([np.cos(angle), np.sin(angle), height]) / np.hypot(1, height)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(WIDTH, HEIGHT, K, look_at(eye, np.zeros(3)))


def ball_scene(folder: Path) -> Scene:
    """Three fixed cameras, a witness, and a sweep of ten pictures; the world is half as large as the box."""
    world_from_box = np.diag([WORLD_PER_BOX] * 3 + [1.0])
    rng = np.random.default_rng(0)

    def frame(name: str, n: int, angle: float, time: float | None, split: Split) -> PosedFrame:
        path = folder / f"{name}_{n}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(path)
        camera = ring_camera(angle).moved(world_from_box)
        return PosedFrame(path, camera, name, n, None if time is None else 1 + 2 * time, time, split)

    angles = {"cam0": -0.6, "cam1": 0.0, "cam2": 0.6, "witness": 0.3}
    sweep = [frame("static", n, -1 + 0.2 * n, None, "train") for n in range(10)]
    fixed = [
        frame(name, n, angle, n / 4, "test" if name == "witness" else "train")
        for name, angle in angles.items()
        for n in range(5)
    ]
    box = {"aabb": AABB, "near": 0.3, "far": 9.0, "background": "white", "metric": True}
    return scene_of(sweep, fixed, 1 / WORLD_PER_BOX, **box, t0_s=1.0, t1_s=3.0)


def write_ball_run(folder: Path) -> Path:
    """Write scene.yaml and `run/` with the stages that a film reads; returns the former."""
    run, model = folder / "run", ball_model()
    write_scene(run / "scene", ball_scene(folder / "pictures"))
    for name in ("canonical", "deformation"):
        (run / name).mkdir()
    save_rest(run / "canonical" / FILE, model.rest)
    assert model.motion is not None
    save_motion(run / "deformation" / FILE, model.motion, model.rest.canonical.voxel)
    for name in ("scene", "canonical", "deformation"):
        stamp = {"id": f"id-{name}", "content": f"content-{name}", "identity": {}, "files": {}}
        (run / name / "stamp.json").write_text(json.dumps(stamp))
    value = {
        "name": "ball",
        "output": "run",
        "preset": "tiny",
        "dataset": {"format": "devrf", "path": "data"},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(value))
    return folder / "scene.yaml"
