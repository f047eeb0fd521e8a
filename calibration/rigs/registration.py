"""One picture into a finished model: match its features with the model's points, then find its pose.

First round: every sweep picture's triangulated features are matched with the new picture's (mutual nearest
neighbours, ratio test of Lowe, IJCV 2004); each match votes for a pair (feature, 3D point). RANSAC finds
the pose; with an unknown focal length several are tried and the one with the most inliers is kept. Second
round: all points are projected with that pose and matched again with the features nearby, where the ratio test
no longer needs to fight the whole picture.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from devrf.calibration.bundle.adjust import BundleSolution, adjust
from devrf.calibration.bundle.problem import Problem, bodies_of_points, lenses
from devrf.calibration.intrinsics import Intrinsics, from_vector
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.camera import Camera

RATIO = 0.8  # Lowe
MAX_DISTANCE = 0.7  # of unit descriptors, as COLMAP
RANSAC_SHARE = 0.006  # of the longer side: threshold of the first round, 8 px at 1280
GUIDED_SHARE = 0.006  # search radius of the second round
FOCALS = np.geomspace(0.5, 3.0, 19)  # of the longer side, tried where the focal length is unknown
MIN_POINTS = 6
# Pictures of another place reach 7 by chance, and the second round would add to these.
FIRST_ROUND_INLIERS = 12
RICH_MATCHES = 150  # from here on a picture can say something about its principal point
# Of the longer side. Phones and webcams are off by about 1 %, but what a picture's points say of it is off by 3 to 5
# times what their noise explains (ten captures), and turns the camera with it.
PRINCIPAL_POINT_STD = 0.003
FEATURE_STD_PX = 0.5  # of a SIFT feature's place
INLIER_PX = 3.0  # of the final pose, at 1000 px; COLMAP filters at 4


@dataclass(frozen=True)
class Registration:
    """A picture's pose in the model and what supports it.

    Attributes:
        camera: Pose and intrinsics.
        points, xy: Inlier points and where they are seen [N], [N, 2].
        matches: 2D-3D matches before RANSAC; verified: those of them that agreed on a pose.
        solution: The refinement with the points held (covariances).
    """

    camera: Camera
    points: Int[np.ndarray, " inliers"]
    xy: Float[np.ndarray, "inliers 2"]
    matches: int
    verified: int
    solution: BundleSolution


def match_model(
    descriptors: UInt8[np.ndarray, "features 128"], model: SweepModel
) -> tuple[Int[np.ndarray, " matches"], Int[np.ndarray, " matches"]]:
    """Features and points that look alike in at least one sweep picture: (feature, point) indices.

    A feature keeps the point that most pictures vote for.
    """
    own = _unit(descriptors)
    votes: dict[tuple[int, int], float] = {}
    for image in range(len(model.names)):
        seen = np.flatnonzero(model.obs_image == image)
        for feature, there, score in _mutual(own, _unit(model.obs_descriptor[seen])):
            key = (feature, int(model.obs_point[seen[there]]))
            votes[key] = votes.get(key, 0.0) + score
    best_point: dict[int, tuple[float, int]] = {}
    for (feature, point), score in votes.items():
        best_point[feature] = max(best_point.get(feature, (0.0, -1)), (score, point))
    best_feature: dict[int, tuple[float, int]] = {}
    for feature, (score, point) in best_point.items():
        best_feature[point] = max(best_feature.get(point, (0.0, -1)), (score, feature))
    pairs = sorted((feature, point) for point, (_, feature) in best_feature.items())
    found = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def register(
    xy: Float[np.ndarray, "features 2"],
    descriptors: UInt8[np.ndarray, "features 128"],
    model: SweepModel,
    intrinsics: Intrinsics,
    known: bool,
) -> tuple[Registration | None, int]:
    """Pose of a picture in the model.

    Args:
        xy, descriptors: SIFT features of the picture.
        model: The sweep.
        intrinsics: Start values; held where `known`.
        known: The intrinsics come from a calibration.
    Returns:
        The registration, or None where no pose has enough support; and the number of inliers found.
    """
    feature, point = match_model(descriptors, model)
    if len(feature) < MIN_POINTS:
        return None, len(feature)
    size = (intrinsics.width, intrinsics.height)
    longest = max(size)
    pose, start, inliers = _ransac(xy[feature], model.xyz[point], intrinsics, known, RANSAC_SHARE * longest)
    if pose is None or inliers.sum() < FIRST_ROUND_INLIERS:
        return None, int(inliers.sum())
    first = intrinsics if known else weak_prior(intrinsics, 0)
    solution = refine(start, pose, model.xyz[point[inliers]], xy[feature[inliers]], first)
    camera = camera_of(solution.problem, intrinsics, 0)
    guided_feature, guided_point = feature[inliers], point[inliers]
    for radius in (GUIDED_SHARE * longest, 0.5 * GUIDED_SHARE * longest):
        guided_feature, guided_point = _guided(xy, descriptors, model, camera, radius)
        if len(guided_feature) < MIN_POINTS:
            return None, len(guided_feature)
        start = from_vector(*size, solution.problem.intrinsics[0], None, intrinsics.model)
        prior = intrinsics if known else weak_prior(intrinsics, len(guided_feature))
        solution = refine(start, camera.cam_from_world, model.xyz[guided_point], xy[guided_feature], prior)
        camera = camera_of(solution.problem, intrinsics, 0)
    limit = max(INLIER_PX * longest / 1000, 3 * solution.sigma_px)
    keep = np.linalg.norm(solution.residual_px, axis=1) < limit
    return (
        Registration(
            camera,
            guided_point[keep],
            xy[guided_feature[keep]].astype(np.float64),
            len(feature),
            int(inliers.sum()),
            solution,
        ),
        int(keep.sum()),
    )


def refine(
    start: Intrinsics,
    cam_from_world: Float[np.ndarray, "3 4"],
    xyz: Float[np.ndarray, "n 3"],
    xy: Float[np.ndarray, "n 2"],
    prior: Intrinsics,
) -> BundleSolution:
    """Pose and intrinsics of one camera with the points held; `prior.std` says what may move (None: none)."""
    n = len(xyz)
    problem = Problem(
        poses=cam_from_world[None].copy(),
        free_pose=np.ones(1, dtype=bool),
        device=np.zeros(1, dtype=np.int64),
        **lenses([start], [prior]),
        bodies=bodies_of_points(xyz),
        freedom=np.zeros(n, dtype=np.int64),
        obs_camera=np.zeros(n, dtype=np.int64),
        obs_body=np.arange(n),
        obs_local=np.zeros((n, 3)),
        obs_xy=xy.astype(np.float64),
        obs_std=np.full(n, FEATURE_STD_PX),
    )
    return adjust(problem)


def weak_prior(start: Intrinsics, matches: int) -> Intrinsics:
    """What is known of a camera without calibration: one free focal length (fy keeps its ratio to fx), a small k1, a
    centred picture.

    With many matches the principal point may leave the centre by a percent or so and k2 may bend.
    """
    std = np.zeros(9)
    std[[0, 1]] = np.inf
    std[4] = 0.3
    if matches >= RICH_MATCHES:
        std[2:4] = PRINCIPAL_POINT_STD * max(start.width, start.height)
        std[5] = 0.1
    return replace(start, std=std)


def camera_of(problem: Problem, like: Intrinsics, index: int) -> Camera:
    """Camera `index` of a bundle problem."""
    k = from_vector(like.width, like.height, problem.intrinsics[problem.device[index]], None, like.model)
    return k.at(_orthonormal(problem.poses[index]))


def _unit(descriptors: UInt8[np.ndarray, "n 128"]) -> Float[np.ndarray, "n 128"]:
    d = descriptors.astype(np.float32)
    return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6)


def _mutual(a: Float[np.ndarray, "n 128"], b: Float[np.ndarray, "m 128"]) -> list[tuple[int, int, float]]:
    """Mutual nearest neighbours that pass the ratio test: (index in a, index in b, similarity)."""
    if len(a) < 2 or len(b) < 2:
        return []
    similarity = a @ b.T
    best = similarity.argmax(1)
    rows = np.arange(len(a))
    top = similarity[rows, best]
    back = similarity.argmax(0)
    mutual = np.flatnonzero(back[best] == rows)
    rest = similarity[mutual]
    rest[np.arange(len(mutual)), best[mutual]] = -1.0
    second = np.sqrt(np.maximum(2 - 2 * rest.max(1), 1e-12))
    first = np.sqrt(np.maximum(2 - 2 * top[mutual], 0.0))
    keep = (first < RATIO * second) & (first < MAX_DISTANCE)
    return [(int(i), int(best[i]), float(top[i])) for i in mutual[keep]]


def _ransac(
    xy: Float[np.ndarray, "n 2"],
    xyz: Float[np.ndarray, "n 3"],
    start: Intrinsics,
    known: bool,
    threshold_px: float,
) -> tuple[Float[np.ndarray, "3 4"] | None, Intrinsics, Bool[np.ndarray, " n"]]:
    """The pose, and with an unknown focal length the focal, that most matches agree with."""
    longest = max(start.width, start.height)
    tries = [start]
    if not known:
        for focal in FOCALS * longest:
            vector = start.vector
            vector[:2] *= focal / vector[0]
            tries.append(from_vector(start.width, start.height, vector))
    best: tuple[float, Float[np.ndarray, "3 4"] | None, Intrinsics, Bool[np.ndarray, " n"]]
    best = (0.0, None, start, np.zeros(len(xy), dtype=bool))
    for k in tries:
        cv2.setRNGSeed(0)
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            xyz.astype(np.float64),
            k.undistorted(xy.astype(np.float64)) - 0.5,
            k.cv_matrix,
            None,
            iterationsCount=3000,
            reprojectionError=float(threshold_px),
            confidence=0.9999,
            flags=cv2.SOLVEPNP_EPNP if len(xy) < 8 else cv2.SOLVEPNP_AP3P,
        )
        if not ok or inliers is None or len(inliers) < MIN_POINTS:
            continue
        mask = np.zeros(len(xy), dtype=bool)
        mask[np.asarray(inliers, dtype=np.int64).reshape(-1)] = True
        pose = np.column_stack([cv2.Rodrigues(rotation)[0], np.asarray(translation).reshape(3)])
        error = np.linalg.norm(k.at(_orthonormal(pose)).project(xyz[mask]) - xy[mask], axis=1)
        score = float(np.maximum(0.0, 1 - (np.nan_to_num(error, nan=1e9) / threshold_px) ** 2).sum())  # MSAC
        if score > best[0]:
            best = (score, pose, k, mask)
    return best[1:]


def _guided(
    xy: Float[np.ndarray, "features 2"],
    descriptors: UInt8[np.ndarray, "features 128"],
    model: SweepModel,
    camera: Camera,
    radius_px: float,
) -> tuple[Int[np.ndarray, " matches"], Int[np.ndarray, " matches"]]:
    """Match features with the points that project nearby; a feature and a point are used once.

    A point is represented by the mean of its descriptors; a rival within the radius must be clearly less
    alike.
    """
    from scipy.spatial import KDTree

    projected = camera.project(model.xyz)
    inside = np.isfinite(projected).all(1) & (projected > 0).all(1)
    inside &= (projected[:, 0] < camera.width) & (projected[:, 1] < camera.height)
    candidates = np.flatnonzero(inside)
    mean = np.zeros((len(model.xyz), 128), dtype=np.float32)
    np.add.at(mean, model.obs_point, _unit(model.obs_descriptor))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-6)
    own = _unit(descriptors)
    near = KDTree(xy).query_ball_point(projected[candidates], radius_px)
    found: list[tuple[float, int, int]] = []
    for point, features in zip(candidates, near, strict=True):
        if not features:
            continue
        distance = np.sqrt(np.maximum(2 - 2 * own[features] @ mean[point], 0.0))
        order = np.argsort(distance, kind="stable")
        first = float(distance[order[0]])
        if first > MAX_DISTANCE:
            continue
        # SIFT puts up to two orientations on one place: such a twin is no rival
        rivals = [i for i in order[1:] if np.linalg.norm(xy[features[i]] - xy[features[order[0]]]) > 1.0]
        if rivals and first > RATIO * float(distance[rivals[0]]):
            continue
        found.append((first, features[order[0]], int(point)))
    taken_feature: set[int] = set()
    pairs = []
    for _, feature, point in sorted(found):
        if feature not in taken_feature:
            taken_feature.add(feature)
            pairs.append((feature, point))
    result = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return result[:, 0], result[:, 1]


def _orthonormal(pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    u, _, vt = np.linalg.svd(pose[:, :3])
    return np.column_stack([u @ vt, pose[:, 3]])
