"""What there is to know of a film: what it was made from, and `film.json` beside it."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.capture.durable import read_json
from devrf.capture.formats.opengl import opengl_pose
from devrf.capture.scene import Scene
from devrf.pipelines.film.plan import Film
from devrf.pipelines.stamps.code_version import code_version
from devrf.pipelines.stamps.stamp import stamp_content

if TYPE_CHECKING:  # they need torch
    from devrf.pipelines.film.draw import Drawer
    from devrf.pipelines.film.make import Made

FILM = "film.json"
READS = ("scene", "canonical", "deformation")  # the stages whose results are filmed


def made_from_of(run_dir: Path, plan: Film) -> str:
    """A digest of all that the film's pictures depend on."""
    cameras = [[c.cam_from_world.tolist(), c.K.tolist(), c.distortion.tolist()] for c in plan.cameras]
    lens = plan.cameras[0]
    value = {
        "pictures": [cameras, plan.times, plan.fps, lens.width, lens.height, lens.model],
        "shown": [plan.layers, plan.format, [[f.camera_name, f.index] for f in plan.beside], plan.without],
        "model": {name: stamp_content(run_dir / name) for name in READS},
        "code": code_version("devrf.pipelines.film.make"),
    }
    return hashlib.blake2b(json.dumps(value).encode(), digest_size=16).hexdigest()


def read_made_from(file: Path) -> str | None:
    """What a film was made from, by its `film.json` or that of its kept pictures; None where there is none."""
    try:
        return str(read_json(file)["made_from"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def film_json(
    plan: Film, world: Scene, drawer: "Drawer", made: "Made", made_from: str, notes: Sequence[str]
) -> dict[str, Any]:
    """What there is to know of the film; also a camera path that nerfstudio, and `--path`, read again."""
    world_from_box = np.linalg.inv(world.box_from_world)
    lens, depth = plan.cameras[0], drawer.depth
    length_s = world.t1_s - world.t0_s
    scales: dict[str, Any] = {
        "depth": {"unit": depth.unit, "metres": world.metric, "near": depth.near, "far": depth.far},
        "flow": {"direction": "backward", "full_px": drawer.full_flow_px},
    }
    entries = []
    for camera, time in zip(plan.cameras, plan.times, strict=True):
        fov = float(np.degrees(2 * np.arctan(0.5 * camera.height / camera.K[1, 1])))
        pose = np.array(opengl_pose(camera.moved(world_from_box))).reshape(-1).tolist()
        entry = {"camera_to_world": pose, "fov": fov, "aspect": camera.width / camera.height}
        entries.append(entry if time is None else entry | {"render_time": time})
    return {
        "path": plan.path,
        "frames": plan.count,
        "fps": plan.fps,
        "seconds": plan.count / plan.fps,
        "times_s": [None if time is None else world.t0_s + time * length_s for time in plan.times],
        "layers": {layer: scales.get(layer, {}) for layer in plan.layers},
        "beside": [[frame.camera_name, frame.index] for frame in plan.beside],
        "without": plan.without,
        "notes": list(notes),
        "rendered": made.rendered,
        "made_in_s": round(made.seconds, 3),
        "render_s": round(made.render_s, 3),
        "made_from": made_from,
        "camera_type": "perspective",
        "render_width": lens.width,
        "render_height": lens.height,
        "camera_path": entries,
    }
