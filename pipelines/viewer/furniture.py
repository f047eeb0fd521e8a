"""What stands in the scene beside the rendered picture: cameras with their pictures, sweep path, points, box.

Everything is in the box frame, and each visitor's own.
"""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import viser

from devrf.capture.camera import Camera
from devrf.capture.errors import DevrfError
from devrf.capture.formats.colmap_poses import quat_wxyz
from devrf.capture.scene import Background, PosedFrame, load_image
from devrf.pipelines.viewer.source import Loaded
from devrf.reconstruct.pictures import spread

GROUPS = ("moving cameras", "test cameras", "sweep cameras", "sweep path", "points", "box")
FRUSTUM_FIXED, FRUSTUM_SWEEP = 0.07, 0.03  # of the distance from which cameras look at the box
NEAR = 3.0  # times its size: how near a frustum would be in the way of what its camera saw
MOST_OF_SWEEP = 60  # frusta; more of them hide each other
COLOURS = {
    "moving cameras": (234, 120, 30),
    "test cameras": (22, 160, 96),
    "sweep cameras": (70, 120, 220),
    "held out": (150, 90, 200),
    "box": (235, 235, 235),
}
POINT = 0.003  # size over the distance from which cameras look at the box
LINE_PX = 1.5
THUMBNAIL_PX = 160  # wide
KEPT = 600  # thumbnails, 50 kB each

logger = logging.getLogger(__name__)


class Thumbnails:
    """Small pictures of the capture, read by one thread beside everything else; shared by all visitors."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="thumbnails")
        self._kept: dict[Path, np.ndarray | None] = {}

    def of(self, frame: PosedFrame, background: Background) -> np.ndarray | None:
        """A frame's picture [h, w, 3], bytes; None where it cannot be read. For work in the thread."""
        if frame.path not in self._kept:
            if len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[frame.path] = _thumbnail(frame, background)
        return self._kept[frame.path]

    def soon(self, work: Callable[[], None]) -> None:
        """Do some work with pictures in the thread."""
        self._thread.submit(work)

    def end(self) -> None:
        """Do nothing more."""
        self._thread.shutdown(wait=False, cancel_futures=True)


class Furniture:
    """Things in space that one visitor sees.

    Args:
        client: The visitor.
        loaded: What is shown; with a scene.
        thumbnails: Where pictures come from.
        go_to: Called with a camera that was clicked.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: Loaded,
        thumbnails: Thumbnails,
        go_to: Callable[[Camera], None],
    ) -> None:
        assert loaded.scene is not None
        self._space, self._thumbnails, self._go_to = client.scene, thumbnails, go_to
        self._scene = scene = loaded.scene
        self._groups = {
            name: self._space.add_frame(f"/{name}", show_axes=False, visible=False) for name in GROUPS
        }
        centres = np.array([f.camera.centre for f in scene.frames])
        self._radius = float(np.median(np.linalg.norm(centres - scene.aabb.mean(axis=0), axis=1)))
        self._clips: list[tuple[Any, list[PosedFrame]]] = []
        self._frusta: list[tuple[Any, np.ndarray, float]] = []  # with centre, and how near a view hides it
        self._wanted: float | None = None  # time of the pictures that are asked for
        self._add_sweep()
        self._add_moving()
        self._add_points(loaded)
        self._add_box()

    def show(self, name: str, visible: bool) -> None:
        """Show or hide a group."""
        self._groups[name].visible = visible

    def seen_from(self, place: np.ndarray) -> None:
        """Hide cameras that a view from this place looks through, or nearly: their pictures would fill it."""
        for handle, centre, near in self._frusta:
            visible = bool(np.linalg.norm(centre - place) > near)
            if handle.visible != visible:
                handle.visible = visible

    def at(self, time: float) -> None:
        """Let moving cameras show their pictures nearest to a time in [0, 1]."""
        waits, self._wanted = self._wanted is not None, time
        if not waits:
            self._thumbnails.soon(self._new_pictures)

    def _add_sweep(self) -> None:
        frames = self._scene.static
        for n, frame in enumerate(spread(frames, MOST_OF_SWEEP)):
            colour = COLOURS["held out" if frame.split == "test" else "sweep cameras"]
            self._frustum(f"/sweep cameras/{n}", frame, FRUSTUM_SWEEP, colour)
        way = np.array([f.camera.centre for f in frames])
        if len(way) > 1:
            self._space.add_line_segments(
                "/sweep path/line", np.stack([way[:-1], way[1:]], axis=1).astype(np.float32),
                COLOURS["sweep cameras"], thickness=LINE_PX, thickness_units="screen",
            )  # fmt: skip

    def _add_moving(self) -> None:
        by_camera: dict[tuple[str, str], list[PosedFrame]] = {}
        for frame in self._scene.dynamic:
            by_camera.setdefault((frame.camera_name, frame.split), []).append(frame)
        for n, ((name, split), frames) in enumerate(by_camera.items()):
            group = "test cameras" if split == "test" else "moving cameras"
            frames.sort(key=lambda f: f.time or 0.0)
            handle = self._frustum(f"/{group}/{n}", frames[0], FRUSTUM_FIXED, COLOURS[group])
            self._space.add_label(f"/{group}/{n}/name", name, position=(0.0, -0.06 * self._radius, 0.0))
            self._clips.append((handle, frames))

    def _frustum(self, name: str, frame: PosedFrame, share: float, colour: tuple[int, int, int]) -> Any:
        camera = frame.camera
        fov = 2 * np.arctan(camera.height / 2 / camera.K[1, 1])
        handle = self._space.add_camera_frustum(
            name, float(fov), camera.width / camera.height, scale=share * self._radius, color=colour,
            thickness=LINE_PX, thickness_units="screen", wxyz=quat_wxyz(camera.cam_from_world[:, :3].T),
            position=camera.centre, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        handle.on_click(lambda event: self._go_to(camera))
        self._frusta.append((handle, camera.centre, NEAR * share * self._radius))

        self._thumbnails.soon(lambda: self._put(handle, frame))
        return handle

    def _new_pictures(self) -> None:
        """In the thread of pictures: those of the time that is wanted by now."""
        time, self._wanted = self._wanted or 0.0, None
        for handle, frames in self._clips:
            self._put(handle, min(frames, key=lambda f: abs((f.time or 0.0) - time)))

    def _put(self, handle: Any, frame: PosedFrame) -> None:
        picture = self._thumbnails.of(frame, self._scene.background)
        if handle.image is not picture:
            handle.image = picture

    def _add_points(self, loaded: Loaded) -> None:
        if len(loaded.points):
            self._space.add_point_cloud(
                "/points/sweep", loaded.points, loaded.colours, point_size=POINT * self._radius,
                precision="float32", point_shape="circle",
            )  # fmt: skip

    def _add_box(self) -> None:
        corners = np.stack(np.meshgrid(*self._scene.aabb.T, indexing="ij"), axis=-1).astype(np.float32)
        ends = [np.moveaxis(corners, axis, 0).reshape(2, 4, 3).swapaxes(0, 1) for axis in range(3)]
        self._space.add_line_segments(
            "/box/edges", np.concatenate(ends), COLOURS["box"], thickness=LINE_PX, thickness_units="screen"
        )


def _thumbnail(frame: PosedFrame, background: Background) -> np.ndarray | None:
    try:
        return load_image(frame, min(1.0, THUMBNAIL_PX / frame.camera.width), background)
    except (DevrfError, OSError) as error:
        logger.warning("%s: not shown (%s)", frame.path, error)
        return None
