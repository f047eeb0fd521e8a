"""Where the fixed cameras of a run see something move: over all of their clips, and in each stretch of time."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.extent.motion_masks import MASK_FRAMES, MASK_SIDE_PX, MotionMask, motion_mask
from devrf.capture.camera import Camera
from devrf.capture.frames import CameraFrames
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.spread import spread

FEWEST_PICTURES = 3  # of which a mask is made
STRETCHES = 12  # of the modelled time: of four pictures each in long clips


class FilmedClip(NamedTuple):
    """Small grey pictures of a clip and their times on the session's clock, which are so sure; seconds."""

    camera: Camera
    pictures: list[UInt8[np.ndarray, "h w"]]
    time_s: Float[np.ndarray, " n"]
    std_s: float

    def mask(self, from_s: float = -np.inf, to_s: float = np.inf) -> MotionMask | None:
        """What moves from one time to another, a picture and what the clock is unsure of around these."""
        if len(self.pictures) < FEWEST_PICTURES:
            return None
        around_s = float(np.median(np.diff(self.time_s))) + np.nan_to_num(self.std_s, nan=np.inf)
        inside = (self.time_s >= from_s - around_s) & (self.time_s <= to_s + around_s)
        some = [self.pictures[n] for n in np.flatnonzero(inside)]
        return motion_mask(self.camera, some) if len(some) >= FEWEST_PICTURES else None


def stretches_of(clips: Sequence[FilmedClip], span_s: tuple[float, float]) -> list[list[MotionMask | None]]:
    """What moves in each stretch of the modelled time, which is `span_s`; None where a camera does not film then."""
    ends_s = np.linspace(*span_s, STRETCHES + 1)
    return [
        [clip.mask(from_s, to_s) for clip in clips]
        for from_s, to_s in zip(ends_s[:-1], ends_s[1:], strict=True)
    ]


def filmed_clip(ingest: Path, camera: CameraFrames, calibrated: Camera, clock: Clock) -> FilmedClip:
    """Pictures that are spread over all of a camera's clip.

    Args:
        ingest: Folder of that stage.
        camera: Its pictures in there.
        calibrated, clock: As stages `rig` and `sync` found them, or geometry.
    """
    chosen = spread(camera.filmed(ingest), MASK_FRAMES)
    small = calibrated.scaled(min(1.0, MASK_SIDE_PX / max(calibrated.width, calibrated.height)))
    size = (small.width, small.height)
    grey = [cv2.resize(read_grey(f.file), size, interpolation=cv2.INTER_AREA) for f in chosen]
    times_s = clock.true_time(np.array([f.time_s for f in chosen], dtype=float))
    return FilmedClip(small, [np.asarray(g, dtype=np.uint8) for g in grey], times_s, clock.std_s)
