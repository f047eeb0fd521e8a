"""The report's 3D drawing: cameras as frusta, the scene box and a subset of the sweep's points, as JSON.

Everything is in the world frame of `scene/`. The drawing itself is `drawSpace` in space.js.
"""

import json
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.colmap_points import read_colmap_points
from devrf.capture.errors import DevrfError
from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.report.html import absent, link, section, text
from devrf.pipelines.report.run import RunFolder, at

MAX_POINTS = 5000  # more makes dragging slow on a phone and the page heavy
MAX_LABELS = 12  # names of more cameras than this cover the drawing
FRUSTUM_FIXED, FRUSTUM_SWEEP = 0.16, 0.07  # length of a drawn frustum over the scene's radius
POINTS_WITHIN = 3.0  # times the radius; farther points (a window's view) would shrink the rest to a dot


def space_section(run: RunFolder) -> str:
    """Poses and cameras in 3D."""
    lead = (
        "Drag to turn, wheel or two fingers to zoom, Shift and drag to move. "
        "Frusta show where each camera stands and looks; the box is what the model fills."
    )
    scene = run.scene
    if scene is None:
        return section("space", "Cameras in space", lead, absent(run.why_absent("scene")))
    points, colours, note = sweep_points(run)
    data = space_data(scene, points, colours)
    switches = "".join(_switch(g["id"], g["label"], g["colour"]) for g in data["groups"])
    switches += _switch("points", "points", "--muted") if len(points) else ""
    switches += _switch("box", "scene box", "--muted")
    unit = "metres" if scene.metric else "arbitrary scale"
    caption = (
        f"{len(scene.static)} sweep pictures, {len({f.camera_name for f in scene.dynamic})} views of it in "
        f"motion; world units: {unit}. {note}"
    )
    body = (
        '<div class="space-root"><div class="space"><canvas tabindex="0" role="img" '
        'aria-label="Camera positions in 3D"></canvas></div>'
        f'<div class="switches">{switches}<button type="button">Reset the view</button></div>'
        f'<p class="source">{text(caption)} Source: {link("scene/scene.json")}</p>'
        f'<script type="application/json">{_script_json(data)}</script></div>'
    )
    return section("space", "Cameras in space", lead, body)


def space_data(scene: Scene, points: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"]) -> dict:
    """What space.js draws: groups of frusta, box corners, points, and how to look at them at first."""
    world_from_box = np.linalg.inv(scene.box_from_world)
    centres = np.stack([f.camera.centre for f in scene.frames])
    target = world_from_box[:3, :3] @ scene.aabb.mean(axis=0) + world_from_box[:3, 3]
    radius = float(np.percentile(np.linalg.norm(centres - target, axis=1), 90)) or 1.0
    fixed = {split: _unique(f for f in scene.dynamic if f.split == split) for split in ("train", "test")}
    sweep = [f for f in scene.static if f.split == "train"]
    held_out = [f for f in scene.static if f.split == "test"]
    in_order = bool(sweep) and sweep[0].camera_name == "static" and _is_path(sweep)
    groups = [
        _group("sweep", "sweep", "--s0", sweep, FRUSTUM_SWEEP * radius, path=in_order),
        _group("heldout", "held-out sweep", "--s3", held_out, FRUSTUM_SWEEP * radius),
        _group("fixed", "moving cameras", "--s2", fixed["train"], FRUSTUM_FIXED * radius, labels=True),
        _group("test", "test views", "--s1", fixed["test"], FRUSTUM_FIXED * radius, labels=True),
    ]
    lo, hi = scene.aabb
    corners = np.array([[(hi if n >> axis & 1 else lo)[axis] for axis in range(3)] for n in range(8)])
    near = np.linalg.norm(points - target, axis=1) < POINTS_WITHIN * radius
    return {
        "target": _rounded(target),
        "radius": radius,
        "up": _rounded(_up(scene)),
        "from": _rounded(centres.mean(0) - target),
        "groups": [group for group in groups if group["cameras"]],
        "box": _rounded(corners @ world_from_box[:3, :3].T + world_from_box[:3, 3]),
        "points": _rounded(points[near].ravel()),
        "colours": colours[near].astype(int).ravel().tolist(),
    }


def sweep_points(run: RunFolder) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], str]:
    """A subset of the sweep's points in the scene's world frame, their colours in [0, 255], and a remark."""
    none = np.zeros((0, 3))
    folder = run.folder("static_poses") / "colmap"
    if not folder.is_dir():
        return none, none, ""
    try:
        xyz, rgb = read_colmap_points(folder)
    except DevrfError as error:
        return none, none, f"Points left out: {error}."
    xyz = xyz * _scale(run)
    keep = np.random.default_rng(0).permutation(len(xyz))[:MAX_POINTS]
    return xyz[keep], rgb[keep].astype(float), f"{len(keep)} of {len(xyz)} points of the sweep are drawn."


def _scale(run: RunFolder) -> float:
    """From the sweep's unit to the rig's, in which the scene is (rig.json)."""
    factor = at(run.object("rig/rig.json"), "scale.factor")
    return float(factor) if isinstance(factor, int | float) else 1.0


def _group(
    name: str,
    label: str,
    colour: str,
    frames: Sequence[PosedFrame],
    length: float,
    *,
    path: bool = False,
    labels: bool = False,
) -> dict:
    return {
        "id": name,
        "label": f"{label} ({len(frames)})",
        "colour": colour,
        "path": path,
        "labels": labels and len(frames) <= MAX_LABELS,
        "bold": labels,
        "cameras": [
            {
                "name": f.camera_name,
                "centre": _rounded(f.camera.centre),
                "corners": _rounded(frustum(f.camera, length)),
            }
            for f in frames
        ],
    }


def _switch(name: str, label: str, colour: str) -> str:
    return (
        f'<label style="--c:var({colour})"><input type="checkbox" checked value="{text(name)}">'
        f"<i></i>{text(label)}</label>"
    )


def frustum(camera: Camera, length: float) -> Float[np.ndarray, "4 3"]:
    """Corners of the picture at depth `length` [4, 3], around the rim, in the world."""
    w, h = float(camera.width), float(camera.height)
    rays = camera.directions(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    depth = rays @ camera.cam_from_world[2, :3]
    return camera.centre + rays * (length / depth)[:, None]


def _unique(frames: Iterable[PosedFrame]) -> list[PosedFrame]:
    """One frame per camera and pose."""
    return list({(f.camera_name, f.camera.cam_from_world.tobytes()): f for f in frames}.values())


def _is_path(frames: Sequence[PosedFrame]) -> bool:
    """Whether consecutive pictures are neighbours (a walk), not views strewn over a dome or a window."""
    centres = np.stack([f.camera.centre for f in frames])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    extent = float(np.percentile(np.linalg.norm(centres - centres.mean(axis=0), axis=1), 90))
    return len(steps) > 1 and float(np.median(steps)) < 0.4 * extent


def _up(scene: Scene) -> Float[np.ndarray, "3"]:
    """Mean of what the cameras hold as up."""
    up = -np.mean([f.camera.cam_from_world[1, :3] for f in scene.frames], axis=0)
    return up if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])


def _rounded(values: np.ndarray) -> list:
    return np.round(values, 4).tolist()


def _script_json(data: dict) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
