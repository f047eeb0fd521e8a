"""Courses of a clip over time, by which clocks without sound are found: how much moves, and how bright rows are."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.frames import SHARPNESS_SIDE_PX, shrunk
from devrf.capture.ingest.empty_ends import empty_ends
from devrf.capture.video.reader import VideoReader

MOTION_SIDE_PX = 160  # averages sensor noise away; a moving hand still covers several pixels
ROW_BANDS = 24  # a flash is placed to a twenty-fourth of the readout, about a millisecond


@dataclass(frozen=True)
class Courses:
    """Courses of a clip.

    Attributes:
        motion: Motion energy: time between two frames, mean absolute difference [n, 2].
        brightness: Time of a frame, mean level of each band of rows in the sensor's order [m, 1 + bands].
    """

    motion: Float[np.ndarray, "n 2"]
    brightness: Float[np.ndarray, "m bands"]


class CourseMeter:
    """Gathers `Courses`, frame by frame, without empty pictures at the ends."""

    def __init__(self) -> None:
        self.times_s: list[float] = []
        self.levels: list[float] = []  # median of each frame
        self._motion: list[tuple[float, float]] = []
        self._brightness: list[np.ndarray] = []
        self._contrast: list[float] = []
        self._last: UInt8[np.ndarray, "h w"] | None = None

    def add(self, time_s: float, grey: UInt8[np.ndarray, "h w"]) -> None:
        """Measure a frame, grey, with its rows in the order the sensor reads them."""
        small = shrunk(grey, MOTION_SIDE_PX)
        if self._last is not None:
            difference = float(cv2.mean(cv2.absdiff(small, self._last))[0])
            self._motion.append(((time_s + self.times_s[-1]) / 2, difference))
        self._brightness.append(np.concatenate([[time_s], _row_bands(grey)]))
        self.levels.append(float(np.median(small)))
        self._contrast.append(float(cv2.meanStdDev(small)[1][0, 0]))
        self.times_s.append(time_s)
        self._last = small

    def empty(self) -> tuple[int, int]:
        """How many pictures at the start and at the end show nothing."""
        return empty_ends(np.array(self._contrast))

    def courses(self) -> Courses:
        """What was measured."""
        start, end = self.empty()
        motion = np.array(self._motion).reshape(-1, 2)
        brightness = np.array(self._brightness).reshape(-1, 1 + ROW_BANDS)
        return Courses(motion[start : len(motion) - end], brightness[start : len(brightness) - end])


def read_courses(path: Path, seconds: float) -> Courses:
    """Measure the first seconds of a clip, without writing anything.

    Raises:
        InputError: It is not a video.
    """
    meter = CourseMeter()
    with VideoReader(path) as reader:
        for frame in reader:
            if meter.times_s and frame.time_s <= meter.times_s[-1]:
                continue
            meter.add(frame.time_s, frame.stored_grey(SHARPNESS_SIDE_PX))
            if frame.time_s > meter.times_s[0] + seconds:
                break
    return meter.courses()


def _row_bands(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, " bands"]:
    rows = cv2.reduce(grey, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)
    return cv2.resize(rows, (1, ROW_BANDS), interpolation=cv2.INTER_AREA)[:, 0].astype(np.float64)
