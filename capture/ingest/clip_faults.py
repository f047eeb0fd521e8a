"""What is wrong with a clip, found while its frames pass: repeated frames, sizes, range of levels, bit rate, tripod.

Each frame is looked at as a small grey picture, as the sensor reads it. Nothing here changes a picture.
"""

from collections.abc import Sequence

import av
import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.frames import SHARPNESS_SIDE_PX, some
from devrf.capture.ingest.camera_stability import find_corners, follow
from devrf.capture.measure import Measure
from devrf.capture.video.reader import VideoFrame, VideoInfo
from devrf.capture.video.video_colour import OTHER_CURVES, is_full_range, luma_plane

# Two frames that differ by less than this (mean of absolute differences, levels of 255) are the same picture. What
# nine real and simulated cameras film differs by 0.15 and more between frames, a subject that hardly moves included.
SAME_LEVEL = 0.1
# A repeat stands between frames in which something moves: a share of the pixels changes by more than noise and than
# what a key picture changes in a scene at rest, which repeats nothing.
MOVED_LEVEL, MOVED_SHARE = 12, 3e-4
LONGEST_REPEAT = 5  # frames; more is a scene at rest

LOOK_EVERY_S = 1.0  # at the tripod and at the levels
SHIFT_PX = 0.5  # of a fixed camera's full picture; cameras that stand were measured at 0.1 and less
ZOOM = 1e-3  # change of size; cameras that stand were measured at 6e-5 and less

BELOW_LIMITED, ABOVE_LIMITED = 8, 247  # limited range is 16 to 235; noise and overshoot stay inside these
LIMITED_ENDS = 5  # levels from 14 to 18 and from 233 to 237: the ends, and what coding adds to them
RANGE_SHARE = 1e-3  # of the pixels, in each of two places, tells something
OUTSIDE_SHARE = 1e-5
LUMA_STEP_PX = 8  # every eighth pixel of every eighth row tells the levels

LEAST_BITS = 0.05  # per pixel, for H.264 and older codecs ...
LATER_CODECS = {"hevc": 0.6, "vp9": 0.6, "av1": 0.5}  # ... and these need that share of it


