"""Intrinsics of a camera from views of a board (Zhang, PAMI 2000), with honest standard deviations.

Blurred views are left out, views that do not fit are dropped by a quantile rule. Two starts are tried, because a
long lens has a second minimum. A lens model is as rich as the views support: a richer one must pay by the Bayesian
information criterion, with the noise of the richest, and one of its new coefficients must exceed its
standard deviation. A bow of the board must exceed three.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool

from devrf.calibration.boards.board_fit import (
    BOW,
    GLOBALS,
    Corners,
    Fit,
    coordinate_sigma,
    cost,
    gather,
    minimise,
    of_views,
    residual,
    start_fit,
)
from devrf.calibration.boards.coverage import BoardCoverage, gather_evidence
from devrf.calibration.boards.detect import misfit, misread
from devrf.calibration.boards.spec import BoardSpec, BoardView
from devrf.calibration.intrinsics import PARAMETERS, Intrinsics, guess
from devrf.capture.camera import LensModel
from devrf.capture.system.errors import HealthError

LensChoice = Literal["auto", "pinhole", "fisheye"]

MIN_VIEWS = 4
MAX_VIEWS = 40  # more cost time and gain nothing
BLURRED = 0.2  # of a square: wider edges leave too little of the window in which corners are found, ...
BLURRED_PX = 3.0  # ... if they are wider than this too (OpenCV calls less sharp)
ENOUGH_SHARP = 10  # blurred views are left out where so many others remain
OUTLIER_MEDIANS = 3.0  # a view is dropped beyond this multiple of the median error, ...
OUTLIER_PX = 0.5  # ... if it is beyond this too
WORST_SHARE = 0.3  # of the worst error: only the like of it goes in one round, it may have spoilt the others
ROUNDS = 6
START_HUBER_PX = 1.0
HUBER_SIGMAS = 3.0
MIN_SIGMA_PX = 0.01  # exact views have no noise, but rounding
SIGNIFICANT = 1.0  # standard deviations: a term left out costs its square, one kept costs its variance
BOW_SIGNIFICANT = 3.0
SECOND_START_GAIN = 0.99  # the second start must be better than chance
DECISIVE = 10.0  # difference of the criterion that counts as very strong (Kass and Raftery 1995)
FISHEYE_FROM_DEG = 90.0  # across the picture's diagonal; narrower lenses look alike in both models
NARROW_DEG = 70.0  # a pinhole that fits and is narrower is not compared at all
HELD_OUT_FROM = 9  # views, a third of which are held out


@dataclass(frozen=True)
class Terms:
    """What of a lens is fitted beside one focal length and the principal point: names of the coefficients."""

    model: LensModel
    coefficients: tuple[str, ...]
    one_focal: bool = True

    @property
    def free(self) -> Bool[np.ndarray, "11"]:
        """Which globals of `fit` move."""
        free = np.zeros(GLOBALS, dtype=bool)
        free[:4] = True
        names = PARAMETERS if self.model == "OPENCV" else FISHEYE_PARAMETERS
        free[[names.index(c) for c in self.coefficients]] = True
        return free

    @property
    def words(self) -> str:
        """For people: `k1, k2`."""
        kind = "fisheye " if self.model == "OPENCV_FISHEYE" else ""
        focal = "" if self.one_focal else ", fx and fy"
        return kind + (", ".join(self.coefficients) or "no distortion") + focal


FISHEYE_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
PINHOLE = (  # from simple to rich; the third is the start of all
    Terms("OPENCV", ()),
    Terms("OPENCV", ("k1",)),
    Terms("OPENCV", ("k1", "k2")),
    Terms("OPENCV", ("k1", "k2", "p1", "p2"), one_focal=False),
    Terms("OPENCV", ("k1", "k2", "p1", "p2", "k3"), one_focal=False),
)
FISHEYE = (
    Terms("OPENCV_FISHEYE", ()),
    Terms("OPENCV_FISHEYE", ("k1",)),
    Terms("OPENCV_FISHEYE", ("k1", "k2")),
    Terms("OPENCV_FISHEYE", ("k1", "k2", "k3")),
    Terms("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    Terms("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4"), one_focal=False),
)
START = 2
FIVE_COEFFICIENTS = PINHOLE[-1]


@dataclass(frozen=True)
class BoardCalibration:
    """Intrinsics from a board, and how well the views support them.

    Attributes:
        intrinsics: With standard deviations.
        board: As it was found to be printed.
        rms_px: Root mean square reprojection error per corner, as OpenCV counts.
        terms: What of the lens was fitted.
        views: Views that were used.
        dropped: Frames of the views that did not fit, and their error, pixels.
        blurred: Frames of the views that were left out as blurred.
        start_rms_px: Error from the first start and from the second.
        bow_mm, bow_std_mm: How far the board's middle stands out along x and y; zero where not significant.
        held_out_rms_px: Error on a third of the views, the lens fitted on the others; None with few views.
        evidence: Of the views.
    """

    intrinsics: Intrinsics
    board: BoardSpec
    rms_px: float
    terms: Terms
    views: int
    dropped: dict[int, float]
    blurred: tuple[int, ...]
    start_rms_px: tuple[float, float]
    bow_mm: tuple[float, float]
    bow_std_mm: tuple[float, float]
    held_out_rms_px: float | None
    evidence: BoardCoverage

    def as_dict(self) -> dict[str, Any]:
        """For JSON; see docs/formats.md."""
        k = self.intrinsics
        names = PARAMETERS if k.model == "OPENCV" else FISHEYE_PARAMETERS
        std = np.zeros(9) if k.std is None else k.std
        return {
            "model": k.model,
            "terms": self.terms.words,
            "std": dict(zip(names, std.tolist(), strict=False)),
            "rms_px": self.rms_px,
            "held_out_rms_px": self.held_out_rms_px,
            "dropped": [[frame, round(rms, 3)] for frame, rms in self.dropped.items()],
            "blurred": list(self.blurred),
            "start_rms_px": list(self.start_rms_px),
            "bow_mm": list(self.bow_mm),
            "bow_std_mm": list(self.bow_std_mm),
            **self.evidence.as_dict(),
        }


def calibrate_intrinsics(
    name: str,
    views: list[BoardView],
    spec: BoardSpec,
    size: tuple[int, int],
    lens: LensChoice | Terms = "auto",
    pixel_aspect: float = 1.0,
) -> BoardCalibration:
    """Calibrate one camera.

    Args:
        name: Of the camera, for messages.
        views: Of the board.
        spec: The settled board.
        size: Picture (width, height), pixels.
        lens: Which lens model, of which the terms that the views support are fitted, or exactly these terms; auto takes
            the model that fits better, a fisheye only where the view is wide.
        pixel_aspect: Width of a pixel over its height. All is fitted in square pixels of the same height; only the
            intrinsics are in the picture's own.
    Raises:
        HealthError: Too few views.
    """
    if pixel_aspect != 1:
        wide = [replace(view, xy=view.xy * [pixel_aspect, 1.0]) for view in views]
        found = calibrate_intrinsics(name, wide, spec, (round(size[0] * pixel_aspect), size[1]), lens)
        return replace(found, intrinsics=_narrowed(found.intrinsics, size, pixel_aspect))
    sharp, blurred = _sharp_views(views)
    if len(sharp) < MIN_VIEWS:
        text = f"camera '{name}': the board is seen in {len(views)} pictures, need {MIN_VIEWS} (20 are good)"
        remedy = "film it longer, larger in the picture and tilted by 20 to 45 degrees"
        raise HealthError("board-rarely-seen", f"{text}; {remedy}")
    models = {"auto": [PINHOLE, FISHEYE], "pinhole": [PINHOLE], "fisheye": [FISHEYE]}
    families = [(lens,)] if isinstance(lens, Terms) else models[lens]
    wrong = {v.frame: misfit(spec, v.ids, v.xy) for v in sharp if misread(spec, v.ids, v.xy)}
    dropped = wrong if len(sharp) - len(wrong) >= MIN_VIEWS else {}
    kept = _spread_views([v for v in sharp if v.frame not in dropped])
    chosen = _choose(gather(kept, spec.corners), size, families)
    for _ in range(ROUNDS):
        rms = chosen.fit.view_rms_px
        limit = max(OUTLIER_PX, OUTLIER_MEDIANS * float(np.median(rms)))
        bad = rms > max(limit, WORST_SHARE * float(rms.max()))
        if not bad.any() or len(kept) - bad.sum() < MIN_VIEWS:
            break
        dropped |= {view.frame: float(e) for view, e, b in zip(kept, rms, bad, strict=True) if b}
        kept = [view for view, b in zip(kept, bad, strict=True) if not b]
        chosen = _choose(gather(kept, spec.corners), size, families)
    fit = chosen.fit
    bow, bow_std = 1e3 * fit.globals[BOW], 1e3 * fit.std[BOW]
    return BoardCalibration(
        intrinsics=fit.intrinsics,
        board=spec,
        rms_px=fit.rms_px,
        terms=chosen.terms,
        views=len(kept),
        dropped=dict(sorted(dropped.items())),
        blurred=blurred,
        start_rms_px=chosen.start_rms_px,
        bow_mm=(float(bow[0]), float(bow[1])),
        bow_std_mm=(float(bow_std[0]), float(bow_std[1])),
        held_out_rms_px=_held_out_rms(fit),
        evidence=gather_evidence(fit, [view.frame for view in kept]),
    )


@dataclass(frozen=True)
class _Choice:
    fit: Fit
    terms: Terms
    start_rms_px: tuple[float, float]


def _narrowed(k: Intrinsics, size: tuple[int, int], pixel_aspect: float) -> Intrinsics:
    """Intrinsics of square pixels in pixels that are wider by `pixel_aspect`."""
    std = None if k.std is None else k.std / [pixel_aspect, 1, pixel_aspect, 1, 1, 1, 1, 1, 1]
    return Intrinsics(*size, np.diag([1 / pixel_aspect, 1, 1]) @ k.K, k.distortion, std, k.model)


def _sharp_views(views: list[BoardView]) -> tuple[list[BoardView], tuple[int, ...]]:
    blurred = [v for v in views if v.blur > BLURRED and v.blur_px > BLURRED_PX]
    if not blurred or len(views) - len(blurred) < ENOUGH_SHARP:
        return list(views), ()
    frames = {v.frame for v in blurred}
    return [v for v in views if v.frame not in frames], tuple(sorted(frames))


def _choose(corners: Corners, size: tuple[int, int], families: Sequence[Sequence[Terms]]) -> _Choice:
    """The lens model and the terms that the views support."""
    best = _choose_terms(corners, size, families[0])
    for family in families[1:]:
        if _view_deg(best.fit) < NARROW_DEG and best.fit.rms_px < OUTLIER_PX:
            break
        other = _choose_terms(corners, size, family)
        sigma = max(min(coordinate_sigma(best.fit), coordinate_sigma(other.fit)), MIN_SIGMA_PX)
        wide = _view_deg(other.fit) > FISHEYE_FROM_DEG
        if wide and _criterion(other.fit, sigma) + DECISIVE < _criterion(best.fit, sigma):
            best = other
    return _bowed(best)


def _choose_terms(corners: Corners, size: tuple[int, int], family: Sequence[Terms]) -> _Choice:
    start, start_rms = _best_start(corners, size, family[min(START, len(family) - 1)])
    richest = _refined(start, family[-1], START_HUBER_PX)
    sigma = max(coordinate_sigma(richest), MIN_SIGMA_PX)
    fits = [_refined(richest if t is family[-1] else start, t, HUBER_SIGMAS * sigma) for t in family]
    chosen = 0
    for n in range(1, len(family)):
        pays = _criterion(fits[n], sigma) < _criterion(fits[chosen], sigma)
        if pays and _new_terms(fits[n], fits[chosen], SIGNIFICANT):
            chosen = n
    return _Choice(fits[chosen], family[chosen], start_rms)


def _best_start(corners: Corners, size: tuple[int, int], terms: Terms) -> tuple[Fit, tuple[float, float]]:
    """The better of two starts, and the error that each led to."""
    fits = []
    for focal in _start_focals(corners, size, terms.model):
        camera = replace(guess(*size, focal), model=terms.model)
        fit = minimise(start_fit(corners, camera, terms.free, terms.one_focal), START_HUBER_PX)
        # poses that had flipped turn back
        again = start_fit(corners, fit.intrinsics, terms.free, terms.one_focal)
        flipped = cost(again, START_HUBER_PX) < cost(fit, START_HUBER_PX)
        fits.append(minimise(again, START_HUBER_PX) if flipped else fit)
    first, second = fits
    better = second.rms_px < SECOND_START_GAIN * first.rms_px
    return (second if better else first), (first.rms_px, second.rms_px)


def _start_focals(corners: Corners, size: tuple[int, int], model: LensModel) -> tuple[float, float]:
    """From the views' homographies and the longest side; of a fisheye for 180 and for 120 degrees along it."""
    longest = float(max(size))
    if model == "OPENCV_FISHEYE":
        return longest / np.pi, longest / (2 * np.pi / 3)
    views = [corners.view == v for v in range(int(corners.view.max()) + 1)]
    on_board = [corners.on_board[v].astype(np.float32) for v in views]
    in_picture = [(corners.xy[v] - 0.5).astype(np.float32) for v in views]
    focal = float(cv2.initCameraMatrix2D(on_board, in_picture, size, 1.0)[0, 0])
    sane = np.isfinite(focal) and 0.2 * longest < focal < 20 * longest
    return (focal if sane else 0.8 * longest), longest


