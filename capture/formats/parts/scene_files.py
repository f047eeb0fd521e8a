"""Our own scene on disk: `scene.json`, a transforms file per part, `points.npz` (docs/formats.md, scene)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.formats.parts.files import read_json, write_json
from devrf.capture.formats.parts.transforms import read_transforms, write_transforms
from devrf.capture.scene import Scene, SparsePoints
from devrf.capture.system.arrays import read_npz
from devrf.capture.system.errors import CaptureError

PLAIN_KEYS = ("near", "far", "kind", "background", "t0_s", "t1_s", "rest_time", "metric")
DAMAGE = (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError)  # of values in a file
OWN_KEY = "devrf_scene"  # under which exported transforms files carry `scene_entry`


def write_scene(folder: Path, scene: Scene) -> None:
    """Write `scene.json`, `static/transforms.json`, `dynamic/transforms.json`, `points.npz` into `folder`."""
    for part, frames in (("static", scene.static), ("dynamic", scene.dynamic)):
        if frames:
            write_transforms(folder / part / "transforms.json", frames)
    if scene.points is not None:
        points = scene.points
        np.savez(
            folder / "points.npz", xyz=points.xyz, obs_point=points.obs_point, obs_frame=points.obs_frame
        )
    write_json(folder / "scene.json", {**scene_entry(scene), "image_scale": scene.image_scale})


def read_scene(folder: Path) -> Scene:
    """Read what `write_scene` wrote.

    Raises:
        CaptureError: It was changed since, or is damaged.
    """
    meta = read_json(folder / "scene.json")
    parts = {part: folder / part / "transforms.json" for part in ("static", "dynamic")}
    frames = {part: read_transforms(path) if path.is_file() else () for part, path in parts.items()}
    points = None
    if (folder / "points.npz").is_file():
        points = SparsePoints(**read_npz(folder / "points.npz", ("xyz", "obs_point", "obs_frame")))
    try:
        return Scene(
            static=frames["static"],
            dynamic=frames["dynamic"],
            points=points,
            image_scale=meta["image_scale"],
            **_values(meta),
        )
    except DAMAGE as error:
        text = f"{folder / 'scene.json'}: is damaged ({error}); run again with --force scene"
        raise CaptureError("file-damaged", text) from None


def scene_entry(scene: Scene) -> dict[str, Any]:
    """Everything of a scene but its pictures, points and the scale they are trained at."""
    lo, hi = scene.aabb.tolist()
    return {
        "box": {"min": lo, "max": hi},
        "box_from_world": scene.box_from_world.tolist(),
        **{key: getattr(scene, key) for key in PLAIN_KEYS},
        "ndc": None if scene.ndc is None else list(scene.ndc),
    }


def with_scene_entry(scene: Scene, entry: Any, path: Path) -> Scene:
    """The scene with box, times and background of an exported data set, as `scene_entry` wrote them."""
    try:
        return replace(scene, **_values(entry))
    except DAMAGE as error:
        text = f"{path}: {OWN_KEY} is damaged ({error}); remove the key, or export again"
        raise CaptureError("entry-wrong", text) from None


def _values(meta: dict[str, Any]) -> dict[str, Any]:
    ndc = meta.get("ndc")
    return {
        "box_from_world": np.array(meta["box_from_world"], dtype=np.float64),
        "aabb": np.array([meta["box"]["min"], meta["box"]["max"]], dtype=np.float64),
        "ndc": None if ndc is None else (float(ndc[0]), float(ndc[1])),
        **{key: meta[key] for key in PLAIN_KEYS},
        **{key: float(meta[key]) for key in ("near", "far", "t0_s", "t1_s")},
        "rest_time": None if meta["rest_time"] is None else float(meta["rest_time"]),
    }
