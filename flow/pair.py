"""One pair of frames: its flow, how far each vector can be trusted, and what the flow says about itself."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.ndimage import uniform_filter

from devrf.capture.photos.resize import shrink
from devrf.capture.system.errors import FlowError
from devrf.flow.checks import LARGE_SHARE_OF_WIDTH, MOVING_PX, PairChecks
from devrf.flow.consistency import both_ways, luma, resize_flow, supported, warp
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import BEST

Picture = UInt8[np.ndarray, "height width 3"]
Load = Callable[[int], Picture]

PATCH = 9  # pixels; what methods compare (DIS: 8, RAFT: one cell of features)
HALF_WEIGHT_PX = 0.5  # an expected error that halves a vector's weight: the constant of the consistency rule
LEAST_NOISE = 0.5  # grey levels: rounding to whole ones
MISSES = 256  # round trips kept of each pair: a median needs no more
CORNERS, CORNER_TEXTURED = 4, 0.2  # a quarter of each side; share of a corner to be told anything by


@dataclass(frozen=True)
class PairFlow:
    """Flow of a pair, at any size of its picture.

    Attributes:
        flow: To the frame before [h, w, 2], pixels.
        missed: By how much it misses on the way there and back, pixels; None where nobody knows the way back.
        valid: Where it can be trusted.
    """

    flow: Float32[np.ndarray, "h w 2"]
    missed: Float32[np.ndarray, "h w"] | None
    valid: Bool[np.ndarray, "h w"]


Find = Callable[[int, Picture, Picture], PairFlow]
"""`find(n, current, previous)`: flow of the n-th frame to the one before."""


def estimated(estimator: FlowEstimator) -> Find:
    """Flow of a method."""
    return lambda n, current, previous: PairFlow(*both_ways(estimator, current, previous))


def measured(
    find: Find, n: int, load: Load, size: tuple[int, int], neighbours: bool, last: int
) -> tuple[Float32[np.ndarray, "height width 2"], UInt8[np.ndarray, "height width"], PairChecks]:
    """Flow of the n-th frame to the one before, reduced to a size, with confidence and checks.

    Args:
        find: Gives the flow.
        n: Number of the frame in its clip, from 1.
        load: Gives the n-th frame's picture.
        size: (width, height) to reduce to.
        neighbours: Try the flow on other pairs, too: that needs their pictures.
        last: Number of the clip's last frame.
    """
    whole, before = load(n), load(n - 1)
    check_pictures(whole, before)
    found = find(n, whole, before)
    height, width = found.flow.shape[:2]
    current, previous = (shrink(picture, width, height) for picture in (whole, before))
    textured = supported(current)
    valid = found.valid if found.missed is None else found.valid & textured
    now, then = luma(current), luma(previous)
    left = np.abs(now - warp(then, found.flow))
    unsure = _unsure_px(now, left[valid])
    weight = np.where(valid, 1.0, 0.0).astype(np.float32)
    missed = found.missed
    if missed is not None:  # of given flow no more is known than what its mask says
        weight /= 1 + (missed / HALF_WEIGHT_PX) ** 2 + (unsure / HALF_WEIGHT_PX) ** 2
    length = np.hypot(found.flow[..., 0], found.flow[..., 1])
    moving = textured & (length > MOVING_PX)
    trusted = moving & valid
    elsewhere = _elsewhere(found.flow, trusted, (whole, before), n, load, last) if neighbours else {}
    checks = PairChecks(
        pixels=length.size,
        textured=int(textured.sum()),
        valid=int((valid & textured).sum()),
        moving=int(moving.sum()),
        trusted=int(trusted.sum()),
        large=int((trusted & (length > LARGE_SHARE_OF_WIDTH * width)).sum()),
        unsure=int((trusted & (unsure > HALF_WEIGHT_PX)).sum()),
        warped=float(left[trusted].sum(dtype=np.float64)),
        still=float(np.abs(now - then)[trusted].sum(dtype=np.float64)),
        missed_px=[] if missed is None else _some(missed[trusted]),
        shake_px=_shake_px(found.flow, textured & valid),
        elsewhere=elsewhere,
    )
    reduced, weight = resize_flow(found.flow, weight, *size)
    confidence = np.where(weight > 0, np.clip(np.rint(BEST * weight), 1, BEST), 0).astype(np.uint8)
    return reduced, confidence, checks


def check_pictures(image0: np.ndarray, image1: np.ndarray) -> None:
    """Refuse what is not a pair of 8-bit RGB pictures of one size.

    Raises:
        FlowError: It names shape and type.
    """
    for image in (image0, image1):
        if image.dtype != np.uint8 or image.ndim < 3 or image.shape[-1] != 3:
            wrong = f"a picture of shape {list(image.shape)} and type {image.dtype}"
            remedy = "bring both pictures of a pair to 8 bits by one fixed scale"
            text = f"{wrong}, expected [..., height, width, 3] in 8 bits; {remedy}"
            raise FlowError("picture-kind-unread", text)
    if image0.shape != image1.shape:
        shapes = f"{list(image0.shape)} and {list(image1.shape)}"
        wrong = f"pictures of a pair have shapes {shapes}, expected the same"
        raise FlowError("picture-size-wrong", f"{wrong}; a clip must keep its size")


def _unsure_px(
    grey: Float32[np.ndarray, "height width"], left: Float32[np.ndarray, " m"]
) -> Float32[np.ndarray, "height width"]:
    """Standard deviation, pixels, of a match in its least certain direction, by its texture (Cramér–Rao bound).

    The noise is what the whole pair's flow leaves of the difference. In the direction of the structure tensor's
    smaller eigenvalue, a patch places itself to the noise over its root: nowhere on plain ground, badly along edges.
    """
    noise = max(LEAST_NOISE, 1.4826 * float(np.median(left))) if len(left) else LEAST_NOISE
    dy, dx = np.gradient(grey)
    xx, yy, xy = (PATCH**2 * uniform_filter(x, PATCH, mode="mirror") for x in (dx * dx, dy * dy, dx * dy))
    least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    # its own slopes: half of its variance in one picture, a quarter of it in two
    of_noise = PATCH**2 * noise**2 / 4
    return noise / np.sqrt(np.maximum(least - of_noise, 1e-6))


def _some(values: Float32[np.ndarray, " m"]) -> list[float]:
    """Evenly picked."""
    return [round(float(x), 3) for x in values[:: max(1, -(-len(values) // MISSES))]]


def _shake_px(flow: Float32[np.ndarray, "h w 2"], trusted: Bool[np.ndarray, "h w"]) -> float | None:
    """How far all corners of the picture move, in the median of each: the least. None where fewer than three tell.

    A subject rarely moves in three corners at once; a camera that shakes moves them all.
    """
    height, width = (side // CORNERS for side in trusted.shape)
    lengths = []
    for rows in (slice(None, height), slice(-height, None)):
        for columns in (slice(None, width), slice(-width, None)):
            told = trusted[rows, columns]
            if told.mean() >= CORNER_TEXTURED:
                lengths.append(float(np.linalg.norm(np.median(flow[rows, columns][told], axis=0))))
    return min(lengths) if len(lengths) >= 3 else None


def _elsewhere(
    flow: Float32[np.ndarray, "h w 2"],
    where: Bool[np.ndarray, "h w"],
    pair: tuple[Picture, Picture],
    n: int,
    load: Load,
    last: int,
) -> dict[str, Sequence[float]]:
    """What warping leaves if the flow were another one than it says: (so, as it says), sums of grey levels.

    `next`, `before`: that of the pair after, of the pair before. `forward`: to the next frame instead of from it.
    `full size`: in pixels of the full-size picture.
    """
    (current, previous), (height, width) = pair, flow.shape[:2]

    def left(to: Picture, of: Picture, vectors: Float32[np.ndarray, "h w 2"]) -> float:
        small, source = (luma(shrink(picture, width, height)) for picture in (to, of))
        return float(np.abs(small - warp(source, vectors))[where].sum(dtype=np.float64))

    own = left(current, previous, flow)
    out: dict[str, Sequence[float]] = {}
    if n < last:
        after = load(n + 1)
        out["next"] = (left(after, current, flow), own)
        out["forward"] = (left(current, after, flow), own)
    if n > 1:
        out["before"] = (left(previous, load(n - 2), flow), own)
    if (height, width) != current.shape[:2]:
        ratio = np.array([width / current.shape[1], height / current.shape[0]], np.float32)
        out["full size"] = (left(current, previous, flow * ratio), own)
    return out