def _refined(fit: Fit, terms: Terms, huber_px: float) -> Fit:
    g = np.where(terms.free, fit.globals, 0.0)
    fit = replace(fit, globals=g, free=terms.free, one_focal=terms.one_focal)
    return minimise(replace(fit, residual=residual(fit)), huber_px)


def _criterion(fit: Fit, sigma: float) -> float:
    """Bayesian information criterion with a known, robust noise (Schwarz 1978)."""
    return cost(fit, HUBER_SIGMAS * sigma) / sigma**2 + fit.unknowns * np.log(fit.residual.size)


def _new_terms(rich: Fit, simple: Fit, deviations: float) -> bool:
    """Whether one of the globals that only the richer fit moves is larger than its doubt."""
    new = rich.free & ~simple.free
    significant = np.abs(rich.globals[new]) > deviations * rich.std[new]
    focal = simple.one_focal and not rich.one_focal
    apart = abs(rich.globals[1] - rich.globals[0]) > deviations * np.hypot(rich.std[0], rich.std[1])
    return bool(significant.any() or (focal and apart))


def _bowed(choice: _Choice) -> _Choice:
    """With a bow of the board, where the views show one beyond doubt."""
    sigma = max(coordinate_sigma(choice.fit), MIN_SIGMA_PX)
    free = choice.fit.free.copy()
    free[BOW] = True
    bowed = minimise(replace(choice.fit, free=free), HUBER_SIGMAS * sigma)
    pays = _criterion(bowed, sigma) + DECISIVE < _criterion(choice.fit, sigma)
    return replace(choice, fit=bowed) if pays and _new_terms(bowed, choice.fit, BOW_SIGNIFICANT) else choice


def _held_out_rms(fit: Fit) -> float | None:
    """Error on a third of the views, whose poses alone are fitted to the lens of the others."""
    count = len(fit.poses)
    if count < HELD_OUT_FROM:
        return None
    held = np.zeros(count, dtype=bool)
    held[np.random.default_rng(0).permutation(count)[: count // 3]] = True
    huber = HUBER_SIGMAS * max(coordinate_sigma(fit), MIN_SIGMA_PX)
    lens = minimise(of_views(fit, ~held), huber)
    rest = replace(of_views(fit, held), globals=lens.globals, free=np.zeros(GLOBALS, dtype=bool))
    return minimise(replace(rest, residual=residual(rest)), huber).rms_px


def _view_deg(fit: Fit) -> float:
    """Angle of view between the picture's corners."""
    w, h = fit.size
    rays = fit.intrinsics.at(np.eye(3, 4)).directions(np.array([[0.0, 0], [w, h], [w, 0], [0, h]]))
    return float(2 * np.degrees(np.arccos(np.clip(rays[:, 2].min(), -1, 1))))


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
