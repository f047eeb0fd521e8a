"""Looks at the frames of a clip as they pass: what they show, and which cannot be used."""

import numpy as np
from jaxtyping import UInt8

from devrf.capture.colour.light_course import SMALL_SIDE_PX, LightMeter, clipped_share, highlight_faults
from devrf.capture.frames import Role, some
from devrf.capture.ingest.clip_faults import LOOK_EVERY_S, Levels, Repeats, Tripod
from devrf.capture.ingest.signals import CourseMeter
from devrf.capture.measure import Measure
from devrf.capture.projection import ENOUGH, SIDE_PX, Picture, projection_faults, projection_of
from devrf.capture.video.reader import VideoFrame, VideoInfo

FIXED: tuple[Role, ...] = ("camera", "test", "joint")  # on a tripod


class ClipWatch:
    """What the frames that have a time show, one after the other."""

    def __init__(self, role: Role) -> None:
        self.courses = CourseMeter()
        self.light = LightMeter() if role in ("camera", "test") else None
        self.repeats = Repeats()
        self._indices: list[int] = []
        # boards are white paper
        self._clipped: list[float] | None = None if role in ("board", "joint") else []
        self._range = Levels()
        self._tripod = Tripod() if role in FIXED else None
        self._look_at_s = -np.inf
        self._pictures: list[Picture] = []

    def add(self, frame: VideoFrame, time_s: float, grey: UInt8[np.ndarray, "h w"]) -> None:
        """Look at a frame; `grey` is its `stored_grey`."""
        self.courses.add(time_s, grey)
        self.repeats.add(frame.index, grey)
        self._indices.append(frame.index)
        if self.light is not None:
            self.light.add(frame.index, time_s, frame.stored_rgb(SMALL_SIDE_PX))
        if time_s < self._look_at_s:
            return
        self._look_at_s = time_s + LOOK_EVERY_S
        self._range.add(frame.picture)
        if len(self._pictures) < ENOUGH:
            self._pictures.append(frame.upright.apply(frame.stored_rgb(SIDE_PX)))
        if self._clipped is not None:
            self._clipped.append(clipped_share(frame.stored_rgb(SMALL_SIDE_PX)))
        if self._tripod is not None:
            self._tripod.add(frame, time_s)

    def empty(self) -> list[int]:
        """Indices of the frames at the ends that show nothing."""
        start, end = self.courses.empty()
        return self._indices[:start] + self._indices[len(self._indices) - end :]

    def faults(self, info: VideoInfo) -> list[Measure]:
        """What is suspicious, apart from frames that repeat others; by what the file says, too."""
        found = [*projection_faults(projection_of([info.projection], self._pictures)), *self._range.faults()]
        found += highlight_faults(self._clipped or [])
        return [*found, *(self._tripod.faults() if self._tripod else ())]


class Unused:
    """Frames that cannot be used: damaged, of another size, without a time, or not after the one before."""

    def __init__(self) -> None:
        self.times_s: list[float] = []  # of pictures that cannot be used: these are not missing
        self._damaged: list[tuple[int, float]] = []
        self._tainted = False  # damage stays in the pictures up to the next key picture
        self._resized: list[tuple[int, float, tuple[int, int]]] = []
        self._size = (0, 0)
        self._backwards: list[int] = []
        self._untimed = 0
        self._last_s = -np.inf

    def picture(self, frame: VideoFrame, time_s: float | None, info: VideoInfo) -> bool:
        """Whether this frame's picture cannot be used."""
        self._size = (info.width, info.height)
        place = (frame.index, frame.time_s if time_s is None else time_s)
        if frame.size != self._size:
            self._resized.append((*place, frame.size))
        elif frame.damaged or (self._tainted and not frame.picture.key_frame):
            self._tainted = True
            self._damaged.append(place)
        else:
            self._tainted = False
            return False
        if time_s is not None:
            self.times_s.append(time_s)
        return True

    def time(self, index: int, time_s: float | None) -> bool:
        """Whether this frame's time cannot be used."""
        if time_s is None:
            self._untimed += 1
        elif time_s <= self._last_s:
            self._backwards.append(index)
        else:
            self._last_s = time_s
            return False
        return True

    def notes(self, count: int) -> list[str]:
        """What is unusual, of `count` frames."""
        notes = []
        if self._backwards:
            back = self._backwards
            notes.append(f"{len(back)} timestamps do not increase, frames {some(back)}; not used")
        if self._untimed:
            notes.append(f"{self._untimed} of {count} frames have no row in the table of times; not used")
        return notes

    def faults(self) -> list[Measure]:
        """What is suspicious."""
        found = []
        if self._damaged:
            index, time_s = self._damaged[0]
            found.append(
                Measure(
                    "not-used",
                    f"{len(self._damaged)} frames are damaged, the first is {index} at {time_s:.2f} s; not used",
                    why="damaged",
                )
            )
        if self._resized:
            index, time_s, (width, height) = self._resized[0]
            found.append(
                Measure(
                    "not-used",
                    f"{len(self._resized)} frames from {index} at {time_s:.2f} s on are {width}x{height}, the first "
                    f"ones {self._size[0]}x{self._size[1]}; not used",
                    why="size",
                )
            )
        return found
