"""Folders of photos: curves that their files name, and what photos are called in messages."""

import struct

import numpy as np
import pytest
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from tests.refused import refused

from devrf.calibration.sweep.masks import prepare_masks
from devrf.capture.colour.photo_curve import declared_gamma
from devrf.capture.mattes.given import read_given
from devrf.capture.orientation import by_exif
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.photos.upright_pictures import read_grey, read_picture, write_picture
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


@pytest.mark.parametrize(("other", "count"), [(6, 4), (6, 9), (3, 4), (8, 4)])
@pytest.mark.parametrize("suffix", ["jpg", "tif", "png"])
def test_photos_of_one_camera_are_turned_alike(tmp_path, other, count, suffix):
    """Cameras that look down guess their turn. One sensor, one lens: the same pixels of all are the same place."""
    cells = np.random.default_rng(0).integers(40, 200, (20, 3, 4, 3))
    pictures = np.kron(cells, np.ones((1, 16, 16, 1))).astype(np.uint8)
    folder = tmp_path / "in"
    folder.mkdir()
    for n, picture in enumerate(pictures):
        exif = Image.Exif()
        exif[0x0112] = 6 if n >= count else other if other != 6 else 1
        Image.fromarray(picture).save(folder / f"{n}.{suffix}", exif=exif)
    got = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert len(got.used) == 20 and (got.width, got.height) == (48, 64)
    assert (got.rotation_deg, got.mirrored) == (270, False)
    assert any(str(count) in note and f"0.{suffix}" in note for note in got.notes)
    for frame, picture in zip(got.used, pictures, strict=True):
        shown = read_picture(tmp_path / str(frame.file)).astype(int)
        assert np.abs(shown - np.rot90(picture, -1)).mean() < 8  # of two codings; turned otherwise 50
        assert read_grey(tmp_path / str(frame.file)).shape == (64, 48)
    first = got.frames[0]  # what a program shows that turns each photo by its own tag
    own = by_exif(first.own_orientation or 1).apply(pictures[0])
    np.testing.assert_array_equal(first.re_turned.apply(own), np.rot90(pictures[0], -1))


def test_two_cameras_have_a_turn_each(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for n in range(10):
        exif = Image.Exif()
        exif[0x010F], exif[0x0112] = ("one", 6) if n < 5 else ("other", 1)
        PICTURE.save(folder / f"{n}.jpg", exif=exif)
    got = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert [f.orientation for f in got.frames] == [6] * 5 + [1] * 5 and len(got.used) == 10


def test_mattes_and_masks_follow_the_turn_that_was_chosen(tmp_path):
    """A matte made of a photo as programs show it, and one of the photo that is used."""
    own, used = by_exif(6), by_exif(1)
    matte = np.zeros((48, 64), np.uint8)
    matte[:20, :30] = 255
    turn = own.inverse.then(used)
    for name, drawn in (("own", own.apply(matte)), ("used", matte)):
        write_png(tmp_path / f"{name}.png", drawn)
        np.testing.assert_array_equal(read_given(tmp_path / f"{name}.png", 64, 48, False, turn), matte)
        (tmp_path / "out").mkdir(exist_ok=True)
        pictures, sizes = {f"{name}.jpg": f"{name}.jpg"}, {f"{name}.jpg": (64, 48)}
        prepare_masks(tmp_path, pictures, sizes, tmp_path / "out", {f"{name}.jpg": turn})
        kept = read_pixels(tmp_path / "out" / f"{name}.jpg.png")[..., 0]
        assert kept[5, 5] == 255 and kept[5, 50] == 0 and kept.shape == (48, 64)
