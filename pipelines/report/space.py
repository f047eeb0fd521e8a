"""Where cameras stand, for the report and the viewer: plans of the scene, and points of the sweep.

Everything is in the world frame of `scene/`.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from devrf.capture.formats.colmap.colmap_model import read_points
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.report.run_reader import RunFolder, is_number
from devrf.pipelines.report.svg_charts import LINES, MUTED, Chart, draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RIG = "rig/rig.json"
MAX_POINTS = 5000  # more makes pages and the viewer heavy
# Times the extent of cameras; farther points (a window's view) would shrink the rest to a dot.
POINTS_WITHIN = 1.5
MAX_NAMES = 12  # of more cameras than this names cover the drawing
LOOK = 0.1  # of the extent: how long the line is that shows where a camera looks


def sweep_points(run: RunFolder) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], str]:
    """A subset of the sweep's points in the scene's world frame, their colours in [0, 255], and a remark."""
    none = np.zeros((0, 3))
    folder = run.folder("static_poses") / "colmap"
    if not folder.is_dir():
        return none, none, ""
    try:
        points = read_points(folder).values()
    except DevrfError as error:
        return none, none, f"Points left out: {error}; run with --force static_poses."
    xyz, rgb = (np.array([getattr(p, key) for p in points]).reshape(-1, 3) for key in ("xyz", "rgb"))
    factor = run.at(RIG, "scale.factor")  # from the sweep's unit to the rig's, in which the scene is
    xyz = xyz * (float(factor) if is_number(factor) else 1.0)
    keep = np.random.default_rng(0).permutation(len(xyz))[:MAX_POINTS]
    return xyz[keep], rgb[keep].astype(float), f"{len(keep)} of {len(xyz)} points of the sweep are drawn."


def plans(run: RunFolder) -> tuple[list[Chart], str]:
    """Cameras, sweep, points and box of the scene from above and from the side, and a remark on the points."""
    scene = run.scene
    if scene is None:
        return [], ""
    cameras = {f.camera_name: f for f in scene.dynamic}
    stand = np.array([f.camera.centre for f in scene.frames])
    extent = float(np.ptp(stand, axis=0).max()) or 1.0
    points, colours, remark = sweep_points(run)
    near = np.linalg.norm(points - stand.mean(axis=0), axis=1) < POINTS_WITHIN * extent
    world_from_box = np.linalg.inv(scene.box_from_world)
    bits = np.array([[n >> axis & 1 for axis in range(3)] for n in range(8)])
    corners = np.where(bits, scene.aabb[1], scene.aabb[0]) @ world_from_box[:3, :3].T + world_from_box[:3, 3]
    edges = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    drawn = []
    right, forward, up = _axes(np.array([f.camera.cam_from_world for f in scene.frames]), stand)
    for title, axes_of in (
        ("From above", np.stack([right, forward])),
        ("From the side", np.stack([right, up])),
    ):

        def paint(figure: "Figure", axes_of: Float[np.ndarray, "2 3"] = axes_of) -> None:
            axes = figure.add_subplot(aspect="equal", xlabel="metres" if scene.metric else "arbitrary scale")
            axes.scatter(*axes_of @ points[near].T, s=2, c=colours[near] / 255, rasterized=True)
            axes.plot(
                *axes_of @ np.array([f.camera.centre for f in scene.static]).reshape(-1, 3).T,
                ".",
                color=LINES[0],
            )
            for edge in edges:
                axes.plot(*axes_of @ corners[list(edge)].T, color=MUTED, linewidth=0.8)
            for name, frame in cameras.items():
                place, look = axes_of @ frame.camera.centre, axes_of @ frame.camera.cam_from_world[2, :3]
                axes.plot(*np.stack([place, place + LOOK * extent * look]).T, color=MUTED, linewidth=1)
                axes.plot(*place, "o", color=LINES[1 if frame.split == "test" else 2])
                if len(cameras) <= MAX_NAMES:
                    axes.annotate(name, (place[0], place[1]), (0, 7), textcoords="offset points", ha="center")

        drawn.append(draw(paint, (480, 360), title, f"{title}: {', '.join(cameras)}"))
    return drawn, remark


def _axes(poses: Float[np.ndarray, "n 3 4"], stand: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Right, forward and up of a plan: up is what the cameras hold as up, right is where they stand widest apart."""
    up = -poses[:, 1, :3].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    apart = stand - stand.mean(axis=0)
    right = np.linalg.svd(apart - np.outer(apart @ up, up))[2][0]
    right = right - (right @ up) * up
    if np.linalg.norm(right) < 1e-6:  # all in one place
        right = np.cross(up, poses[0, 2, :3])
    right /= np.linalg.norm(right) or 1.0
    return np.stack([right, np.cross(up, right), up])
