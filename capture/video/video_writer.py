"""Pictures into an H.264 film that every browser plays.

yuv420p halves the colour in both directions, so sizes must be even: an odd picture gets its last row or
column repeated. Colours are converted with, and tagged as, BT.709; an untagged film is shown with
whatever matrix the player guesses. The index is put in front, so that playing starts while loading.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from queue import Queue
from threading import Thread

import numpy as np
from jaxtyping import UInt8

from devrf.capture.system.errors import CaptureError

# 18 cannot be told from the original by eye, 23 is the default. Macroblock trees read memory that nobody wrote where
# AVX-512 is at work and 16-pixel columns are no multiple of eight: the same pictures gave another film each time.
X264 = {"crf": "18", "preset": "medium", "mbtree": "0"}
BT709 = 1  # number of that matrix, transfer and primaries in ITU-T H.273
WAITING = 4  # pictures that may wait for the encoder: memory stays bounded where it is the slower one


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "height width 3"]],
    fps: float,
    options: Mapping[str, str] = X264,
) -> int:
    """Write RGB pictures as an mp4 film (H.264, yuv420p, BT.709, index in front).

    Args:
        path: File to write; its folder must exist.
        frames: Pictures [height, width, 3] of one size, RGB; consumed one at a time.
        fps: Pictures per second.
        options: Of x264.
    Returns:
        Number of pictures written.
    Raises:
        CaptureError: No pictures, sizes that differ, or a file that cannot be written.
    """
    import av
    from av.error import FFmpegError

    if not fps > 0:
        raise ValueError(f"fps is {fps}, expected more than 0")
    count, size = 0, (0, 0)
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
            stream.pix_fmt = "yuv420p"
            stream.options = dict(options)
            context = stream.codec_context
            context.colorspace = context.color_trc = context.color_primaries = BT709
            for picture in frames:
                even = _even(picture)
                if count == 0:
                    size = (even.shape[1], even.shape[0])
                    stream.width, stream.height = size
                elif (even.shape[1], even.shape[0]) != size:
                    wrong = f"{path.name}: picture {count} is {even.shape[1]}x{even.shape[0]}"
                    expected = f"the first one {size[0]}x{size[1]}; a film needs pictures of one size"
                    raise CaptureError("picture-size-wrong", f"{wrong}, {expected}")
                frame = av.VideoFrame.from_ndarray(even, format="rgb24")
                frame = frame.reformat(
                    format="yuv420p", src_colorspace="itu709", dst_colorspace="itu709", dst_color_range="MPEG"
                )
                container.mux(stream.encode(frame))
                count += 1
            if count:
                container.mux(stream.encode(None))
    except (OSError, FFmpegError) as error:
        text = f"{path}: cannot be written ({error}); check the folder and free space"
        raise CaptureError("file-unwritable", text) from error
    if not count:
        path.unlink(missing_ok=True)
        raise CaptureError("pictures-none", f"{path.name}: no pictures to write, expected at least one")
    return count


@contextmanager
def video_beside(path: Path, fps: float) -> Iterator[Callable[[UInt8[np.ndarray, "height width 3"]], None]]:
    """Write a film beside other work: what is given is called with one picture after the other.

    The film is whole when the block ends; where that ends by an error there is none. Arguments and errors are those of
    `write_video`; errors come from the next call, or at the end.
    """
    queue: Queue[UInt8[np.ndarray, "height width 3"] | None] = Queue(WAITING)
    failed: list[BaseException] = []
    given = _until_none(queue)

    def encode() -> None:
        try:
            write_video(path, given, fps)
        except BaseException as error:
            failed.append(error)
            for _ in given:  # or who puts would wait for a place
                pass

    def put(picture: UInt8[np.ndarray, "height width 3"]) -> None:
        if failed:
            raise failed[0]
        queue.put(picture)

    thread = Thread(target=encode, name=f"encoder of {path.name}", daemon=True)
    thread.start()
    try:
        yield put
    except BaseException:
        queue.put(None)
        thread.join()
        path.unlink(missing_ok=True)
        raise
    queue.put(None)
    thread.join()
    if failed:
        path.unlink(missing_ok=True)
        raise failed[0]


def _until_none(
    queue: "Queue[UInt8[np.ndarray, 'height width 3'] | None]",
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    while (picture := queue.get()) is not None:
        yield picture


def _even(picture: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "even_height even_width 3"]:
    height, width = picture.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return np.ascontiguousarray(picture)
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
