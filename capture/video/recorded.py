"""When a file says it was recorded: the container's creation time and the timecode of its first frame."""

import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from devrf.capture.measure import Measure
from devrf.capture.video.media import mean_fps, open_media, tag
from devrf.capture.video.timecode_track import timecode_rate

TIMECODE = re.compile(r"(\d{2}):(\d{2}):(\d{2})([:;.])(\d{2,3})")
USUAL_FPS = (
    *(n * 1000 / 1001 for n in (24, 30, 48, 60, 120)),
    24.0,
    25.0,
    30.0,
    48.0,
    50.0,
    60.0,
    100.0,
    120.0,
)
MEAN_TOLERANCE = 0.02
RATE_TOLERANCE = 0.1  # clips that lost pictures have a lower mean
DROPPED = {30: 2, 60: 4}  # frame numbers left out each minute but the tenth (SMPTE ST 12-1, drop frame)


@dataclass(frozen=True)
class Recorded:
    """What a file says of its beginning.

    Attributes:
        created_s: Creation time, seconds since 1970 UTC; None where the file has none.
        timecode_s: Timecode of the first frame, seconds of the day; None where the file has none.
        timecode_fps: Frames that the timecode counts in a second: its own track's rate, else the usual one next to the
            pictures'.
    """

    created_s: float | None = None
    timecode_s: float | None = None
    timecode_fps: float | None = None


def read_recorded(path: Path) -> Recorded:
    """What a clip says of when it was recorded.

    Raises:
        InputError: If the file is missing or not a video.
    """
    with open_media(path) as container:
        created = tag(container, "creation_time")
        code = tag(container, "timecode")
        fps = mean_fps(container, path)
    fps = None if code is None else timecode_rate(path) or _counted(fps)
    code_s = timecode_s(code, fps) if code is not None and fps else None
    return Recorded(_epoch(created), code_s, fps if code_s is not None else None)


def timecode_s(text: str, fps: float) -> float | None:
    """Seconds of the day of a timecode such as 10:21:05:12; None where it is none.

    With ; or . before the frames it is drop frame: some numbers are left out, so that 29.97 frames a second
    keep pace with the clock.
    """
    found = TIMECODE.fullmatch(text.strip())
    if not found:
        return None
    hours, minutes, seconds, frames = (int(found[k]) for k in (1, 2, 3, 5))
    counted = round(fps)
    number = ((hours * 60 + minutes) * 60 + seconds) * counted + frames
    if found[4] != ":" and counted in DROPPED:
        whole = hours * 60 + minutes
        number -= DROPPED[counted] * (whole - whole // 10)
    return number / fps


def rate_faults(timecode_fps: float | None, fps: float | None) -> list[Measure]:
    """What to say where pictures come at another rate than the timecode counts, and not at two or four times it."""
    if (
        not timecode_fps
        or not fps
        or any(abs(fps / (n * timecode_fps) - 1) < RATE_TOLERANCE for n in (1, 2, 4))
    ):
        return []
    rates = f"{timecode_fps:.4g} a second, pictures come at {fps:.4g}"
    text = f"the timecode counts {rates}: a factor of {fps / timecode_fps:.3g}"
    return [Measure("clip-times", text, why="timecode")]


def _counted(fps: float | None) -> float | None:
    """The rate that a timecode without a track counts at: the usual one next to the pictures' mean; None without.

    The mean of a variable rate, or of a clip that lost pictures, is no rate that a timecode has.
    """
    if not fps:
        return None
    nearest = min(USUAL_FPS, key=lambda usual: abs(fps / usual - 1))
    return nearest if abs(fps / nearest - 1) <= MEAN_TOLERANCE else fps if fps > max(USUAL_FPS) else None


def _epoch(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        return None
    if moment.year < 1980:  # the epoch of the container (1904) or of Unix stands for "not set"
        return None
    return moment.timestamp()
