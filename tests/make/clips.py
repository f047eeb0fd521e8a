"""Clips of pictures that a test draws."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

TIME_BASE = Fraction(1, 90_000)


def add_pictures(
    out: Any,
    stream: Any,
    pictures: Iterable[np.ndarray],
    ticks: Sequence[int] | None = None,
    base: Any = None,
) -> None:
    """Encode all pictures of a stream of a container; `ticks`: their times in units of `base`, seconds."""
    for n, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        if ticks is not None:
            frame.pts, frame.time_base = ticks[n], base
        out.mux(stream.encode(frame))
    out.mux(stream.encode(None))


def film(
    path: Path,
    pictures: Sequence[np.ndarray],
    codec: str = "libx264",
    rate: int = 25,
    times_s: Sequence[float] | None = None,
    base: Fraction = TIME_BASE,
    pix_fmt: str = "yuv420p",
    rotation: int = 0,
    **options: str,
) -> Path:
    """A clip without sound, at an even rate or at these times, to be shown turned; `options` are the codec's."""
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream(codec, rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.options = pix_fmt, options
        if rotation:
            stream.set_display_rotation(rotation)
        if times_s is not None:
            stream.time_base = stream.codec_context.time_base = base
        ticks = None if times_s is None else [round(time_s / base) for time_s in times_s]
        add_pictures(out, stream, pictures, ticks, base)
    return path
