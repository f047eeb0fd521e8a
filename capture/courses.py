"""How much moves and how bright it is in the first seconds of a clip, without writing anything."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from devrf.capture.clips import MOTION_SIDE_PX, ROW_BANDS
from devrf.capture.frames import grey_small
from devrf.capture.video import VideoReader


@dataclass(frozen=True)
class Courses:
    """Courses over time as `ingest` measures them.

    Attributes:
        motion: Time between two frames, mean absolute difference [n, 2].
        brightness: Time of a frame, mean level of each band of rows in the sensor's order [m, 1 + bands].
    """

    motion: Float[np.ndarray, "n 2"]
    brightness: Float[np.ndarray, "m bands"]


def read_courses(path: Path, seconds: float) -> Courses:
    """Decode the first seconds of a clip and measure them.

    Raises:
        InputError: It is not a video.
    """
    motion, brightness = [], []
    last = None
    with VideoReader(path) as reader:
        turns = -(reader.info.rotation_deg // 90)
        for frame in reader:
            grey = grey_small(frame.rgb, MOTION_SIDE_PX)
            stored = np.ascontiguousarray(np.rot90(grey, turns).astype(np.float32))
            bands = cv2.resize(stored, (1, ROW_BANDS), interpolation=cv2.INTER_AREA)[:, 0]
            brightness.append(np.concatenate([[frame.time_s], bands]))
            if last is not None and frame.time_s > last[0]:
                motion.append(((frame.time_s + last[0]) / 2, float(cv2.absdiff(grey, last[1]).mean())))
            last = (frame.time_s, grey)
            if frame.time_s > brightness[0][0] + seconds:
                break
    return Courses(np.array(motion).reshape(-1, 2), np.array(brightness).reshape(-1, 1 + ROW_BANDS))
