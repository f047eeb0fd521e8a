"""A few pictures of a long clip, by seeking: when its pictures were taken, and short runs of them.

Only what is asked for is decoded, from the nearest key picture before it. `video.py` is for whole clips.
"""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from av.video.stream import VideoStream
from jaxtyping import Float

from devrf.capture.errors import CaptureError
from devrf.capture.media import open_media, origin_s
from devrf.capture.video import VideoFrame, VideoReader

MOST_AHEAD = (
    60  # pictures decoded to get from a key picture to the place asked for; then what is there is taken
)
SAME_TIME_S = 1e-4


def picture_times(path: Path) -> Float[np.ndarray, " n"]:
    """Presentation times of all pictures of a clip in file time [n], seconds, in order; read, not decoded.

    Raises:
        InputError: The file is missing or not a media file.
        CaptureError: It has no picture with a time.
    """
    with open_media(path) as container:
        stream = container.streams.best("video")
        times: list[float] = []
        try:
            for packet in container.demux(stream) if stream is not None else ():
                if packet.is_corrupt:
                    break
                if packet.size and packet.pts is not None and packet.time_base is not None:
                    times.append(float(packet.pts * packet.time_base) - origin_s(container))
        except FFmpegError:
            pass  # what is before the damage counts
    if not times:
        raise CaptureError(
            f"{path}: no picture has a time; put the stream into an mp4 with its true frame rate"
        )
    return np.sort(np.array(times))


def spread_starts(times_s: Float[np.ndarray, " n"], count: int, length: int = 1) -> list[float]:
    """Where at most `count` runs of `length` pictures begin, evenly from the first picture to the last."""
    last = max(0, len(times_s) - length)
    return times_s[np.unique(np.linspace(0, last, count).round().astype(int))].tolist()


def read_runs(
    path: Path, times_s: Float[np.ndarray, " n"], starts_s: Sequence[float], length: int = 1
) -> list[list[VideoFrame]]:
    """Runs of `length` successive pictures, upright, that begin at the given times.

    Args:
        path: The clip.
        times_s: What `picture_times` returned.
        starts_s: Increasing file times. A run whose key picture is far before it begins earlier than asked for.
        length: Pictures of a run.
    Returns:
        A run for each start; shorter or empty where the file is damaged or the run was read already.
    Raises:
        InputError: The file is not a video, or no picture decodes.
    """
    with VideoReader(path) as reader:
        turns = reader.info.rotation_deg // 90
    runs: list[list[VideoFrame]] = []
    read_to_s = -np.inf
    with open_media(path) as container:
        stream = container.streams.best("video")
        assert isinstance(stream, VideoStream) and stream.time_base is not None
        stream.thread_type = "AUTO"
        offset_s = origin_s(container)
        for start_s in starts_s:
            run: list[VideoFrame] = []
            try:
                container.seek(int((start_s + offset_s) / stream.time_base), stream=stream)
                for n, picture in enumerate(container.decode(stream)):
                    if picture.pts is None:
                        continue
                    time_s = float(picture.pts * stream.time_base) - offset_s
                    early = time_s < start_s - SAME_TIME_S and n < MOST_AHEAD
                    if early or time_s <= read_to_s + SAME_TIME_S:
                        continue
                    run.append(_frame(picture, time_s, times_s, turns))
                    if len(run) == length:
                        break
            except FFmpegError:
                pass  # the rest of a damaged file
            if run:
                read_to_s = run[-1].time_s
            runs.append(run)
    return runs


def _frame(picture: av.VideoFrame, time_s: float, times_s: Float[np.ndarray, " n"], turns: int) -> VideoFrame:
    index = int(np.searchsorted(times_s, time_s - SAME_TIME_S))
    return VideoFrame(index, time_s, picture, turns)
