"""Folders of photos: curves that their files name, and what photos are called in messages."""

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from tests.make.datasets import write_set
from tests.make.pictures import fixed, icc_profile
from tests.refused import refused

from devrf.calibration.sweep.masks import prepare_masks
from devrf.capture.colour.photo_profile import SRGB_IN_D50
from devrf.capture.formats import read_dataset
from devrf.capture.mattes.given import read_given
from devrf.capture.orientation import Upright, by_exif
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.photos.upright_pictures import (
    copy_upright,
    probe_picture,
    read_grey,
    read_picture,
    write_picture,
)
from devrf.capture.scene import Scene, load_image
from devrf.capture.system.errors import CaptureError

PICTURE = Image.fromarray(np.full((24, 32, 3), 90, np.uint8))
CUBE = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 15, dtype=np.uint8)], indexing="ij"), -1).reshape(
    18, -1, 3
)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
SRGB_CURVE = b"para" + bytes(4) + struct.pack(">HH", 3, 0)
SRGB_CURVE += fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
GAMMA = b"curv" + bytes(4) + struct.pack(">IH", 1, 563)
LINEAR = b"curv" + bytes(4) + struct.pack(">I", 0)
SQUARE = b"curv" + bytes(4) + struct.pack(">I257H", 257, *(round(65535 * (n / 256) ** 2) for n in range(257)))
P3 = np.array([[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]])  # in D50
ADOBE = np.array([[0.6097, 0.2053, 0.1492], [0.3111, 0.6257, 0.0632], [0.0195, 0.0609, 0.7446]])
ICC = {
    "Display P3": (P3, SRGB_CURVE),
    "Adobe RGB": (ADOBE, GAMMA),
    "squares": (P3, SQUARE),
    "linear": (SRGB_IN_D50, LINEAR),
}


@pytest.mark.parametrize("name", ICC)
def test_colours_of_a_profile_are_those_of_littlecms(tmp_path: Path, name: str) -> None:
    profile = icc_profile(name, *ICC[name])
    Image.fromarray(CUBE).save(tmp_path / "a.png", icc_profile=profile)
    own, srgb = (ImageCms.ImageCmsProfile(BytesIO(data)) for data in (profile, SRGB))
    shown = ImageCms.profileToProfile(Image.fromarray(CUBE), own, srgb, ImageCms.Intent.RELATIVE_COLORIMETRIC)
    want = np.asarray(shown).astype(int)
    for got in (read_picture(tmp_path / "a.png"), read_pixels(tmp_path / "a.png")):
        np.testing.assert_allclose(got.astype(int), want, atol=2)
    (tmp_path / "in").mkdir()
    copy_upright(probe_picture(tmp_path / "a.png"), Upright(), tmp_path / "in", "000000")
    np.testing.assert_allclose(read_pixels(tmp_path / "in" / "000000.png").astype(int), want, atol=2)


