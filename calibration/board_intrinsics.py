"""Intrinsics of a camera from views of a board (Zhang, PAMI 2000, through OpenCV's calibrateCameraExtended).

Two starts are tried, because a long lens has a second minimum; the simplest distortion that the views
support is kept (Bayesian information criterion); views that do not fit are dropped by a quantile rule.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np

from devrf.calibration.board import BoardSpec, BoardView
from devrf.calibration.intrinsics import HALF_PIXEL, Intrinsics
from devrf.capture.errors import HealthError

MIN_VIEWS = 4
MAX_VIEWS = 40  # more cost time and gain nothing
OUTLIER_MEDIANS = 3.0  # a view is dropped beyond this multiple of the median error, ...
OUTLIER_PX = 0.5  # ... if it is beyond this too
ROUNDS = 4
SECOND_START_GAIN = 0.99  # the second start must be better than chance
COVERAGE_CELLS = 5
BASE = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
MODELS = (  # from simple to rich: flags (never 262144, which also means the tilted model), free parameters
    (BASE | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3, 3),
    (BASE | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3, 4),
    (BASE | cv2.CALIB_FIX_K3, 5),
    (cv2.CALIB_FIX_K3, 8),
    (0, 9),
)


@dataclass(frozen=True)
class BoardCalibration:
    """Intrinsics from a board, and how well the views support them.

    Attributes:
        intrinsics: With standard deviations.
        rms_px: Root mean square reprojection error per corner.
        views: Views that were used; dropped: frames of the views that did not fit.
        coverage: Share of the picture's 5 x 5 cells in which corners were seen.
        tilted_views: Views of a board tilted by more than 15 degrees.
        second_start_better: Whether the start f = longest side beat OpenCV's own.
    """

    intrinsics: Intrinsics
    rms_px: float
    views: int
    dropped: tuple[int, ...]
    coverage: float
    tilted_views: int
    second_start_better: bool


def calibrate_intrinsics(
    name: str, views: list[BoardView], spec: BoardSpec, size: tuple[int, int]
) -> BoardCalibration:
    """Calibrate one camera.

    Args:
        name: Of the camera, for messages.
        views: Of the board.
        spec: The settled board.
        size: Picture (width, height), pixels.
    Raises:
        HealthError: Too few views.
    """
    if len(views) < MIN_VIEWS:
        raise HealthError(
            f"camera '{name}': the board is seen in {len(views)} pictures, need {MIN_VIEWS} (20 are good); "
            "film it longer, larger in the picture and tilted by 20 to 45 degrees"
        )
    kept, dropped = _spread_views(views), []
    best, second = _run(kept, spec, size)
    for _ in range(ROUNDS):
        bad = best.view_rms > max(OUTLIER_PX, OUTLIER_MEDIANS * float(np.median(best.view_rms)))
        if not bad.any() or len(kept) - bad.sum() < MIN_VIEWS:
            break
        dropped += [view.frame for view, b in zip(kept, bad, strict=True) if b]
        kept = [view for view, b in zip(kept, bad, strict=True) if not b]
        best, second = _run(kept, spec, size)
    std = best.std.copy()
    if best.flags & cv2.CALIB_FIX_ASPECT_RATIO:
        std[0] = std[1] = std[:2].max()
    return BoardCalibration(
        intrinsics=Intrinsics(*size, best.K + HALF_PIXEL, best.distortion, std),
        rms_px=best.rms,
        views=len(kept),
        dropped=tuple(sorted(dropped)),
        coverage=coverage(kept, size),
        tilted_views=int((best.tilt_deg > 15).sum()),
        second_start_better=second,
    )


def coverage(views: list[BoardView], size: tuple[int, int]) -> float:
    """Share of the picture's 5 x 5 cells in which corners were seen."""
    xy = np.concatenate([view.xy for view in views])
    cells = np.clip((xy / np.array(size) * COVERAGE_CELLS).astype(int), 0, COVERAGE_CELLS - 1)
    return len(np.unique(cells[:, 0] * COVERAGE_CELLS + cells[:, 1])) / COVERAGE_CELLS**2


@dataclass(frozen=True)
class _Fit:
    rms: float
    K: np.ndarray
    distortion: np.ndarray
    std: np.ndarray
    view_rms: np.ndarray
    tilt_deg: np.ndarray
    flags: int


def _run(views: list[BoardView], spec: BoardSpec, size: tuple[int, int]) -> tuple[_Fit, bool]:
    """The simplest model that the views support, from the better start; and whether the second one won."""
    n = 2 * sum(len(view.ids) for view in views)
    best, best_bic, worse = None, np.inf, 0
    for flags, parameters in MODELS:
        fit = _calibrate(views, spec, size, None, flags)
        bic = n * np.log(max(fit.rms, 1e-6) ** 2) + parameters * np.log(n)
        if bic < best_bic:
            best, best_bic, worse = fit, bic, 0
        else:
            worse += 1
            if worse == 2:
                break
    assert best is not None
    second = _calibrate(views, spec, size, float(max(size)), best.flags)
    return (second, True) if second.rms < SECOND_START_GAIN * best.rms else (best, False)


def _calibrate(
    views: list[BoardView], spec: BoardSpec, size: tuple[int, int], focal_px: float | None, flags: int
) -> _Fit:
    on_board = [spec.corners[view.ids].astype(np.float32) for view in views]
    in_picture = [(view.xy - 0.5).astype(np.float32) for view in views]
    K = np.array([[1.0, 0, (size[0] - 1) / 2], [0, 1.0, (size[1] - 1) / 2], [0, 0, 1]])
    if focal_px is not None:
        K[0, 0] = K[1, 1] = focal_px
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    with _one_thread():
        rms, K, distortion, rotations, _, std, _, view_rms = cv2.calibrateCameraExtended(
            on_board, in_picture, size, K, np.zeros(5), flags=flags
        )
    distortion = np.asarray(distortion, dtype=np.float64).reshape(-1)[:5]
    tilt = [np.degrees(np.arccos(np.clip(abs(cv2.Rodrigues(r)[0][2, 2]), 0, 1))) for r in rotations]
    return _Fit(
        float(rms),
        np.asarray(K, dtype=np.float64),
        distortion,
        np.asarray(std, dtype=np.float64).reshape(-1)[:9],
        np.asarray(view_rms, dtype=np.float64).reshape(-1),
        np.array(tilt),
        flags & ~cv2.CALIB_USE_INTRINSIC_GUESS,
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums of several threads differ from run to run in their last digits, and then so do the pairs COLMAP verifies."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _spread_views(views: list[BoardView]) -> list[BoardView]:
    """At most `MAX_VIEWS` views that differ most in place and size of the board (farthest point sampling)."""
    if len(views) <= MAX_VIEWS:
        return list(views)
    shape = np.array([[*v.xy.mean(0), *v.xy.std(0), 0.3 * len(v.ids)] for v in views])
    chosen = [int(np.argmax([len(v.ids) for v in views]))]
    distance = np.linalg.norm(shape - shape[chosen[0]], axis=1)
    while len(chosen) < MAX_VIEWS:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(shape - shape[chosen[-1]], axis=1))
    return [views[i] for i in sorted(chosen)]