class Repeats:
    """Frames that repeat the one before: the camera or the recorder missed a frame and filled its place."""

    def __init__(self) -> None:
        # Of each frame: index, whether it is the same as the one before, whether something moved.
        self._frames: list[tuple[int, bool, bool]] = []
        self._last: UInt8[np.ndarray, "h w"] | None = None

    def add(self, index: int, grey: UInt8[np.ndarray, "h w"]) -> None:
        """Look at frame `index`."""
        last, self._last = self._last, grey
        if last is None:
            self._frames.append((index, False, False))
            return
        difference = cv2.absdiff(grey, last)
        moved = bool(np.count_nonzero(difference > MOVED_LEVEL) > MOVED_SHARE * difference.size)
        self._frames.append((index, not moved and cv2.mean(difference)[0] < SAME_LEVEL, moved))

    def frames(self, empty: Sequence[int] = ()) -> list[int]:
        """Their indices; how a clip gets from `empty` frames to the others is no movement."""
        left_out = set(empty)
        before = [self._frames[max(0, n - 1)][0] for n in range(len(self._frames))]
        seen = [f for f, b in zip(self._frames, before, strict=True) if not left_out & {f[0], b}]
        same = np.array([same for _, same, _ in seen], dtype=bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
        found: list[int] = []
        for start, end in edges.reshape(-1, 2).tolist():
            inside = 0 < start and end < len(same)
            if inside and end - start <= LONGEST_REPEAT and seen[start - 1][2] and seen[end][2]:
                found += [index for index, _, _ in seen[start:end]]
        return found


def repeats_fault(repeated: list[int], count: int) -> Measure:
    """What to say of repeated frames."""
    text = f"{len(repeated)} of {count} frames repeat the one before: {some(repeated)}; they are not used"
    return Measure("not-used", text, why="repeated")


class Levels:
    """Whether the levels of a clip fit the range that the file names, and code light by a curve that is expected."""

    def __init__(self) -> None:
        self._counts = np.zeros(256, np.int64)
        self._full = False
        self._curve: str | None = None

    def add(self, picture: av.VideoFrame) -> None:
        """Look at one picture."""
        self._curve = OTHER_CURVES.get(picture.color_trc)
        luma = luma_plane(picture)
        if luma is not None:
            sample = luma[::LUMA_STEP_PX, ::LUMA_STEP_PX]
            self._counts += np.bincount(sample.ravel(), minlength=256)
            self._full = is_full_range(picture)

    def faults(self) -> list[Measure]:
        """Of the curve and of the range, at most one each."""
        return [*self._curve_faults(), *self._range_faults()]

    def _curve_faults(self) -> list[Measure]:
        if self._curve is None:
            return []
        text = f"the file says that its curve is {self._curve}; it is taken as sRGB"
        return [Measure("coding", text, why="curve")]

    def _range_faults(self) -> list[Measure]:
        if not self._counts.any():
            return []
        share = self._counts / self._counts.sum()
        below, above = share[:BELOW_LIMITED].sum(), share[ABOVE_LIMITED + 1 :].sum()
        if not self._full and min(below, above) > RANGE_SHARE:
            return [_range_fault("limited range (16 to 235), but they run from 0 to 255", 1)]
        # Full range that stays within the limited one is just soft light, unless it ends where that one ends.
        at_ends = min(share[14 : 14 + LIMITED_ENDS].sum(), share[238 - LIMITED_ENDS : 238].sum())
        outside = share[:14].sum() + share[238:].sum()
        if self._full and outside < OUTSIDE_SHARE and at_ends > RANGE_SHARE:
            return [_range_fault("full range (0 to 255), but they end at 16 and 235", 0)]
        return []


def _range_fault(what: str, flag: int) -> Measure:
    text = f"its levels are said to have {what}; the file's flag is believed"
    return Measure("coding", text, why="range", facts={"flag": flag})


def bit_rate_fault(info: VideoInfo, count: int, size_bytes: int) -> list[Measure]:
    """A clip coded with too few bits."""
    bits = 8 * size_bytes / max(1, count * info.width * info.height)
    least = LEAST_BITS * LATER_CODECS.get(info.codec, 1.0)
    if bits >= least:
        return []
    found = f"{bits:.3f} bits per pixel ({info.codec})"
    text = f"{found}, expected at least {least:.3f}: features and flow will suffer"
    return [Measure("coding", text, why="bits")]


class Tripod:
    """Whether a fixed camera's background stays where it was in the first picture."""

    def __init__(self) -> None:
        self._first: UInt8[np.ndarray, "h w"] | None = None
        self._corners: np.ndarray | None = None
        self._shift = (0.0, 0.0)  # largest, and when
        self._zoom = (0.0, 0.0)

    def add(self, frame: VideoFrame, time_s: float) -> None:
        """Look at one picture."""
        grey = frame.stored_grey(SHARPNESS_SIDE_PX)
        if self._first is None or self._corners is None:  # the first pictures of a clip may show nothing
            self._first, self._corners = grey, find_corners(grey)
            return
        motion = follow(self._first, grey, self._corners)
        if motion is not None:
            shift_px = motion.shift_px * max(frame.size) / max(grey.shape)
            self._shift = max(self._shift, (shift_px, time_s))
            self._zoom = max(self._zoom, (abs(motion.scale - 1), time_s))

    def faults(self) -> list[Measure]:
        """What a camera on a tripod with everything switched off would not show."""
        found = []
        if self._shift[0] > SHIFT_PX:
            text = f"its background moves by up to {self._shift[0]:.1f} px, at {self._shift[1]:.1f} s"
            found.append(Measure("camera-moves", text, why="shift"))
        if self._zoom[0] > ZOOM:
            text = (
                f"its background changes size by up to {100 * self._zoom[0]:.2f} %, at {self._zoom[1]:.1f} s"
            )
            found.append(Measure("camera-moves", text, why="zoom"))
        return found