@pytest.mark.parametrize("kind", ["cICP", "cHRM", "R03"])
def test_colours_without_a_profile(tmp_path: Path, kind: str) -> None:
    """PNG says P3 by numbers, or its primaries; cameras say Adobe RGB by the name of the option file alone."""
    chunks, exif = PngInfo(), Image.Exif()
    if kind == "cICP":
        chunks.add(b"cICP", bytes([12, 13, 0, 1]))
    if kind == "cHRM":
        places = (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
        chunks.add(b"cHRM", struct.pack(">8I", *(round(100_000 * p) for p in places)))
    if kind == "R03":
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {ExifTags.Interop.InteropIndex: "R03"}
    green = Image.fromarray(np.full((16, 16, 3), (90, 200, 90), np.uint8))
    said, profiled = tmp_path / f"a.{'jpg' if kind == 'R03' else 'png'}", tmp_path / "b.png"
    coded: dict[str, Any] = {"quality": 100, "subsampling": 0}
    if kind == "R03":
        green.save(said, exif=exif, **coded)
    else:
        green.save(said, pnginfo=chunks)
    green.save(profiled, icc_profile=icc_profile("x", *ICC["Adobe RGB" if kind == "R03" else "Display P3"]))
    np.testing.assert_allclose(read_pixels(said).astype(int), read_pixels(profiled), atol=2)
    assert read_pixels(said)[0, 0, 0] < 70


@pytest.mark.parametrize("name", ["Adobe RGB", "Display P3"])
@pytest.mark.parametrize("layout", ["nerfstudio", "colmap", "llff", "blender", "devrf"])
def test_pictures_of_data_sets_are_brought_to_srgb(
    odd_scene: Scene, tmp_path: Path, layout: Any, name: str
) -> None:
    """As photos of a capture are: what training sees is what a program shows that knows profiles."""
    folder, notes = tmp_path / "set", []
    write_set(layout, odd_scene, folder)
    frame = read_dataset(layout, folder).static[2]
    plain = load_image(frame, 1.0, "black").astype(int)
    with Image.open(frame.path) as image:
        image.convert("RGB").save(frame.path, icc_profile=icc_profile(name, *ICC[name]))
    own, srgb = (ImageCms.ImageCmsProfile(BytesIO(data)) for data in (icc_profile(name, *ICC[name]), SRGB))
    with Image.open(frame.path) as image:
        shown = ImageCms.profileToProfile(image, own, srgb, ImageCms.Intent.RELATIVE_COLORIMETRIC)
    (again,) = (f for f in read_dataset(layout, folder, notes=notes).static if f.path == frame.path)
    seen = load_image(again, 1.0, "black").astype(int)
    np.testing.assert_allclose(seen, np.asarray(shown), atol=2)
    assert np.abs(seen - plain).mean() > 4
    assert [name in note for note in notes if "colour profile" in note] == [True]


def test_profiles_of_photos_are_named(tmp_path: Path) -> None:
    """What is brought to sRGB is a note; linear light in 8 bits and what is not read are faults; sRGB is nothing."""
    folder = tmp_path / "in"
    folder.mkdir()
    for name, profile in (
        ("a.jpg", SRGB),
        ("b.jpg", None),
        ("c.jpg", icc_profile("near", SRGB_IN_D50, SRGB_CURVE)),
    ):
        PICTURE.save(folder / name, icc_profile=profile)
    chunk = PngInfo()
    chunk.add(b"gAMA", struct.pack(">I", 45_455))
    PICTURE.save(folder / "d.png", pnginfo=chunk)
    got = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert got.faults == () and got.notes == ()
    assert (tmp_path / str(got.frames[2].file)).read_bytes() == (folder / "c.jpg").read_bytes()
    PICTURE.save(folder / "e.tif", icc_profile=icc_profile("Display P3", *ICC["Display P3"]))
    chunk = PngInfo()
    chunk.add(b"gAMA", struct.pack(">I", 100_000))
    PICTURE.save(folder / "f.png", pnginfo=chunk)
    PICTURE.save(folder / "g.jpg", icc_profile=icc_profile("table", P3, b"mft2" + bytes(8)))
    PICTURE.save(folder / "h.jpg", icc_profile=b"cut short")
    falls = b"para" + bytes(4) + struct.pack(">HH", 0, 0) + fixed(-2.2)
    PICTURE.save(folder / "i.jpg", icc_profile=icc_profile("falls", P3, falls))
    got = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert any("1 of 9" in note and "Display P3" in note and "e.tif" in note for note in got.notes)
    unread, linear = got.faults
    assert [(f.code, f.why) for f in got.faults] == [("coding", "profile"), ("coding", "linear")]
    assert all(named in str(unread.value) for named in ("3 of 9", "table", "falls", "g.jpg, h.jpg, i.jpg"))
    assert all(named in str(linear.value) for named in ("1 of 9", "gamma of 1", "f.png"))


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
        picture = "000000.jpg"
        prepare_masks(
            tmp_path, {picture: f"{name}.jpg"}, {picture: (64, 48)}, tmp_path / "out", {picture: turn}
        )
        kept = read_pixels(tmp_path / "out" / f"{picture}.png")[..., 0]
        assert kept[5, 5] == 255 and kept[5, 50] == 0 and kept.shape == (48, 64)
