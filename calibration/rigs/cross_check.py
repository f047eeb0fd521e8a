"""What a rig measures: millimetres between board corners at instants that no fit has seen.

Corners are triangulated one by one, without the knowledge that they lie on a board; then the distances of
neighbours are compared with the print. A small reprojection error proves little: focal length, distance and the
clocks can err together and keep it small (mrcal).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.boards.find import BoardSpec
from devrf.calibration.bundle.adjust import adjust
from devrf.calibration.bundle.model import image_rate
from devrf.calibration.bundle.problem import Problem, bodies_of_points
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import boards_before, rig_from_board
from devrf.calibration.rigs.board_views import TimedView, Views
from devrf.capture.camera import Camera
from devrf.capture.system.errors import HealthError

HELD_OUT_S = 0.8  # in a row: a picture's time and motion need neighbours that are held out too
HELD_OUT_EVERY = 3  # a third of these stretches


@dataclass(frozen=True)
class RigCheck:
    """Triangulated board corners against the print.

    Attributes:
        lengths_m: Distances of neighbouring corners [N]; true_m: of the print.
        distance_m: Median distance from the cameras to the middle of each of these [N].
        error_px: Reprojection error of every triangulated corner in every picture [K].
    """

    lengths_m: Float[np.ndarray, " lengths"]
    true_m: float
    distance_m: Float[np.ndarray, " lengths"]
    error_px: Float[np.ndarray, " errors"]

    @property
    def error_percent(self) -> float:
        """Of the median length."""
        return 100 * abs(float(np.median(self.lengths_m)) / self.true_m - 1)

    @property
    def spread_mm(self) -> float:
        """Standard deviation of the lengths."""
        return 1e3 * float(np.std(self.lengths_m))

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error."""
        return float(np.sqrt((self.error_px**2).mean()))


def hold_out(
    views: Mapping[str, list[TimedView]],
) -> tuple[dict[str, list[TimedView]], dict[str, list[TimedView]]]:
    """Views to fit, and those of every third stretch of time to check with."""
    begin = min((v.time_s for own in views.values() for v in own), default=0.0)

    def held(view: TimedView) -> bool:
        return int((view.time_s - begin) / HELD_OUT_S) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1

    return (
        {n: [v for v in own if not held(v)] for n, own in views.items()},
        {n: [v for v in own if held(v)] for n, own in views.items()},
    )


def cross_check(
    views: Mapping[str, list[TimedView]],
    spec: BoardSpec,
    start: Mapping[str, Intrinsics],
    known: Mapping[str, Intrinsics],
) -> RigCheck | None:
    """Fit the rig without a third of the views and check it with these; None where a part is too small for it."""
    fit, held = hold_out(views)
    try:
        rig = rig_from_board(fit, spec, start, known)
    except HealthError:
        return None
    return check_rig(rig.cameras, rig.delay_s, {n: held[n] for n in rig.cameras}, spec)


def check_rig(
    cameras: Mapping[str, Camera],
    delay_s: Mapping[str, float],
    views: Mapping[str, list[TimedView]],
    spec: BoardSpec,
    timed: bool = True,
) -> RigCheck | None:
    """Triangulate the corners of every instant; None where no two cameras see a corner at once.

    Args:
        cameras: The rig, metres.
        delay_s: What has to be added to each camera's times, as `BoardRig.delay_s`.
        views: Of the board, best such that no fit has seen.
        spec: The board.
        timed: Whether every picture is first brought to the middle of its instant, along the motion that the
            board shows; else the pictures of an instant count as simultaneous.
    """
    views = {n: own for n, own in views.items() if own}
    if len(views) < 2:
        return None
    solution, seen = boards_before({n: cameras[n] for n in views}, delay_s, views, spec)
    xy = seen.obs_xy
    if timed:
        timing = solution.problem.timing
        assert timing is not None
        late = seen.offset_s(timing.delay_s) + timing.lag_s
        xy = xy - image_rate(solution.problem) * late[seen.obs_view][:, None]
    return _triangulated(solution.problem, seen, xy, spec)


def _triangulated(
    problem: Problem, seen: Views, xy: Float[np.ndarray, "observations 2"], spec: BoardSpec
) -> RigCheck | None:
    """Each corner of each instant as a point of its own, from where its board stands."""
    corner = seen.instant[seen.obs_view] * len(spec.corners) + seen.obs_id
    number, point, count = np.unique(corner, return_inverse=True, return_counts=True)
    twice = count[point] > 1
    if not twice.any():
        return None
    number, point = np.unique(corner[twice], return_inverse=True)
    board = problem.bodies[number // len(spec.corners)]
    at = np.einsum("nij,nj->ni", board[:, :, :3], spec.corners[number % len(spec.corners)]) + board[:, :, 3]
    n = int(twice.sum())
    solution = adjust(
        replace(
            problem,
            free_intrinsics=np.zeros_like(problem.free_intrinsics),
            bodies=bodies_of_points(at),
            freedom=np.full(len(at), 3),
            obs_camera=seen.camera[seen.obs_view][twice],
            obs_body=point,
            obs_local=np.zeros((n, 3)),
            obs_xy=xy[twice],
            obs_std=problem.obs_std[twice],
            timing=None,
        ),
        "linear",
    )
    a, b = _neighbours(number, spec)
    points = solution.problem.points
    middle = (points[a] + points[b]) / 2
    centres = np.array([-p[:, :3].T @ p[:, 3] for p in problem.poses])
    return RigCheck(
        lengths_m=np.linalg.norm(points[a] - points[b], axis=1),
        true_m=spec.square_m,
        distance_m=np.median(np.linalg.norm(middle[:, None] - centres, axis=2), axis=1),
        error_px=np.linalg.norm(solution.residual_px, axis=1),
    )


def _neighbours(
    number: Int[np.ndarray, " points"], spec: BoardSpec
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs of points of one instant whose corners are one square apart."""
    instant, place = number // len(spec.corners), spec.corners[number % len(spec.corners)]
    a, b = np.triu_indices(len(number), 1)
    same = instant[a] == instant[b]
    a, b = a[same], b[same]
    near = np.abs(np.linalg.norm(place[a] - place[b], axis=1) - spec.square_m) < 1e-6 * spec.square_m
    return a[near], b[near]
