"""The flow of one camera's clip, and what it says about itself.

Flow is computed backward, from each used frame to the one before it, on full-size pictures, and then
reduced to the size the model is trained at. Across a gap in the clip (dropped frames) there is none: the
entry is there, and nowhere valid.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from devrf.capture.errors import FlowError
from devrf.capture.progress import Progress, no_progress
from devrf.flow.consistency import consistent, resize_flow, round_trip, supported, warp_residuals
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import CameraFlow

GAP = 1.5  # a time step longer than this many median steps has lost at least one frame
MOVING_PX = 0.5  # below, flow is mostly noise (a DIS error is 0.2 to 0.4 px)
LARGE_SHARE_OF_WIDTH = 1 / 8  # vectors beyond are where DIS loses track


@dataclass(frozen=True)
class FlowChecks:
    """What one clip's flow says about itself, over all its pairs, at full size.

    Attributes:
        pairs, gaps: Pairs of frames with flow; pairs without, because frames are missing between them.
        supported: Share of pixels with anything to follow (not a plain backdrop).
        valid: Share of these that pass the consistency rule; None where there are none.
        moving: Share of all pixels that are supported and move by more than `MOVING_PX`.
        moving_valid: Share of these that pass the rule; None where nothing moves.
        round_trip_px: Median miss of the round trip among moving, valid pixels; None where nothing moves, or
            where only the flow backward is known.
        warp_ratio: Difference to the previous picture after warping over the difference before, on moving,
            valid pixels. Below 1 for a flow of the right direction and sign; None where nothing moves.
        large: Share of moving, valid pixels that move by more than 1/8 of the width.
    """

    pairs: int
    gaps: int
    supported: float
    valid: float | None
    moving: float
    moving_valid: float | None
    round_trip_px: float | None
    warp_ratio: float | None
    large: float


def clip_flow(
    camera: str,
    index: Sequence[int],
    time: Sequence[float] | Float[np.ndarray, " n"],
    load: Callable[[int], UInt8[np.ndarray, "height width 3"]],
    size: tuple[int, int],
    estimator: FlowEstimator,
    progress: Progress = no_progress,
) -> tuple[CameraFlow, FlowChecks]:
    """Backward flow of one camera's used frames, in order of time.

    Args:
        camera: Name, for the result and for messages.
        index: Frame numbers [N].
        time: Times of the frames [N], rising; any unit.
        load: Gives the n-th frame's full-size RGB picture.
        size: (width, height) of the stored flow.
        estimator: The method.
    Returns:
        N - 1 entries, and the checks.
    Raises:
        FlowError: Fewer than two frames, times that do not rise, or pictures of different sizes.
    """
    steps = np.diff(np.asarray(time, dtype=np.float64))
    if len(steps) == 0 or not (steps > 0).all():
        raise FlowError(
            f"camera {camera!r}: {len(index)} frames at times {[round(float(t), 4) for t in time][:5]}…, "
            "expected at least two at rising times; check the clip and its timestamps"
        )
    gap = steps > GAP * np.median(steps)
    width, height = size
    vectors = np.zeros((len(steps), height, width, 2), dtype=np.float16)
    valid = np.zeros((len(steps), height, width), dtype=bool)
    tally = Tally()
    previous = load(0)
    for n in range(len(steps)):
        current = load(n + 1)
        if current.shape != previous.shape:
            raise FlowError(
                f"camera {camera!r}: frame {index[n + 1]} is {current.shape[1]}x{current.shape[0]}, the one "
                f"before {previous.shape[1]}x{previous.shape[0]}; a clip must keep its size"
            )
        if gap[n]:
            tally.gaps += 1
        else:
            flow, back = estimator.estimate(current, previous), estimator.estimate(previous, current)
            textured = supported(current)
            trusted = consistent(flow, back) & textured
            tally.add(previous, current, flow, back, textured, trusted)
            reduced, valid[n] = resize_flow(flow, trusted, width, height)
            vectors[n] = reduced.astype(np.float16)
        previous = current
        progress((n + 1) / len(steps), f"{camera}: {n + 1} of {len(steps)} pairs")
    numbers = np.asarray(index[1:], dtype=np.int32)
    return CameraFlow(camera, numbers, vectors, valid), tally.checks()


class Tally:
    """Sums over pairs, so that only two pictures are held at a time."""

    def __init__(self) -> None:
        self.pairs = self.gaps = self.pixels = self.textured = self.valid = 0
        self.moving = self.trusted = self.large = 0
        self.warped = self.still = 0.0
        self.missed: list[Float32[np.ndarray, " some"]] = []

    def add(
        self,
        previous: np.ndarray,
        current: np.ndarray,
        flow: np.ndarray,
        back: np.ndarray | None,
        textured: np.ndarray,
        valid: np.ndarray,
    ) -> None:
        """Count one pair; without flow the other way there is no round trip. What has no texture is not judged."""
        length = np.linalg.norm(flow, axis=-1)
        moving = textured & (length > MOVING_PX)
        trusted = moving & valid
        self.pairs += 1
        self.pixels += length.size
        self.textured += int(textured.sum())
        self.valid += int((valid & textured).sum())
        self.moving += int(moving.sum())
        self.trusted += int(trusted.sum())
        self.large += int((trusted & (length > LARGE_SHARE_OF_WIDTH * flow.shape[1])).sum())
        warped, still = warp_residuals(previous, current, flow, trusted)
        self.warped += warped * trusted.sum()
        self.still += still * trusted.sum()
        if back is not None:
            self.missed.append(round_trip(flow, back)[trusted][::17])  # every 17th: a median needs no more

    def checks(self) -> FlowChecks:
        """The sums as shares and means."""
        missed = np.concatenate([*self.missed, np.zeros(0, np.float32)])
        return FlowChecks(
            pairs=self.pairs,
            gaps=self.gaps,
            supported=self.textured / self.pixels if self.pixels else 0.0,
            valid=self.valid / self.textured if self.textured else None,
            moving=self.moving / self.pixels if self.pixels else 0.0,
            moving_valid=self.trusted / self.moving if self.moving else None,
            round_trip_px=float(np.median(missed)) if len(missed) else None,
            warp_ratio=float(self.warped / self.still) if self.still > 0 else None,
            large=self.large / self.trusted if self.trusted else 0.0,
        )
