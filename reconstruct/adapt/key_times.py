"""How many key times a scene's motion needs, by its optical flow; the decision comes with its reason."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from devrf.capture.scene import PosedFrame
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.options import MotionOptions

BENT_PX = 0.25  # pixels of the training size by which a point's way between two key times may bend
FARTHEST = 0.06  # of the picture's width, that a point may move between two key times
AT_KEY = 1e-3  # of the key times' spacing: what is nearer counts as at it
SPARSE = 3  # every so many pixels of the flow are looked at, along each axis
MOVING_PX = 0.5  # what moves less per picture is not asked; over several, errors of flow add up as noise does
FEWEST_MOVE = 0.002  # of the pixels, that have to move for them to be asked
MOST_OFTEN = 95.0  # percentile: the few that move otherwise are mostly wrong flow


def offered_keys(frames: Sequence[PosedFrame], options: MotionOptions) -> int:
    """Key times to choose from for these pictures in motion: no more than times, and than any clip has pictures."""
    times = {f.time for f in frames if f.time is not None}
    clips = Counter(f.camera_name for f in frames)
    return max(2, min(options.keys or options.most_keys, len(times), max(clips.values())))


def rest_key_of(rest_time: float, times: Sequence[float], keys: int) -> int:
    """The key time at rest: the last before a rest from the start is over, the first after one to the end begins."""
    share = (rest_time - times[0]) / max(times[-1] - times[0], 1e-9)
    at = (keys - 1) * min(1.0, max(0.0, share))
    return math.floor(at + AT_KEY) if share < 0.5 else math.ceil(at - AT_KEY)


def fewer_keys(flows: dict[str, CameraFlow], most: int) -> tuple[int, Decision | None]:
    """Number of key times: no more than what moves needs, and at most `most`."""
    found = needed_spacing(flows)
    if found is None:
        return most, None
    spacing, reason = found
    pictures = max(len(clip.index) for clip in flows.values()) + 1
    needed = max(2, math.ceil((pictures - 1) / spacing) + 1)
    if needed >= most:
        return most, None
    return needed, Decision("key times", str(needed), str(most), reason)


def needed_spacing(flows: dict[str, CameraFlow]) -> tuple[float, str] | None:
    """How many pictures apart key times may be, and why; None where no flow tells.

    Ways between them have to be nearly straight (one of acceleration a bends by a h^2 / 8 over h pictures), and
    short enough for a key time to be found from the one before. Where next to nothing moves from one picture to the
    next, flow is followed over two, four, eight; where nothing moves then either, `static_keys.py` finds out.
    """
    span = 1
    while asked := [_Ways.of(clip, n, span) for clip in flows.values() for n in _ends(clip, span)]:
        speeds, bends = (np.concatenate([getattr(one, name) for one in asked]) for name in ("speed", "bend"))
        if len(speeds) and len(speeds) >= FEWEST_MOVE * sum(one.trusted for one in asked):
            speed, bend = (float(np.percentile(x, MOST_OFTEN)) for x in (speeds, bends))
            straight, near = span * math.sqrt(8 * BENT_PX / max(bend, 1e-6)), span * FARTHEST / speed
            if straight < near:
                return straight, f"ways are straight to {BENT_PX:g} pixels over {straight:.1f} pictures"
            return near, f"what moves fast goes {FARTHEST:.0%} of the picture's width in {near:.1f} pictures"
        span *= 2
    return None


@dataclass(frozen=True)
class _Ways:
    """What moves over a span of pictures.

    Attributes:
        speed: Of each pixel that moves, in picture widths per span.
        bend: By how much its way differs from that in the span before, pixels.
        trusted: Pixels, moving or not, whose flow is valid all along.
    """

    speed: Float[np.ndarray, " m"]
    bend: Float[np.ndarray, " m"]
    trusted: int

    @staticmethod
    def of(clip: CameraFlow, end: int, span: int) -> "_Ways":
        """From entry `end` of a clip's flow back over two spans."""
        height, width = clip.flow.shape[1:3]
        v, u = np.mgrid[0:height:SPARSE, 0:width:SPARSE].reshape(2, -1)
        begin = np.stack([u, v], axis=1).astype(np.float32)
        middle, valid = _followed(clip, end, begin, span)
        before, valid_before = _followed(clip, end - span, middle, span)
        later, earlier, trusted = middle - begin, before - middle, valid & valid_before
        moving = trusted & (np.abs(later) > MOVING_PX * math.sqrt(span)).any(axis=1)
        later, earlier = later[moving], earlier[moving]
        speed, bend = np.linalg.norm(later, axis=1) / width, np.linalg.norm(later - earlier, axis=1)
        return _Ways(speed, bend, int(trusted.sum()))


def _ends(clip: CameraFlow, span: int) -> range:
    """Entries from which two spans can be followed back."""
    return range(2 * span - 1, len(clip.index), span)


def _followed(
    clip: CameraFlow, end: int, points: Float[np.ndarray, "m 2"], steps: int
) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Where points of an entry's picture were `steps` pictures before, and whether the flow was valid all along."""
    height, width = clip.flow.shape[1:3]
    points, trusted = points.copy(), np.ones(len(points), bool)
    for n in range(end, end - steps, -1):
        at = np.rint(points).astype(int)
        inside = np.all((at >= 0) & (at < [width, height]), axis=1)
        u, v = np.where(inside[:, None], at, 0).T
        trusted &= inside & clip.valid[n][v, u]
        points += clip.flow[n][v, u].astype(np.float32)
    return points, trusted
