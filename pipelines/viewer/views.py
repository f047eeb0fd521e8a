"""Where pages of the viewer look from, and what of a picture each of them is sent."""

from dataclasses import replace

import numpy as np
import viser
from jaxtyping import Float
from viser.transforms import SO3

from devrf.capture.camera import Camera
from devrf.capture.formats.colmap.colmap_poses import quat_wxyz
from devrf.capture.scene import Scene
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import orbit

# Times as far away as the cameras is the first view, so that the room is seen; nearer where something stands between:
# right before a place from which nobody looked all that is modelled is fog.
BACK = (1.15, 1.07, 1.0)
BETWEEN = 0.5  # of the distance to the box's middle
SAME = 1e-4  # pages round what they say of themselves; of a distance, and of a quaternion's product


def first_camera(scene: Scene) -> Camera:
    """The middle of what the cameras saw, a little farther away; in the box frame."""
    cameras, target = film_cameras(scene), scene.aabb.mean(axis=0)
    camera = orbit(cameras, scene.aabb, 4, film_lens(cameras))[1]  # the middle of a swing
    R, centre = camera.cam_from_world[:, :3], camera.centre
    away = max(float(R[2] @ (target - centre)), 0.1)
    views = [
        replace(camera, cam_from_world=np.column_stack([R, -R @ (centre - (back - 1) * away * R[2])]))
        for back in BACK
    ]
    return next((view for view in views if _nothing_between(view, scene, target)), views[-1])


def _nothing_between(camera: Camera, scene: Scene, target: Float[np.ndarray, "3"]) -> bool:
    """Whether none of the sweep's points in a camera's picture is much nearer than what it looks at."""
    if scene.points is None:
        return True
    xyz = scene.points.xyz
    away = np.linalg.norm(xyz[camera.in_picture(camera.project(xyz))] - camera.centre, axis=1)
    return bool((away >= BETWEEN * np.linalg.norm(target - camera.centre)).all())


def seen_by(page: viser.CameraHandle, width: int, height: int) -> Camera:
    """What a page shows, as a camera of the model whose pictures have this size: no distortion, square pixels."""
    R = SO3(page.wxyz).as_matrix()
    f = height / 2 / np.tan(page.fov / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Camera(width, height, K, np.column_stack([R.T, -R.T @ page.position]))


def look_through(page: viser.CameraHandle, camera: Camera, scene: Scene) -> None:
    """Let a page show what a camera sees, turned about a point before it that is as far away as the scene's middle."""
    axis = camera.cam_from_world[2, :3]
    away = max(float(axis @ (scene.aabb.mean(axis=0) - camera.centre)), 0.1)
    up = -np.mean([other.cam_from_world[1, :3] for other in film_cameras(scene)], axis=0)
    page.fov = camera.fov_y
    page.position, page.look_at = camera.centre, camera.centre + away * axis
    page.up_direction = up / np.linalg.norm(up)
    page.wxyz = np.array(quat_wxyz(camera.cam_from_world[:, :3].T))


def follow(page: viser.CameraHandle, leader: viser.CameraHandle) -> None:
    """Let a page look from where another one does."""
    page.fov, page.position, page.look_at = leader.fov, leader.position, leader.look_at
    page.up_direction, page.wxyz = leader.up_direction, leader.wxyz


def apart(page: viser.CameraHandle, other: viser.CameraHandle) -> bool:
    """Whether two pages look from elsewhere, or into another direction."""
    alike = np.abs(page.wxyz @ other.wxyz)  # a quaternion and its negative are one rotation
    return not (np.allclose(page.position, other.position, atol=SAME) and np.isclose(alike, 1, atol=SAME))


def middle(picture: np.ndarray, share: float) -> np.ndarray:
    """The middle of a picture [h, w, ...] with a share of its width."""
    left = (picture.shape[1] - max(1, round(share * picture.shape[1]))) // 2
    return np.ascontiguousarray(picture[:, left : picture.shape[1] - left])
