"""Where a visitor looks from, as the page has it and as a camera of the model; both in the box frame."""

from dataclasses import replace

import numpy as np
import viser
from viser.transforms import SO3

from devrf.capture.camera import Camera
from devrf.capture.formats.colmap_poses import quat_wxyz
from devrf.capture.scene import Scene
from devrf.reconstruct.film.paths import orbit
from devrf.reconstruct.film.span import film_cameras, film_lens

OF_FILM = (4, 1)  # of a film of four pictures the second: the middle of a swing
LENS_PIXELS = 64_000  # of its pictures: only their field of view is asked for
BACK = 1.15  # times as far away as the cameras, or the room is not seen

Page = viser.CameraHandle | viser.InitialCameraConfig


def seen_by(page: viser.CameraHandle, width: int, height: int) -> Camera:
    """What a page shows, as a camera of the model whose pictures have this size: no distortion, square pixels."""
    R = SO3(page.wxyz).as_matrix()
    f = height / 2 / np.tan(page.fov / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Camera(width, height, K, np.column_stack([R.T, -R.T @ page.position]))


def look_through(page: Page, camera: Camera, scene: Scene) -> None:
    """Let a page show what a camera sees, turned about a point before it that is as far away as the scene's middle.

    What is set of a visitor's page depends on what was set before, so nothing that the page says of itself may come
    between: call it in the server's event loop. The world itself is never turned upright, since a page that is told of
    that and of a view at once may do the one before or after the other.
    """
    axis, up = camera.cam_from_world[2, :3], _up_of(scene)
    away = max(float(axis @ (scene.aabb.mean(axis=0) - camera.centre)), 0.1)
    page.fov = 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1]))
    page.position, page.look_at = camera.centre, camera.centre + away * axis
    if isinstance(page, viser.CameraHandle):
        page.up_direction = up
        page.wxyz = np.array(quat_wxyz(camera.cam_from_world[:, :3].T))
    else:
        page.up = up


def first_camera(scene: Scene) -> Camera:
    """The middle of what the cameras saw, a little farther away."""
    count, number = OF_FILM
    cameras = film_cameras(scene)
    camera = orbit(cameras, scene.aabb, count, film_lens(cameras, LENS_PIXELS))[number]
    R, centre = camera.cam_from_world[:, :3], camera.centre
    away = float(R[2] @ (scene.aabb.mean(axis=0) - centre))
    back = centre - (BACK - 1) * max(away, 0.1) * R[2]
    return replace(camera, cam_from_world=np.column_stack([R, -R @ back]))


def _up_of(scene: Scene) -> np.ndarray:
    """What the cameras of a film take to be up [3]."""
    up = -np.mean([camera.cam_from_world[1, :3] for camera in film_cameras(scene)], axis=0)
    return up / np.linalg.norm(up)
