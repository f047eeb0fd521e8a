"""Colours of decoded pictures: matrices, ranges, more than eight bits, HDR; and JPEG made straight from the planes."""

import cv2
import numpy as np
import pytest

from devrf.capture.colour.tone_mapping import FULL_CODE, srgb_from_hdr
from devrf.capture.video.reader import VideoFrame, VideoReader
from devrf.capture.video.video_jpeg import jfif_planes, jpeg_of

PATCHES = np.array(
    [[255, 255, 255], [200, 60, 30], [20, 200, 90], [40, 60, 210], [128, 128, 128], [0, 0, 0]], np.uint8
)
BT709, BT601, BT2020 = 1, 6, 9
LIMITED, FULL = 1, 2
# Luma and colour differences in 8 bits are each off by half a level, by one after coding at quality 100 or crf 1;
# blue is luma plus 1.9 times its difference (limited range: times 255/219).
LEVELS = 4


def chart(height: int = 48, width: int = 96) -> np.ndarray:
    """Patches 16 pixels wide."""
    return np.tile(PATCHES[np.minimum(np.arange(width) // 16, 5)], (height, 1, 1))


def first(path) -> VideoFrame:
    with VideoReader(path) as reader:
        return next(iter(reader))


def patches(rgb: np.ndarray) -> np.ndarray:
    """Colours in the middle of each patch."""
    return rgb[20:28, 4:96:16].astype(int).mean(axis=0)


@pytest.mark.parametrize("levels", [LIMITED, FULL])
@pytest.mark.parametrize("matrix", [BT709, BT601])
@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv420p10le"])
def test_colours_by_the_files_matrix_and_range(make_clip, matrix, levels, pix_fmt):
    colour = (matrix, 1, 1, levels)
    frame = first(make_clip("a.mp4", [chart()] * 2, pix_fmt=pix_fmt, colour=colour, crf=1))
    np.testing.assert_allclose(patches(frame.rgb), PATCHES, atol=LEVELS)
    small = frame.stored_rgb(48)
    assert small.shape == (24, 48, 3)
    np.testing.assert_allclose(small[12, 4:48:8].astype(int), PATCHES, atol=LEVELS)
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY) if pix_fmt != "yuv420p" else None
    luma = {BT709: [0.2126, 0.7152, 0.0722], BT601: [0.299, 0.587, 0.114]}[matrix] @ PATCHES.T
    if grey is None:  # luma as coded; otherwise OpenCV's BT.601
        np.testing.assert_allclose(frame.stored_grey(96)[24, 8:96:16].astype(int), luma, atol=2)


@pytest.mark.parametrize("levels", [LIMITED, FULL])
@pytest.mark.parametrize("matrix", [BT709, BT601])
def test_jpeg_from_planes_shows_the_same_colours(make_clip, matrix, levels):
    frame = first(make_clip("a.mp4", [chart()] * 2, colour=(matrix, 1, 1, levels), crf=1))
    data = jpeg_of(frame.picture, 100)
    assert data is not None
    rgb = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert rgb is not None
    np.testing.assert_allclose(patches(rgb), PATCHES, atol=LEVELS)


def test_grey_planes_are_exact(make_clip):
    """Where there is no colour, limited luma becomes round((Y - 16) * 255 / 219), and nothing else."""
    ramp = np.tile(np.arange(0, 256, 2, dtype=np.uint8)[None, :, None], (48, 1, 3))
    frame = first(make_clip("a.mp4", [ramp] * 2, colour=(BT709, 1, 1, LIMITED), crf=1))
    stored = np.asarray(frame.picture.to_ndarray())[:48].astype(float)
    planes = jfif_planes(frame.picture)
    assert planes is not None
    np.testing.assert_allclose(planes[0], np.clip((stored - 16) * 255 / 219, 0, 255), atol=1)
    assert abs(planes[1].astype(int) - 128).max() <= 1 and abs(planes[2].astype(int) - 128).max() <= 1


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_jpeg_from_planes_is_upright(make_clip, rotation):
    frame = first(make_clip("a.mp4", [chart()] * 2, rotation=rotation, crf=1))
    data = jpeg_of(frame.picture, 100, frame.upright)
    assert data is not None
    rgb = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert rgb is not None
    assert rgb.shape == frame.rgb.shape == np.rot90(chart(), rotation // 90).shape
    flat = np.rot90(rgb, -rotation // 90)
    np.testing.assert_allclose(patches(flat), PATCHES, atol=LEVELS)


def test_what_is_not_420_in_bytes_goes_another_way(make_clip):
    frame = first(make_clip("a.mp4", [chart()] * 2, pix_fmt="yuv444p", colour=(BT709, 1, 1, LIMITED), crf=1))
    assert jpeg_of(frame.picture, 95) is None
    np.testing.assert_allclose(patches(frame.rgb), PATCHES, atol=LEVELS)


# --- HDR: the signal levels of ITU-R BT.2408-7, Table 1 ---


@pytest.mark.parametrize(
    "transfer, signal, reflectance, cd_m2",
    [("HLG", 0.38, 0.18, 26), ("PQ", 0.38, 0.18, 26), ("HLG", 0.75, 1.0, 203), ("PQ", 0.58, 1.0, 203)],
)
def test_reference_levels_of_hdr(transfer, signal, reflectance, cd_m2):
    code = np.full((2, 3, 3), round(signal * FULL_CODE), np.uint16)
    linear = cd_m2 / 203
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    # The table's signal is rounded to a percent, its light to a cd/m2: about 4 % of light, two levels at grey.
    assert np.abs(srgb_from_hdr(code, transfer).astype(int) - expected).max() <= 3


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_hdr_grows_with_the_signal_and_clips_above_reference_white(transfer):
    ramp = np.linspace(0, FULL_CODE, 600).round().astype(np.uint16)[None, :, None].repeat(3, axis=2)
    out = srgb_from_hdr(ramp, transfer)[0].astype(int)
    assert (np.diff(out, axis=0) >= 0).all() and out[0].tolist() == [0, 0, 0]
    white = {"HLG": 0.75, "PQ": 0.581}[transfer]
    assert (out[int(600 * white) + 2 :] == 255).all() and (out[: int(600 * (white - 0.03))] < 255).all()
    assert np.ptp(out, axis=1).max() <= 1  # grey stays grey


def test_hdr_primaries():
    """A BT.2020 colour that lies in BT.709: the inverse of BT.2087's matrix leads back to it."""
    from_709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
    linear = np.array([0.5, 0.2, 0.1])
    light = from_709 @ linear * 203 / 10_000
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875  # BT.2100-2, Table 4
    signal = ((c1 + c2 * light**m1) / (1 + c3 * light**m1)) ** m2
    code = (signal * FULL_CODE).round().astype(np.uint16)[None, None]
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb_from_hdr(code, "PQ")[0, 0], expected, atol=1)


@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv420p10le"])
def test_a_clip_in_p3_is_brought_to_srgb(make_clip, tmp_path, pix_fmt):
    """A red of sRGB as P3 codes it, and grey, which stays."""
    p3 = np.array([[[184, 63, 40], [128, 128, 128]]], np.uint8).repeat(48, axis=0).repeat(48, axis=1)
    path = make_clip("p3.mp4", [p3] * 2, pix_fmt=pix_fmt, colour=(BT709, 1, 12, LIMITED), crf=1)
    frame = first(path)
    np.testing.assert_allclose(
        frame.rgb[24, [20, 76]].astype(int), [[200, 50, 25], [128, 128, 128]], atol=LEVELS
    )
    assert jpeg_of(frame.picture, 100) is None
    with VideoReader(path) as reader:
        assert any("Display P3" in note for note in reader.info.notes)


def test_an_hlg_clip_is_read_by_the_rule(make_clip):
    grey = np.full((48, 64, 3), round(0.38 * 65535), np.uint16)
    path = make_clip("hlg.mp4", [grey] * 3, pix_fmt="yuv420p10le", colour=(BT2020, 18, 9, LIMITED))
    frame = first(path)
    assert np.abs(frame.rgb.astype(int) - 100).max() <= 3
    assert np.abs(frame.stored_grey(64).astype(int) - 100).max() <= 3
    with VideoReader(path) as reader:
        assert "(HLG)" in reader.info.notes[0]
