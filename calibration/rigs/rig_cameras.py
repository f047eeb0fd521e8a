"""A fixed camera of an adjusted problem, with its doubts and what supports it, as rig.json tells it."""

from typing import Any

import numpy as np
from jaxtyping import Int

from devrf.calibration.bundle.adjust import BundleSolution
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.registration import camera_of
from devrf.calibration.rigs.rig import RigCamera

RESIDUALS = 500  # of each camera that are told, for a picture of them


def rig_camera(
    solution: BundleSolution,
    index: int,
    like: Intrinsics,
    source: str,
    support: Int[np.ndarray, " n"],
    details: dict[str, Any],
) -> RigCamera:
    """Camera `index` of a solved problem.

    Args:
        like: For size and lens model.
        source: Of the intrinsics, see `RigCamera`.
        support: Observations that count as support.
        details: More to tell.
    """
    problem = solution.problem
    camera = camera_of(problem, like, index)
    covariance = solution.pose_covariance[index]
    R = camera.cam_from_world[:, :3]
    variance = np.maximum(np.diag(covariance)[3:], 0.0)
    error = np.linalg.norm(solution.residual_px[support], axis=1)
    distance = np.linalg.norm(problem.points[problem.obs_body[support]] - camera.centre, axis=1)
    shown = support[:: max(1, -(-len(support) // RESIDUALS))]
    rows = np.concatenate([problem.obs_xy[shown].round(1), solution.residual_px[shown].round(3)], axis=1)
    return RigCamera(
        camera=camera,
        intrinsics_source=source,
        rotation_std_deg=float(np.degrees(np.sqrt(max(np.trace(covariance[:3, :3]), 0.0)))),
        position_std=float(np.sqrt(variance.sum())),
        inliers=len(support),
        rms_px=float(np.sqrt((error**2).mean())) if len(error) else None,
        details=details
        | {
            "axis_std": float(np.sqrt(variance[2])),
            "sideways_std": float(np.sqrt(variance[:2].mean())),
            # the centre is -R^T t; a step (w, d) of the pose moves it by -R^T d, whatever the turn
            "position_covariance": (R.T @ covariance[3:, 3:] @ R).tolist(),
            "focal_px": float(camera.K[0, 0]),
            "focal_std_px": float(solution.intrinsics_std[problem.device[index], 0]),
            "median_distance": float(np.median(distance)) if len(distance) else None,
            "residuals": rows.tolist(),  # x, y, dx, dy, pixels
        },
    )
