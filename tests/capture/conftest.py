"""Small clips with known content for the tests of reading them."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

MakeClip = Callable[..., Path]
TIME_BASE = Fraction(1, 90_000)


@pytest.fixture
def make_clip(tmp_path: Path) -> MakeClip:
    """Writes a clip: `make_clip(name, pictures, times_s, sound=, rate_hz=, rotation=, pix_fmt=, colour=, …)`.

    `colour` are H.273's numbers of matrix, transfer and primaries and libav's of the range. `flagged` is the range
    that the file names, where that is not the one its levels have.
    """

    def make(
        name: str,
        pictures: Sequence[np.ndarray],
        times_s: Sequence[float] | None = None,
        sound: np.ndarray | None = None,
        rate_hz: int = 48_000,
        rotation: int = 0,
        faststart: bool = False,
        pix_fmt: str = "yuv420p",
        colour: tuple[int, int, int, int] | None = None,
        flagged: int | None = None,
        crf: int = 10,
        pixel_aspect: Fraction | None = None,
    ) -> Path:
        path = tmp_path / name
        when = [i / 25 for i in range(len(pictures))] if times_s is None else times_s
        height, width = pictures[0].shape[:2] if len(pictures) else (48, 64)
        options = {"movflags": "+faststart"} if faststart else {}
        with av.open(str(path), "w", options=options) as container:
            video = container.add_stream("libx264", rate=25)
            video.width, video.height, video.pix_fmt = width, height, pix_fmt
            video.time_base = video.codec_context.time_base = TIME_BASE
            video.options = {"crf": str(crf), "g": "5"}
            if colour is not None:
                coder = video.codec_context
                coder.colorspace, coder.color_trc, coder.color_primaries, levels = colour
                coder.color_range = levels if flagged is None else flagged
            if pixel_aspect is not None:
                video.codec_context.sample_aspect_ratio = pixel_aspect
            if rotation:
                video.set_display_rotation(rotation)
            audio = None if sound is None else container.add_stream("aac", rate=rate_hz, layout="mono")
            for picture, time_s in zip(pictures, when, strict=True):
                deep = "rgb48le" if picture.dtype == np.uint16 else "rgb24"
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=deep)
                if colour is not None:
                    frame = frame.reformat(
                        format=pix_fmt, dst_colorspace=colour[0], dst_color_range=colour[3]
                    )
                    if flagged is not None:
                        frame.color_range = flagged
                frame.pts, frame.time_base = round(time_s / TIME_BASE), TIME_BASE
                container.mux(video.encode(frame))
            if len(pictures):
                container.mux(video.encode(None))
            else:
                container.start_encoding()  # a header by itself
            if audio is not None and sound is not None:
                for start in range(0, len(sound) - 1023, 1024):
                    block = sound[None, start : start + 1024].astype(np.float32)
                    frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
                    frame.sample_rate, frame.pts, frame.time_base = rate_hz, start, Fraction(1, rate_hz)
                    container.mux(audio.encode(frame))
                container.mux(audio.encode(None))
        return path

    return make


@pytest.fixture
def pictures() -> list[np.ndarray]:
    """Twelve textured pictures 64x48 in which a bright square moves; all differ."""
    rng = np.random.default_rng(0)
    ground = np.kron(rng.integers(40, 160, (6, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    out = []
    for i in range(12):
        picture = ground.copy()
        picture[20:32, 3 * i : 3 * i + 12] = 250
        out.append(picture)
    return out
