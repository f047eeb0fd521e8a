"""A few pictures of a long clip, by seeking: when its pictures were taken, and short runs of them.

Only what is asked for is decoded, from the nearest key picture before it. `reader.py` is for whole clips.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream
from jaxtyping import Float

from devrf.capture.orientation import Upright
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.spread import spread
from devrf.capture.video.media import open_media, origin_s, video_stream
from devrf.capture.video.packets import scan_packets
from devrf.capture.video.reader import VideoFrame, VideoReader

MOST_AHEAD = 60  # pictures decoded from a key picture to the place asked for; then what is there is taken
NEAR = 12  # pictures; this near ahead, going on is faster than seeking
SAME_TIME_S = 1e-4


def picture_times(path: Path) -> Float[np.ndarray, " n"]:
    """Presentation times of all pictures of a clip in file time [n], seconds, in order; read, not decoded.

    Raises:
        InputError: The file is missing or not a media file.
        CaptureError: Its pictures have no times of their own.
    """
    pts = scan_packets(path).pts
    with open_media(path) as container:
        time_base, offset_s = video_stream(container, path).time_base, origin_s(container)
    if pts is None or len(pts) == 0 or time_base is None:
        text = f"{path}: no picture has a time; put the stream into an mp4 with its true frame rate"
        raise CaptureError("times-missing", text)
    return pts * float(time_base) - offset_s


def spread_starts(times_s: Float[np.ndarray, " n"], count: int, length: int = 1) -> list[float]:
    """Where at most `count` runs of `length` pictures begin, evenly from the first picture to the last."""
    return spread(times_s[: max(1, len(times_s) - length + 1)].tolist(), count)


def read_runs(
    path: Path, times_s: Float[np.ndarray, " n"], starts_s: Sequence[float], length: int = 1
) -> Iterator[list[VideoFrame]]:
    """Runs of `length` successive pictures, upright, that begin at the given times; one is held at a time.

    Args:
        path: The clip.
        times_s: What `picture_times` returned.
        starts_s: Increasing file times. A run whose key picture is far before it begins earlier than asked for.
        length: Pictures of a run.
    Yields:
        A run for each start; shorter or empty where the file is damaged or the run was read already.
    Raises:
        InputError: The file is not a video, or no picture decodes.
    """
    with VideoReader(path) as reader:
        upright = reader.info.upright
    with open_media(path) as container:
        clip = _OpenClip(container, video_stream(container, path), times_s, upright)
        frames: Iterator[VideoFrame] = iter(())
        last = -NEAR - 1  # number of the picture that was read last
        for start_s in starts_s:
            first, run = clip.number(start_s), []
            try:
                if not 0 <= first - last <= NEAR:
                    frames = clip.frames(start_s)
                run = _run(frames, first, last, length)
            except FFmpegError:
                frames = iter(())  # the rest of a damaged file
            last = run[-1].index if run else last
            yield run


@dataclass(frozen=True)
class _OpenClip:
    container: InputContainer
    stream: VideoStream
    times_s: Float[np.ndarray, " n"]
    upright: Upright

    def number(self, time_s: float) -> int:
        """The picture that is shown at a file time."""
        return int(np.searchsorted(self.times_s, time_s - SAME_TIME_S))

    def frames(self, from_s: float) -> Iterator[VideoFrame]:
        """Pictures from the key picture before a file time on; none where nothing can be found."""
        time_base, offset_s = self.stream.time_base, origin_s(self.container)
        assert time_base is not None
        for at_s in (from_s + offset_s, 0.0):  # streams without an index: a seek may miss the key picture
            self.container.seek(int(at_s / time_base), stream=self.stream)
            frames = self._decoded(time_base, offset_s)
            head = next(frames, None)
            if head is not None:
                return chain([head], frames)
        return iter(())

    def _decoded(self, time_base: Fraction, offset_s: float) -> Iterator[VideoFrame]:
        for picture in self.container.decode(self.stream):
            if picture.pts is not None:
                time_s = float(picture.pts * time_base) - offset_s
                yield VideoFrame(self.number(time_s), time_s, picture, self.upright)


def _run(frames: Iterator[VideoFrame], first: int, last: int, length: int) -> list[VideoFrame]:
    """Of the pictures that come next, the run that begins at number `first`; those up to number `last` are known."""
    run: list[VideoFrame] = []
    for n, frame in enumerate(frames):
        if (frame.index >= first or n >= MOST_AHEAD) and frame.index > last:
            run.append(frame)
            last = frame.index
            if len(run) == length:
                break
    return run
