"""What a clip's flow says about itself: sums over pairs, which are kept with each pair, and shares of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

MOVING_PX = 0.5  # below, flow is mostly noise (a DIS error is 0.2 to 0.4 px)
LARGE_SHARE_OF_WIDTH = 1 / 8  # vectors beyond are where DIS loses track
SHAKE_PERCENTILE = 90.0  # a knock against the tripod is no shake
BETTER = 0.7  # of what warping leaves: an explanation that leaves less is the right one


@dataclass(frozen=True)
class PairChecks:
    """Sums over the pixels of one pair; nothing but numbers, so that they can be stored with it.

    Attributes:
        pixels, textured: All pixels; those with anything to follow.
        valid: Of the textured, those that pass the consistency rule.
        moving, trusted: Of the textured, those that move by more than `MOVING_PX`; and are valid.
        large: Of the trusted, those that move by more than 1/8 of the width.
        unsure: Of the trusted, those whose texture does not place them to half a pixel.
        warped, still: Difference to the previous picture after warping and before, grey levels, over the trusted.
        missed_px: Some misses of the round trip, trusted pixels.
        shake_px: By how much every corner of the picture moves at least; None where too few have texture.
        elsewhere: Another explanation of the flow -> (what warping leaves by it, what is left as it is).
    """

    pixels: int = 0
    textured: int = 0
    valid: int = 0
    moving: int = 0
    trusted: int = 0
    large: int = 0
    unsure: int = 0
    warped: float = 0.0
    still: float = 0.0
    missed_px: Sequence[float] = ()
    shake_px: float | None = None
    elsewhere: dict[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class FlowChecks:
    """What one clip's flow says about itself, over all its pairs, in pixels of the size at which it was found.

    Attributes:
        pairs, gaps: Pairs of frames with flow; pairs without, because frames are missing between them.
        supported: Share of pixels with anything to follow (not a plain backdrop).
        valid: Share of these that pass the consistency rule; None where there are none.
        moving: Share of all pixels that are supported and move by more than `MOVING_PX`.
        moving_valid: Share of these that pass the rule; None where nothing moves.
        unsure: Share of moving, valid pixels whose texture does not place them to half a pixel.
        round_trip_px: Median miss of the round trip among moving, valid pixels; None where nothing moves, or
            where only the flow backward is known.
        warp_ratio: Difference to the previous picture after warping over the difference before, on moving,
            valid pixels. Below 1 for a flow of the right direction and sign; None where nothing moves.
        large: Share of moving, valid pixels that move by more than 1/8 of the width.
        shake_px: Movement of the picture's corners that nine of ten pairs stay below; None where it cannot be told.
        better_as: What the flow rather is, by warping: `next`, `before` (that of another pair), `forward` (to the
            next frame), `full size` (in pixels of another size); None: what it says.
    """

    pairs: int
    gaps: int
    supported: float
    valid: float | None
    moving: float
    moving_valid: float | None
    unsure: float
    round_trip_px: float | None
    warp_ratio: float | None
    large: float
    shake_px: float | None
    better_as: str | None


def summary(pairs: Sequence[PairChecks], gaps: int) -> FlowChecks:
    """The sums of all pairs as shares and means."""
    total = {
        name: float(sum(getattr(pair, name) for pair in pairs))
        for name in ("pixels", "textured", "valid", "moving", "trusted", "large", "unsure", "warped", "still")
    }
    missed = [miss for pair in pairs for miss in pair.missed_px]
    shakes = [pair.shake_px for pair in pairs if pair.shake_px is not None]
    trusted = total["trusted"]
    return FlowChecks(
        pairs=len(pairs),
        gaps=gaps,
        supported=_share(total["textured"], total["pixels"]) or 0.0,
        valid=_share(total["valid"], total["textured"]),
        moving=_share(total["moving"], total["pixels"]) or 0.0,
        moving_valid=_share(trusted, total["moving"]),
        unsure=_share(total["unsure"], trusted) or 0.0,
        round_trip_px=float(np.median(missed)) if missed else None,
        warp_ratio=_share(total["warped"], total["still"]),
        large=_share(total["large"], trusted) or 0.0,
        shake_px=float(np.percentile(shakes, SHAKE_PERCENTILE)) if shakes else None,
        better_as=_better_as(pairs),
    )


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole > 0 else None


def _better_as(pairs: Sequence[PairChecks]) -> str | None:
    """The explanation that leaves least, where that is clearly less than the flow as it is."""
    ratios = {}
    for name in sorted({name for pair in pairs for name in pair.elsewhere}):
        told = [pair.elsewhere[name] for pair in pairs if name in pair.elsewhere]
        ratio = _share(float(sum(so for so, _ in told)), float(sum(own for _, own in told)))
        if ratio is not None and ratio < BETTER:
            ratios[name] = ratio
    return min(ratios, key=lambda name: ratios[name]) if ratios else None
