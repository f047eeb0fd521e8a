"""A few pictures of a long clip, by seeking: when its pictures were taken, and short runs of them.

Only what is asked for is decoded, from the nearest key picture before it. `video.py` is for whole clips.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from jaxtyping import Float

from devrf.capture.errors import CaptureError
from devrf.capture.media import open_media, origin_s, video_stream
from devrf.capture.packets import scan_packets
from devrf.capture.video import VideoFrame, VideoReader

MOST_AHEAD = (
    60  # pictures decoded to get from a key picture to the place asked for; then what is there is taken
)
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
        raise CaptureError(
            f"{path}: no picture has a time; put the stream into an mp4 with its true frame rate"
        )
    return pts * float(time_base) - offset_s


def spread_starts(times_s: Float[np.ndarray, " n"], count: int, length: int = 1) -> list[float]:
    """Where at most `count` runs of `length` pictures begin, evenly from the first picture to the last."""
    last = max(0, len(times_s) - length)
    return times_s[np.unique(np.linspace(0, last, count).round().astype(int))].tolist()


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
        turns = reader.info.rotation_deg // 90
    with open_media(path) as container:
        stream = video_stream(container, path)
        time_base = stream.time_base
        assert time_base is not None
        stream.thread_type = "AUTO"
        offset_s = origin_s(container)
        pictures: Iterator[av.VideoFrame] = iter(())
        last = -NEAR - 1  # number of the picture that was read last
        came = 0  # pictures since the last seek

        def taken(first: int) -> list[VideoFrame]:
            """Of the pictures that come next, the run that begins at number `first`."""
            nonlocal last, came
            run: list[VideoFrame] = []
            for n, picture in enumerate(pictures):
                came += 1
                if picture.pts is None:
                    continue
                time_s = float(picture.pts * time_base) - offset_s
                index = int(np.searchsorted(times_s, time_s - SAME_TIME_S))
                if (index < first and n < MOST_AHEAD) or index <= last:
                    continue
                run.append(VideoFrame(index, time_s, picture, turns))
                last = index
                if len(run) == length:
                    break
            return run

        for start_s in starts_s:
            run: list[VideoFrame] = []
            first = int(np.searchsorted(times_s, start_s - SAME_TIME_S))
            try:
                if 0 <= first - last <= NEAR:
                    run = taken(first)
                else:
                    for at_s in (
                        start_s + offset_s,
                        0.0,
                    ):  # streams without an index: a seek may miss the key picture
                        container.seek(int(at_s / time_base), stream=stream)
                        pictures, came = container.decode(stream), 0
                        run = taken(first)
                        if came:
                            break
            except FFmpegError:
                pictures = iter(())  # the rest of a damaged file
            yield run
