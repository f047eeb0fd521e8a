"""Films: what was written is read back with another call chain, by size, count, time and colour."""

import hashlib
import os
import subprocess
import sys

import av
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.system.errors import CaptureError
from devrf.capture.video.video_writer import video_beside, write_video


def _flat(colour, height=48, width=64):
    return np.full((height, width, 3), colour, dtype=np.uint8)


def _read(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = list(container.decode(stream))
        return stream.codec_context, frames


def test_colours_count_and_rate_survive(tmp_path):
    colours = [(220, 40, 40), (40, 200, 60), (30, 60, 210), (128, 128, 128)]
    path = tmp_path / "film.mp4"
    assert write_video(path, (_flat(c) for c in colours), fps=12.5) == 4
    codec, frames = _read(path)
    assert codec.name == "h264" and codec.pix_fmt == "yuv420p"
    assert float(frames[1].time - frames[0].time) == pytest.approx(1 / 12.5)
    assert len(frames) == 4
    for frame, colour in zip(frames, colours, strict=True):
        assert frame.colorspace == 1  # BT.709: what the player must use to get our colours back
        seen = frame.reformat(format="rgb24", src_colorspace="itu709", dst_colorspace="itu709").to_ndarray()
        # limited-range 8-bit YUV resolves 255/219 of a step, twice rounded, plus the encoder: 4 of 255
        assert np.abs(seen.reshape(-1, 3).mean(0) - colour).max() < 4


def test_odd_sizes_become_even(tmp_path):
    path = tmp_path / "odd.mp4"
    write_video(path, [_flat((9, 9, 9), 47, 63)] * 2, fps=10.0)
    codec, _ = _read(path)
    assert (codec.width, codec.height) == (64, 48)


def test_index_is_in_front(tmp_path):
    path = tmp_path / "film.mp4"
    write_video(path, [_flat((0, 0, 0))] * 3, fps=10.0)
    data = path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_no_pictures_other_sizes_and_a_missing_folder_are_errors_and_leave_no_file(tmp_path):
    with refused("pictures-none", "film.mp4", kind=CaptureError):
        write_video(tmp_path / "film.mp4", [], fps=10.0)
    with refused("picture-size-wrong", "picture 1", "32x32", kind=CaptureError):
        write_video(tmp_path / "film.mp4", [_flat((0, 0, 0)), _flat((0, 0, 0), 32, 32)], fps=10.0)
    assert not (tmp_path / "film.mp4").exists()
    with refused("file-unwritable", "nowhere", kind=CaptureError):
        write_video(tmp_path / "nowhere" / "film.mp4", [_flat((0, 0, 0))], fps=10.0)


def test_a_film_is_written_beside_other_work(tmp_path):
    path = tmp_path / "film.mp4"
    with video_beside(path, 10.0) as put:
        for n in range(12):  # more than may wait
            put(_flat((20 * n, 90, 90)))
    assert len(_read(path)[1]) == 12


def test_an_error_on_either_side_leaves_no_film(tmp_path):
    path = tmp_path / "film.mp4"
    with pytest.raises(KeyboardInterrupt), video_beside(path, 10.0) as put:
        put(_flat((1, 2, 3)))
        raise KeyboardInterrupt
    assert not path.exists()
    with refused("picture-size-wrong", "picture 1", "32x48", "64x48", kind=CaptureError):
        with video_beside(path, 10.0) as put:
            put(_flat((1, 2, 3)))
            for _ in range(20):
                put(_flat((1, 2, 3), width=32))
    with refused("pictures-none", "film.mp4", kind=CaptureError), video_beside(path, 10.0):
        pass
    assert not path.exists()


NOISE = """
import sys
import numpy as np
from devrf.capture.video.video_writer import write_video
pictures = np.random.default_rng(0).integers(0, 256, (24, 22, 30, 3), np.uint8).repeat(16, 1).repeat(16, 2)
write_video(sys.argv[1], (np.roll(p, n, 1) for n, p in enumerate(pictures)), 25.0)
"""


def test_the_same_pictures_give_the_same_file(tmp_path):
    """480 pixels across: the encoder's defaults read memory that nobody wrote, which differs between processes."""
    files = [tmp_path / f"{fill}.mp4" for fill in (1, 77, 200)]
    for file in files:
        fill = {"MALLOC_PERTURB_": file.stem}  # what unwritten memory holds, where the C library is GNU's
        subprocess.run([sys.executable, "-c", NOISE, str(file)], check=True, env=os.environ | fill)
    assert len({hashlib.sha256(file.read_bytes()).hexdigest() for file in files}) == 1
