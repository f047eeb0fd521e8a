"""Fixed cameras into the sweep's model: register one clean picture each, then refine all together.

The sweep stays where structure from motion put it. The joint refinement moves the fixed cameras, their
intrinsics as far as their priors allow, and every 3D point that they see, against all observations of these
points by the sweep and by the fixed cameras, with a Cauchy loss. Standard deviations come from the
same system.
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.bundle import Problem, adjust
from devrf.calibration.intrinsics import Intrinsics, guess
from devrf.calibration.registration import (
    Registration,
    camera_of,
    free_intrinsics,
    has_one_focal,
    prior_std,
    register,
    weak_prior,
)
from devrf.calibration.rig import RigCamera
from devrf.calibration.sfm_process import run_job
from devrf.calibration.static_poses import SweepModel, feature_options
from devrf.capture.errors import HealthError
from devrf.capture.progress import Progress, no_progress

MIN_INLIERS = 30  # COLMAP's own minimum for a pose
PLENTY_INLIERS = 300  # another picture of the same camera would add nothing
INLIER_PX = 4.0


@dataclass(frozen=True)
class FixedCameraInput:
    """What is known of one fixed camera before registration.

    Attributes:
        name: Of the camera.
        pictures: Clean pictures of it; tried in this order, the one that registers best is used.
        width, height: Their size.
        intrinsics: Board calibration with standard deviations, or None.
    """

    name: str
    pictures: list[Path]
    width: int
    height: int
    intrinsics: Intrinsics | None


def rig_from_sweep(
    model: SweepModel,
    inputs: list[FixedCameraInput],
    out: Path,
    progress: Progress = no_progress,
) -> dict[str, RigCamera]:
    """Register and refine the fixed cameras, in the sweep's unit.

    Args:
        model: The sweep.
        inputs: The cameras.
        out: Folder for logs and temporary files.
        progress: Called per camera.
    Raises:
        HealthError: Cameras that share no view with the sweep, with their inlier counts.
    """
    features = _features(inputs, out)
    progress(0.2, "features of the fixed cameras")
    found: dict[str, tuple[Registration, str]] = {}
    refused = []
    for n, item in enumerate(inputs):
        registration, label, most = _best_registration(model, item, features)
        if registration is None or most < MIN_INLIERS:
            refused.append(
                f"{item.name} shares no view with the sweep: {most} inliers, need {MIN_INLIERS} "
                "(100 are good)"
            )
        else:
            found[item.name] = (registration, label)
        progress(0.2 + 0.6 * (n + 1) / len(inputs), f"{item.name}: {most} inliers")
    if refused:
        raise HealthError(
            "; ".join(refused) + ". Add sweep pictures from near these cameras, looking the same way, "
            "and check that they film the same place"
        )
    return _joint(model, inputs, found)


def _features(inputs: list[FixedCameraInput], out: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """SIFT of every clean picture, by file stem."""
    longest = max(max(item.width, item.height) for item in inputs)
    with tempfile.TemporaryDirectory(dir=out, prefix="work-") as work:
        pictures = Path(work) / "pictures"
        pictures.mkdir()
        names = []
        for item in inputs:
            for picture in item.pictures:
                shutil.copy(picture, pictures / picture.name)
                names.append(picture.name)
        job: dict[str, Any] = {
            "task": "extract",
            "work": work,
            "image_path": str(pictures),
            "names": names,
            "features": feature_options(longest),
            "out": work,
        }
        run_job(job, Path(work), out / "colmap.log")
        features = {}
        for name in names:
            with np.load(Path(work) / f"{Path(name).stem}.npz") as data:
                features[Path(name).stem] = (data["xy"], data["descriptors"])
    return features


def _best_registration(
    model: SweepModel, item: FixedCameraInput, features: dict[str, tuple[np.ndarray, np.ndarray]]
) -> tuple[Registration | None, str, int]:
    best: tuple[Registration | None, str, int] = (None, "", 0)
    for picture in item.pictures:
        xy, descriptors = features[picture.stem]
        known = item.intrinsics is not None
        start = item.intrinsics or guess(item.width, item.height)
        registration, inliers = register(xy, descriptors, model, start, known)
        if inliers > best[2]:
            best = (registration, picture.stem, inliers)
        if best[2] >= PLENTY_INLIERS:
            break
    return best


def _joint(
    model: SweepModel, inputs: list[FixedCameraInput], found: dict[str, tuple[Registration, str]]
) -> dict[str, RigCamera]:
    problem, first_own = _problem(model, inputs, found)
    solution = adjust(problem, "cauchy", 1.0)
    cameras = {}
    for n, item in enumerate(inputs):
        registration, label = found[item.name]
        c = len(model.cameras) + n
        like = item.intrinsics or guess(item.width, item.height)
        camera = camera_of(solution.problem, like, c)
        mine = np.flatnonzero(problem.obs_camera[first_own:] == c) + first_own
        error = np.linalg.norm(solution.residual_px[mine], axis=1)
        good = error < max(INLIER_PX * max(item.width, item.height) / 1000, 3 * solution.sigma_px)
        xy = problem.obs_xy[mine][good]
        covariance = solution.pose_covariance[c]
        axis = _axis_std(covariance)
        cameras[item.name] = RigCamera(
            camera=camera,
            intrinsics_source="self" if item.intrinsics is None else "board",
            rotation_std_deg=float(np.degrees(np.sqrt(np.trace(covariance[:3, :3])))),
            position_std=_centre_std(camera.cam_from_world, covariance),
            inliers=int(good.sum()),
            rms_px=float(np.sqrt((error[good] ** 2).mean())),
            details={
                "picture": label,
                "matches": registration.matches,
                "inlier_area": _hull_share(xy, item.width, item.height),
                "axis_std": axis[1],
                "sideways_std": axis[0],
                "focal_px": float(camera.K[0, 0]),
                "focal_std_px": float(solution.intrinsics_std[problem.device[c], 0]),
                "median_distance": float(
                    np.median(
                        np.linalg.norm(
                            solution.problem.points[problem.obs_point[mine]] - camera.centre, axis=1
                        )
                    )
                ),
            },
        )
    return cameras


def _problem(
    model: SweepModel, inputs: list[FixedCameraInput], found: dict[str, tuple[Registration, str]]
) -> tuple[Problem, int]:
    """Sweep (held) and fixed cameras with the points these see; and where their own observations begin."""
    S, F = len(model.cameras), len(inputs)
    registrations = [found[item.name][0] for item in inputs]
    points = np.unique(np.concatenate([r.points for r in registrations]))
    number = np.full(len(model.xyz), -1)
    number[points] = np.arange(len(points))
    seen = np.flatnonzero(number[model.obs_point] >= 0)
    sweep_vectors = np.array([_vector(model, n) for n in range(S)])
    devices, device_of = np.unique(sweep_vectors, axis=0, return_inverse=True)
    priors = []
    for item, r in zip(inputs, registrations, strict=True):
        priors.append(item.intrinsics or weak_prior(guess(item.width, item.height), len(r.points)))
    fixed_vectors = np.array([r.solution.problem.intrinsics[0] for r in registrations])
    D = len(devices)
    problem = Problem(
        poses=np.array(
            [c.cam_from_world for c in model.cameras] + [r.camera.cam_from_world for r in registrations]
        ),
        intrinsics=np.concatenate([devices, fixed_vectors]),
        device=np.concatenate([device_of.reshape(-1), D + np.arange(F)]),
        points=model.xyz[points],
        obs_camera=np.concatenate(
            [model.obs_image[seen], *(np.full(len(r.points), S + n) for n, r in enumerate(registrations))]
        ),
        obs_point=number[np.concatenate([model.obs_point[seen], *(r.points for r in registrations)])],
        obs_xy=np.concatenate([model.obs_xy[seen].astype(np.float64), *(r.xy for r in registrations)]),
        free_pose=np.arange(S + F) >= S,
        free_intrinsics=np.concatenate([np.zeros((D, 9), dtype=bool), [free_intrinsics(p) for p in priors]]),
        free_points=True,
        one_focal=np.concatenate([np.zeros(D, dtype=bool), [has_one_focal(p) for p in priors]]),
        prior_mean=np.concatenate([devices, [p.vector for p in priors]]),
        prior_std=np.concatenate([np.full((D, 9), np.inf), [prior_std(p) for p in priors]]),
    )
    return problem, len(seen)


def _vector(model: SweepModel, n: int) -> Float[np.ndarray, "9"]:
    c = model.cameras[n]
    return Intrinsics(c.width, c.height, c.K, c.distortion).vector


def _centre_std(cam_from_world: Float[np.ndarray, "3 4"], covariance: Float[np.ndarray, "6 6"]) -> float:
    """Standard deviation of the camera centre, from the pose's covariance in camera axes.

    The centre is -R^T t; a step (w, d) moves it by R^T (-d), whatever the turn (t turns along with R).
    """
    return float(np.sqrt(max(np.trace(covariance[3:, 3:]), 0.0)))


def _axis_std(covariance: Float[np.ndarray, "6 6"]) -> tuple[float, float]:
    """Standard deviation of the position sideways and along the optical axis."""
    variance = np.maximum(np.diag(covariance)[3:], 0.0)
    return float(np.sqrt(variance[:2].mean())), float(np.sqrt(variance[2]))


def _hull_share(xy: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """Area of the inliers' convex hull, as a share of the picture."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(xy).volume / (width * height))
    except (QhullError, ValueError):
        return 0.0
