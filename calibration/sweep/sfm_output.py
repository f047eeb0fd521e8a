"""What the worker leaves of COLMAP's database and model: arrays, numbers and poses for its caller.

Part of the worker's process; databases, models and cameras are pycolmap's, which only `sfm_worker` imports.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera, LensModel
from devrf.capture.formats.colmap.colmap_model import ModelCamera
from devrf.capture.formats.colmap.colmap_scene import intrinsics

FEWEST_INLIERS = 15  # of a verified pair (COLMAP's own bound)

Database = Any  # pycolmap's, open
ImagesOf = Callable[[Any], tuple[int, int]]  # a pair as the database has it -> its two images


def best_pair(db: Database, images_of: ImagesOf) -> dict[str, Any]:
    """The pair with the most verified matches: what a failed start is measured by."""
    names = {image.image_id: image.name for image in db.read_all_images()}
    pair_ids, inliers = db.read_two_view_geometry_num_inliers()
    best = int(np.argmax(inliers)) if len(inliers) else -1
    out = {"inliers": 0, "names": [], "angle_deg": None}
    if best >= 0:
        ids = images_of(pair_ids[best])
        angle = db.read_two_view_geometry(*ids).tri_angle
        out["inliers"] = int(inliers[best])
        out["names"] = [names[i] for i in ids]
        out["angle_deg"] = float(np.degrees(angle)) if angle is not None and angle > 0 else None
    return out


def features_per_image(db: Database) -> dict[str, int]:
    return {i.name: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}


def features(db: Database, image_id: int) -> tuple[np.ndarray, np.ndarray]:
    xy = np.asarray(db.read_keypoints(image_id))[:, :2].astype(np.float32)
    descriptors = db.read_descriptors(image_id)
    return xy, np.asarray(getattr(descriptors, "data", descriptors), dtype=np.uint8).reshape(len(xy), 128)


def write_two_views(db: Database, images_of: ImagesOf, kind_of: Callable[[int], str], out: Path) -> None:
    """`two_views.npz`: what is known of every verified pair; see `two_views.TwoViews`."""
    images = sorted(db.read_all_images(), key=lambda i: i.name)
    row_of = {image.image_id: n for n, image in enumerate(images)}
    keypoints = {i.image_id: np.asarray(db.read_keypoints(i.image_id))[:, :2] for i in images}
    pair_ids, geometries = db.read_two_view_geometries()
    pairs, kinds, match_pair, match_xy, match_inlier = [], [], [], [], []
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = images_of(pair_id)
        agreeing = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(agreeing) < FEWEST_INLIERS:
            continue
        matches = np.asarray(db.read_matches(a, b)).reshape(-1, 2)
        pairs.append((row_of[a], row_of[b]))
        kinds.append(kind_of(geometry.config))
        match_pair.append(np.full(len(matches), len(pairs) - 1))
        match_xy.append(np.stack([keypoints[a][matches[:, 0]], keypoints[b][matches[:, 1]]], axis=1))
        match_inlier.append(np.isin(matches @ (1 << 32, 1), agreeing @ (1 << 32, 1)))
    np.savez(
        out / "two_views.npz",
        names=np.array([i.name for i in images]),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        kinds=np.array(kinds, dtype=np.str_),
        match_pair=np.concatenate([*match_pair, np.zeros(0, np.int64)]).astype(np.int64),
        match_xy=np.concatenate([*match_xy, np.zeros((0, 2, 2))]).astype(np.float64),
        match_inlier=np.concatenate([*match_inlier, np.zeros(0, bool)]).astype(bool),
    )


def write_model(model: Any, db: Database, out: Path) -> dict[str, Any]:
    """The COLMAP files, `points.npz` (points, observations, descriptors), and poses for the caller."""
    folder = out / "colmap"
    folder.mkdir(parents=True, exist_ok=True)
    model.update_point_3d_errors()
    model.write(str(folder))
    number = {point_id: n for n, point_id in enumerate(sorted(model.points3D))}
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    point, view, xy, descriptors = [], [], [], []
    for n, image in enumerate(images):
        _, all_descriptors = features(db, image.image_id)
        indices = list(image.get_observation_point2D_idxs())
        point += [number[image.point2D(i).point3D_id] for i in indices]
        view += [n] * len(indices)
        xy.append(np.array([image.point2D(i).xy for i in indices], dtype=np.float64).reshape(-1, 2))
        descriptors.append(all_descriptors[indices])
    points = [model.points3D[i] for i in sorted(model.points3D)]
    np.savez(
        out / "points.npz",
        xyz=np.array([p.xyz for p in points]).reshape(-1, 3),
        rgb=np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
        error_px=np.array([p.error for p in points]),
        obs_point=np.array(point, dtype=np.int64),
        obs_image=np.array(view, dtype=np.int64),
        obs_xy=np.concatenate(xy),
        obs_descriptor=np.concatenate(descriptors),
    )
    return {
        "mean_reprojection_px": model.compute_mean_reprojection_error(),
        "mean_track_length": model.compute_mean_track_length(),
        "points": len(points),
        "frames": {
            i.name: {"camera_from_world": i.cam_from_world().matrix().tolist(), "camera_id": i.camera_id}
            for i in images
        },
        "cameras": {str(k): _camera(c) for k, c in model.cameras.items()},
    }


def cameras_of(model: Any) -> dict[str, Camera]:
    """The cameras of registered pictures, by name."""
    lenses = {k: _camera(c) for k, c in model.cameras.items()}
    seen = (i for i in model.images.values() if i.has_pose)
    return {i.name: camera_at(lenses[i.camera_id], i.cam_from_world().matrix()) for i in seen}


def camera_at(lens: Mapping[str, Any], cam_from_world: Float[np.ndarray, "3 4"]) -> Camera:
    """A camera of a lens as `cameras` in static_poses.json has it."""
    model: LensModel = "OPENCV_FISHEYE" if lens["model"] == "OPENCV_FISHEYE" else "OPENCV"
    K, distortion = np.array(lens["K"]), np.array(lens["distortion"])
    return Camera(lens["width"], lens["height"], K, cam_from_world, distortion, model)


def _camera(camera: Any) -> dict[str, Any]:
    model, width, height = camera.model.name, camera.width, camera.height
    params = tuple(float(p) for p in camera.params)
    K, distortion, _ = intrinsics(ModelCamera(model, width, height, params), "the sweep's model")
    return {
        "model": model,
        "width": width,
        "height": height,
        "K": K.tolist(),
        "distortion": distortion.tolist(),
    }
