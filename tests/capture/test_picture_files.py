"""Pictures come out of their files as they were put in; OpenCV, where it is installed, agrees."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.refused import refused

from devrf.capture.photos.picture_files import damaged_pictures, read_pixels, read_reduced, write_png
from devrf.capture.photos.resize import shrink
from devrf.capture.system.errors import CaptureError


def noise(*shape: int, top: int = 256, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, top, shape).astype(dtype)


def by_opencv(path: Path) -> np.ndarray:
    """What `read_pixels` promises, by another reader."""
    cv2 = pytest.importorskip("cv2")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image.dtype == np.uint16:
        image = (image / 257.0).round().astype(np.uint8)
    if image.ndim == 2:
        image = image[:, :, None].repeat(3, axis=2)
    return image[..., [2, 1, 0, 3][: image.shape[2]]]


@pytest.mark.parametrize("channels", [3, 4])
def test_what_is_written_is_read(tmp_path, channels):
    picture = noise(20, 30, channels)
    write_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), picture)
    np.testing.assert_array_equal(by_opencv(tmp_path / "a.png"), picture)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_every_kind_of_picture(tmp_path, mode, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(noise(20, 30, 4)).convert("RGBA" if "A" in mode else "RGB").convert(mode).save(path)
    picture = read_pixels(path)
    assert picture.shape == (20, 30, 4 if "A" in mode else 3) and picture.dtype == np.uint8
    if suffix == "png" or mode not in ("LA", "RGBA", "P"):  # OpenCV multiplies or drops the alpha of TIFFs
        np.testing.assert_array_equal(picture, by_opencv(path))


@pytest.mark.parametrize("mode", ["P", "RGB", "L"])
def test_a_transparent_colour(tmp_path, mode):
    image = Image.fromarray(noise(20, 30, 3)).convert(mode)
    first = image.getpixel((0, 0))
    image.save(tmp_path / "a.png", transparency=first)
    picture = read_pixels(tmp_path / "a.png")
    np.testing.assert_array_equal(picture, by_opencv(tmp_path / "a.png"))
    if mode != "L":
        assert picture[0, 0, 3] == 0 and (picture[..., 3] == 255).any()


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3), (20, 30, 4)])
def test_16_bits_are_rounded(tmp_path, shape):
    cv2 = pytest.importorskip("cv2")  # Pillow writes no colours of 16 bits
    deep = noise(*shape, top=65536, dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), deep if len(shape) == 2 else deep[..., [2, 1, 0, 3][: shape[2]]])
    expected = np.round(deep / 257.0).astype(np.uint8)
    expected = expected if len(shape) == 3 else expected[:, :, None].repeat(3, axis=2)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), expected)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_exif_orientation_is_left_alone(tmp_path, suffix):
    exif = Image.Exif()
    exif[0x112] = 6  # a quarter turn
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(noise(20, 30, 3)).save(path, exif=exif)
    picture = read_pixels(path)
    assert picture.shape == (20, 30, 3)
    assert np.abs(picture.astype(int) - by_opencv(path)).max() <= 1


def test_real_pictures_are_those_of_opencv(data_dir):
    for folder in ("lego_blender_400/train", "fox_static/images", "devrf_cloth/static/train"):
        path = sorted((data_dir / folder).iterdir())[0]
        assert np.abs(read_pixels(path).astype(int) - by_opencv(path)).max() <= 1, path


def test_damaged_and_missing_files_are_named(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, noise(20, 30, 3))
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"hello", b""):
        path.write_bytes(content)
        with refused("picture-unreadable", path, kind=CaptureError):
            read_pixels(path)
    with refused("picture-missing", "b.png", kind=CaptureError):
        read_pixels(tmp_path / "b.png")
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "c.tif")
    with refused("picture-kind-unread", "c.tif", kind=CaptureError):
        read_pixels(tmp_path / "c.tif")


def test_pictures_that_end_early_are_found(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("good.png", "short.png", "short.jpg")]
    for path in paths:
        Image.fromarray(noise(64, 64, 3)).save(path)
    for path in paths[1:]:
        path.write_bytes(path.read_bytes()[:-700])
    found = damaged_pictures(paths)
    assert len(found) == 2 and all(str(path) in text for path, text in zip(paths[1:], found, strict=True))


@pytest.mark.parametrize(
    ("wanted", "divisor"), [((40, 30), 8), ((60, 40), 4), ((150, 100), 2), ((300, 200), 1)]
)
def test_a_large_jpeg_is_decoded_smaller_where_that_is_enough(tmp_path, wanted, divisor):
    coarse = Image.fromarray(noise(16, 20, 3))
    coarse.resize((800, 640), Image.Resampling.BICUBIC).save(tmp_path / "a.jpg", quality=95)
    picture, found = read_reduced(tmp_path / "a.jpg", *wanted)
    assert found == divisor and picture.shape == (640 // divisor, 800 // divisor, 3)
    exact = shrink(read_pixels(tmp_path / "a.jpg"), *wanted).astype(float)
    left = np.abs(shrink(picture, *wanted) - exact)
    assert left.mean() < 2


@pytest.mark.parametrize("name", ["a.png", "odd.jpg"])
def test_other_pictures_and_sides_that_do_not_divide_are_read_whole(tmp_path, name):
    Image.fromarray(noise(400, 401 if name == "odd.jpg" else 400, 3)).save(tmp_path / name)
    picture, divisor = read_reduced(tmp_path / name, 40, 40)
    assert divisor == 1
    np.testing.assert_array_equal(picture, read_pixels(tmp_path / name))
