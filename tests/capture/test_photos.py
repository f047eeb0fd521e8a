"""Folders of photos: curves that their files name, and what photos are called in messages."""

import struct

import numpy as np
import pytest
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from tests.refused import refused

from devrf.capture.colour.photo_curve import declared_gamma
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.system.errors import CaptureError

PICTURE = Image.fromarray(np.full((24, 32, 3), 90, np.uint8))


def profile(curve: bytes) -> bytes:
    """An ICC profile of nothing but a green curve (ICC.1:2022, 7.2 to 7.3 and 10)."""
    return bytes(128) + struct.pack(">I4sII", 1, b"gTRC", 144, len(curve)) + curve


CURVES = {
    "linear": (b"curv" + bytes(4) + struct.pack(">I", 0), 1.0),
    "gamma": (b"curv" + bytes(4) + struct.pack(">IH", 1, round(1.8 * 256)), 1.8),
    "formula": (b"para" + bytes(4) + struct.pack(">HHi", 0, 0, round(2.2 * 65536)), 2.2),
    "table": (
        b"curv" + bytes(4) + struct.pack(">I257H", 257, *(round(65535 * (n / 256) ** 2) for n in range(257))),
        2.0,
    ),
    "cut short": (b"curv" + bytes(4) + struct.pack(">I", 9), None),
    "unknown": (b"mft2" + bytes(8), None),
}


@pytest.mark.parametrize("name", CURVES)
def test_curves_of_profiles(tmp_path, name):
    curve, gamma = CURVES[name]
    PICTURE.save(tmp_path / "a.tif", icc_profile=profile(curve))
    with Image.open(tmp_path / "a.tif") as image:
        # 8 bits after the point
        assert declared_gamma(image) == (gamma and pytest.approx(gamma, abs=1 / 256))


def test_photos_that_hold_linear_light_are_named(tmp_path):
    """A17: one says so in a profile, one in PNG's own chunk; sRGB and photos that say nothing are as expected."""
    folder = tmp_path / "in"
    folder.mkdir()
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    PICTURE.save(folder / "a.jpg", icc_profile=srgb)
    PICTURE.save(folder / "b.png")
    assert extract_folder(folder, tmp_path, "static", "sweep", "in").faults == ()
    PICTURE.save(folder / "c.tif", icc_profile=profile(CURVES["linear"][0]))
    chunk = PngInfo()
    chunk.add(b"gAMA", struct.pack(">I", 100_000))
    PICTURE.save(folder / "d.png", pnginfo=chunk)
    (fault,) = extract_folder(folder, tmp_path, "static", "sweep", "in").faults
    assert (fault.code, fault.why) == ("coding", "linear")
    assert all(named in str(fault.value) for named in ("2 of 4", "gamma of 1", "sRGB", "c.tif, d.png"))


def test_photos_are_called_by_their_names(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for n in range(4):
        write_picture(folder / f"IMG_{n + 7}.png", np.zeros((20 if n == 2 else 24, 32, 3), np.uint8))
    got = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert [frame.place for frame in got.frames] == [f"IMG_{n}.png" for n in (7, 8, 9, 10)]
    assert "1 of 32x20" in got.notes[-1] and "(IMG_9.png)" in got.notes[-1]


def test_a_photo_that_breaks_off_is_named(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(noise).save(folder / name)
    whole = (folder / "b.jpg").read_bytes()
    (folder / "b.jpg").write_bytes(whole[: 2 * len(whole) // 3])
    with refused("picture-unreadable", "in/b.jpg", kind=CaptureError):
        extract_folder(folder, tmp_path, "static", "sweep", "in")
