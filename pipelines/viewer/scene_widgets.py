"""What stands in the scene beside the rendered picture: frusta of cameras, and points; in the box frame."""

from collections.abc import Callable

import numpy as np
import viser

from devrf.capture.camera import Camera
from devrf.capture.formats.colmap.colmap_poses import quat_wxyz
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.spread import spread

# whether shown where a picture can be seen; else all are. The first view is often a test camera's
GROUPS = {"cameras": True, "test cameras": False, "sweep": False, "points": False}
FRUSTUM_FIXED, FRUSTUM_SWEEP = 0.07, 0.03  # of the distance from which cameras look at the box
MOST_OF_SWEEP = 60  # frusta; more of them hide each other
FIXED, TEST, SWEEP, HELD_OUT = (234, 120, 30), (22, 160, 96), (70, 120, 220), (150, 90, 200)  # colours
GREY = (150, 150, 150)
MOST_POINTS = 8000
POINT = 0.003  # size over the distance from which cameras look at the box
LINE_PX = 1.5


def furnish(
    space: viser.SceneApi, scene: Scene, go_to: Callable[[Camera], None]
) -> dict[str, viser.FrameHandle]:
    """Put things in space, in the place of those before.

    Args:
        space: The scene of all visitors.
        scene: In the box frame.
        go_to: Called with a camera that was clicked.
    Returns:
        What shows and hides each of `GROUPS`.
    """
    space.reset()
    groups = {name: space.add_frame(f"/{name}", show_axes=False, visible=False) for name in GROUPS}
    centres = np.array([f.camera.centre for f in scene.frames])
    radius = float(np.median(np.linalg.norm(centres - scene.aabb.mean(axis=0), axis=1)))

    def frustum(name: str, frame: PosedFrame, size: float, colour: tuple[int, int, int]) -> None:
        camera = frame.camera
        handle = space.add_camera_frustum(
            name, camera.fov_y, camera.width / camera.height, scale=size * radius, color=colour,
            thickness=LINE_PX, thickness_units="screen", wxyz=quat_wxyz(camera.cam_from_world[:, :3].T),
            position=camera.centre, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        handle.on_click(lambda event: go_to(camera))

    for n, frame in enumerate(spread(scene.static, MOST_OF_SWEEP)):
        frustum(f"/sweep/{n}", frame, FRUSTUM_SWEEP, HELD_OUT if frame.split == "test" else SWEEP)
    for n, (name, frame) in enumerate({f.camera_name: f for f in scene.dynamic}.items()):
        group, colour = ("test cameras", TEST) if frame.split == "test" else ("cameras", FIXED)
        frustum(f"/{group}/{n}", frame, FRUSTUM_FIXED, colour)
        space.add_label(f"/{group}/{n}/name", name, position=(0.0, -0.06 * radius, 0.0))
    if scene.points is not None:
        xyz = scene.points.xyz[spread(range(len(scene.points.xyz)), MOST_POINTS)].astype(np.float32)
        space.add_point_cloud("/points/all", xyz, GREY, point_size=POINT * radius, point_shape="circle")
    return groups
