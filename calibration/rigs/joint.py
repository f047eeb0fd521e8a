"""One bundle adjustment over all that is known of a rig: points of the sweep and boards seen in common.

The sweep's problem gives the world; the board's problem is moved into it by the cameras that both know. The
sweep's cameras stay; fixed cameras, their intrinsics, points, boards, clocks and the length of the board's metre in
the sweep's unit move, under one robust loss, each kind of observation weighed by the noise it has shown.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from devrf.calibration.bundle.adjust import BundleSolution, adjust
from devrf.calibration.bundle.problem import Problem, ViewTiming
from devrf.calibration.rigs.board_motion import still
from devrf.calibration.rigs.board_route import MIN_NOISE_PX, BoardRig
from devrf.calibration.truth import rotation_angle_deg, similarity
from devrf.capture.camera import Camera

TELLING = 3  # cameras whose places fix a rig's in another world, and show whether they fit


def world_from_rig(world: Mapping[str, Camera], rig: Mapping[str, Camera]) -> Float[np.ndarray, "4 4"]:
    """Similarity between two worlds in which the same cameras stand: scale, rotation, translation.

    The turn is the mean of the cameras' own turns (two cameras are enough), the scale the median ratio of their
    distances.
    """
    names = [n for n in rig if n in world]
    mean = sum(world[n].cam_from_world[:, :3].T @ rig[n].cam_from_world[:, :3] for n in names)
    u, _, vt = np.linalg.svd(np.asarray(mean))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    a, b = (np.array([c[n].centre for n in names]) for c in (world, rig))
    i, j = np.triu_indices(len(names), 1)
    scale = np.median(np.linalg.norm(a[i] - a[j], axis=1) / np.linalg.norm(b[i] - b[j], axis=1))
    out = np.eye(4)
    out[:3, :3] = scale * R
    out[:3, 3] = (a - scale * b @ R.T).mean(0)
    return out


@dataclass(frozen=True)
class PlacedRig:
    """A rig in another world.

    Attributes:
        world_from_rig: Similarity [4, 4].
        fitted: Cameras that it was fitted to.
        off: Camera -> its distance from where the world has it, units of the world.
    """

    world_from_rig: Float[np.ndarray, "4 4"]
    fitted: tuple[str, ...]
    off: dict[str, float]


def rig_in_world(rig: Mapping[str, Camera], world: Mapping[str, Camera], most: float) -> PlacedRig:
    """Where a rig stands by the places of its cameras, without those that were moved since it was calibrated.

    While a camera is off by more than `most` and `TELLING` others are left, the one without which these fit best goes.
    """
    placed, names = _placed(rig, world, list(rig)), list(rig)
    while max(placed.off[n] for n in names) > most and len(names) > TELLING:
        tries = [_placed(rig, world, [n for n in names if n != moved]) for moved in names]
        placed = min(tries, key=lambda one: max(one.off[n] for n in one.fitted))
        names = list(placed.fitted)
    return placed


def _placed(rig: Mapping[str, Camera], world: Mapping[str, Camera], names: list[str]) -> PlacedRig:
    a, b = (np.array([cameras[n].centre for n in names]) for cameras in (rig, world))
    found = similarity(a, b)
    off = {n: float(np.linalg.norm(c.moved(found).centre - world[n].centre)) for n, c in rig.items()}
    return PlacedRig(found, tuple(names), off)


def disagreement(world: Mapping[str, Camera], rig: Mapping[str, Camera]) -> dict[str, tuple[float, float]]:
    """How far the cameras of two rigs differ after `world_from_rig`: name -> (degrees, units of the world)."""
    similarity = world_from_rig(world, rig)
    moved = {n: c.moved(similarity) for n, c in rig.items() if n in world}
    return {
        n: (
            rotation_angle_deg(c.cam_from_world[:, :3], world[n].cam_from_world[:, :3]),
            float(np.linalg.norm(c.centre - world[n].centre)),
        )
        for n, c in moved.items()
    }


def median_baseline(cameras: Mapping[str, Camera]) -> float:
    """Median distance between two cameras."""
    centres = np.array([c.centre for c in cameras.values()])
    i, j = np.triu_indices(len(centres), 1)
    return float(np.median(np.linalg.norm(centres[i] - centres[j], axis=1)))


def adjust_together(
    sweep: BundleSolution, index: Mapping[str, int], cameras: Mapping[str, Camera], board: BoardRig
) -> BundleSolution:
    """Adjust the sweep's and the board's problem as one; `unit` of the result is the sweep's unit per metre.

    Args:
        sweep: Solved problem with the fixed cameras in it.
        index: Name -> camera of the sweep's problem; cameras: as it found them.
        board: Solved board route.
    """
    similarity = world_from_rig(cameras, board.cameras)
    boards = moved(board.solution.problem, similarity)
    return adjust(_merged(sweep, boards, [index[n] for n in board.views.names], board.solution.sigma_px))


def moved(problem: Problem, similarity: Float[np.ndarray, "4 4"]) -> Problem:
    """A board problem seen from a world mapped by a similarity [4, 4]; its cameras too."""
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    R, t = similarity[:3, :3] / scale, similarity[:3, 3]

    def place(x: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
        return np.concatenate([R @ x[:, :, :3], (scale * x[:, :, 3] @ R.T + t)[:, :, None]], axis=2)

    poses = problem.poses.copy()
    poses[:, :, :3] = poses[:, :, :3] @ R.T
    poses[:, :, 3] = scale * poses[:, :, 3] - poses[:, :, :3] @ t
    timing = problem.timing
    assert timing is not None
    turn = R @ timing.carry[:, :, :3] @ R.T
    carry = np.concatenate([turn, (scale * timing.carry[:, :, 3] @ R.T + t - turn @ t)[:, :, None]], axis=2)
    spin = timing.spin @ R.T
    velocity = scale * timing.velocity @ R.T - np.cross(spin, t)
    return replace(
        problem,
        poses=poses,
        bodies=place(problem.bodies),
        unit=scale * problem.unit,
        timing=replace(timing, carry=carry, spin=spin, velocity=velocity),
    )


def _merged(sweep: BundleSolution, boards: Problem, camera: list[int], corner_std_px: float) -> Problem:
    """The sweep's problem and the boards in it; `camera` is where each of the boards' cameras is in the sweep's."""
    points, where = sweep.problem, np.array(camera)
    timing = boards.timing
    assert timing is not None
    views, device = len(timing.lag_s), points.device[where]
    known = {
        name: _with_rows(getattr(points, name), device, getattr(boards, name)[boards.device])
        for name in ("intrinsics", "free_intrinsics", "one_focal", "prior_mean", "prior_std", "firm_prior")
    }
    rest = still(np.full(len(points.obs_body), views), len(points.poses), 1)  # the points' view comes last
    both = ViewTiming(
        view=np.concatenate([rest.view, timing.view]),
        carry=np.concatenate([timing.carry, rest.carry]),
        carried_s=np.append(timing.carried_s, 0.0),
        spin=np.concatenate([timing.spin, rest.spin]),
        velocity=np.concatenate([timing.velocity, rest.velocity]),
        delay_s=_with_rows(rest.delay_s, where, timing.delay_s),
        delay_std_s=timing.delay_std_s,
        free_delay=_with_rows(rest.free_delay, where, timing.free_delay),
        lag_s=np.append(timing.lag_s, 0.0),
        lag_std_s=timing.lag_std_s,
    )
    noise = (max(sweep.sigma_px, MIN_NOISE_PX), max(corner_std_px, MIN_NOISE_PX))
    return replace(
        points,
        **known,
        bodies=np.concatenate([points.bodies, boards.bodies]),
        freedom=np.concatenate([points.freedom, boards.freedom]),
        obs_camera=np.concatenate([points.obs_camera, where[boards.obs_camera]]),
        obs_body=np.concatenate([points.obs_body, len(points.bodies) + boards.obs_body]),
        obs_local=np.concatenate([points.obs_local, boards.obs_local]),
        obs_xy=np.concatenate([points.obs_xy, boards.obs_xy]),
        obs_std=np.repeat(noise, [len(points.obs_body), len(boards.obs_body)]),
        unit=boards.unit,
        free_unit=True,
        timing=both,
    )


def _with_rows(all_rows: np.ndarray, rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    out = all_rows.copy()
    out[rows] = new
    return out
