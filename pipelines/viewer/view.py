"""Where a visitor looks from, as the page has it and as a camera of the model."""

from dataclasses import dataclass, replace

import numpy as np
import viser

from devrf.capture.camera import Camera
from devrf.capture.formats.colmap_poses import quat_wxyz
from devrf.capture.scene import Scene
from devrf.reconstruct.film.paths import orbit
from devrf.reconstruct.film.span import film_cameras, film_lens
from devrf.reconstruct.view_pictures import pinhole

OF_FILM = (4, 1)  # of a film of four pictures the second: the middle of a swing
LENS_PIXELS = 64_000  # of its pictures: only their field of view is asked for
BACK = 1.15  # times as far away as the cameras, or the room is not seen


@dataclass(frozen=True)
class View:
    """A view in the box frame.

    Attributes:
        position: Of the eye.
        wxyz: Axes of the eye in the scene, as a camera's.
        fov_rad: Vertical field of view.
        look_at: What the view is turned about.
        width, height: Of the window, pixels.
    """

    position: np.ndarray
    wxyz: np.ndarray
    fov_rad: float
    look_at: np.ndarray
    width: int
    height: int

    @staticmethod
    def of(camera: viser.CameraHandle) -> "View":
        """What a page shows."""
        size = max(2, camera.image_width), max(2, camera.image_height)
        return View(camera.position, camera.wxyz, camera.fov, camera.look_at, *size)

    @staticmethod
    def through(camera: Camera, middle: np.ndarray) -> "View":
        """What a camera sees, turned about a point before it that is as far away as `middle`."""
        axis = camera.cam_from_world[2, :3]
        away = max(float(axis @ (middle - camera.centre)), 0.1)
        fov_rad = 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1]))
        wxyz = np.array(quat_wxyz(camera.cam_from_world[:, :3].T))
        return View(camera.centre, wxyz, fov_rad, camera.centre + away * axis, camera.width, camera.height)

    @staticmethod
    def first(scene: Scene) -> "View":
        """The middle of what the cameras saw."""
        count, number = OF_FILM
        cameras = film_cameras(scene)
        camera = orbit(cameras, scene.aabb, count, film_lens(cameras, LENS_PIXELS))[number]
        view = View.through(camera, scene.aabb.mean(axis=0))
        return replace(view, position=view.look_at + BACK * (view.position - view.look_at))

    def camera(self, width: int, height: int) -> Camera:
        """The same view as a camera of the model, in pictures of this size."""
        return pinhole(self.position, self.wxyz, self.fov_rad, width, height)


def up_of(scene: Scene) -> np.ndarray:
    """What the cameras of a film take to be up [3]."""
    up = -np.mean([camera.cam_from_world[1, :3] for camera in film_cameras(scene)], axis=0)
    return up / np.linalg.norm(up)
