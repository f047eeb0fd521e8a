"""What some pictures of a fixed camera tell: does something move, is it at rest when it should be, does the sweep know
this view, did the light change."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.calibration.field.matching import Features, match, scale_of
from devrf.capture.light import LightMeter
from devrf.capture.stillness import SIDE_PX, moving_mask, moving_share, smooth_grey
from devrf.capture.survey import Picture

VERIFIED = 12  # matches of two pictures that are no chance
ALIKE_ENOUGH = 40  # matches by looks, of which it can be told whether they agree


@dataclass(frozen=True)
class FixedGlance:
    """What some pictures of one fixed camera tell.

    Attributes:
        subject_share: Share of the picture in which something moves over the clip.
        rest_share: Largest share that changes between successive pictures where the scene should be at rest; None:
            unknown.
        shared: Features at rest that the sweep shows too, in any of its pictures.
        subject_agrees, rest_agrees: Share of what looks alike in the sweep that also is where the sweep has it, on
            what will move and elsewhere; None where too little looks alike.
        light_stops: Largest change of brightness over the clip, stops; balance: of red or blue against green, relative.
    """

    subject_share: float
    rest_share: float | None
    shared: int | None
    subject_agrees: float | None
    rest_agrees: float | None
    light_stops: float
    balance: float


def glance_at_fixed(
    pictures: Sequence[Picture],
    rest: Sequence[Picture],
    at_rest: Features | None,
    sweep: Sequence[Features],
) -> FixedGlance:
    """Look at pictures of a clip.

    Args:
        pictures: Spread over the clip.
        rest: Successive ones, where the scene should be at rest.
        at_rest: Features of the first of them.
        sweep: Features of the sweep's pictures; empty without a sweep.
    """
    moves = moving_mask([smooth_grey(picture) for picture in pictures])
    stops, balance = light_range(pictures)
    shared = subject = elsewhere = None
    if at_rest is not None and sweep:
        alike, agree = _votes(at_rest, sweep)
        shared = int((agree > 0).sum())
        scale = min(1.0, SIDE_PX / max(pictures[0].shape[:2])) / scale_of(pictures[0])
        column, row = np.clip((at_rest.xy * scale).astype(int), 0, np.array(moves.shape[::-1]) - 1).T
        on_subject = moves[row, column]
        subject = _share(alike[on_subject], agree[on_subject])
        elsewhere = _share(alike[~on_subject], agree[~on_subject])
    return FixedGlance(
        float(moves.mean()),
        moving_share([smooth_grey(picture) for picture in rest]),
        shared,
        subject,
        elsewhere,
        stops,
        balance,
    )


def light_range(pictures: Sequence[Picture]) -> tuple[float, float]:
    """Largest change of brightness (stops) and of colour balance (relative) between pictures; NaN where hidden."""
    meter = LightMeter()
    for n, picture in enumerate(pictures):
        meter.add(n, float(n), picture)
    stops = meter.course().stops
    stops = stops[np.isfinite(stops).all(axis=1)]
    if len(stops) < 2:
        return np.nan, np.nan
    against_green = stops[:, [0, 2]] - stops[:, 1:2]
    return float(np.ptp(stops[:, 1])), float(2 ** np.ptp(against_green, axis=0).max() - 1)


def _votes(
    at_rest: Features, sweep: Sequence[Features]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """For each feature [n], in how many pictures of the sweep something looks alike, and is where it should be."""
    alike, agree = np.zeros(len(at_rest.xy)), np.zeros(len(at_rest.xy))
    for other in sweep:
        pair = match(at_rest, other)
        if len(pair) >= VERIFIED:
            alike[pair.candidates] += 1
            agree[pair.first] += 1
    return alike, agree


def _share(alike: Float[np.ndarray, " n"], agree: Float[np.ndarray, " n"]) -> float | None:
    return float(agree.sum() / alike.sum()) if alike.sum() >= ALIKE_ENOUGH else None
