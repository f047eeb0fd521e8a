"""RAW: one recipe for a set, nothing adapted to the single picture."""

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from tests.refused import refused

from devrf.capture.colour.srgb import linear_from_srgb, srgb_from_linear
from devrf.capture.photos import raw_set
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.raw import Development, Recipe, develop, is_raw, recipe_for
from devrf.capture.photos.raw_set import develop_set, read_raw_sidecar
from devrf.capture.photos.upright_pictures import probe_picture, read_picture
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import CaptureError, InputError
from devrf.lab.simulate.session.dng import DngTags, mosaic, write_dng

HEIGHT, WIDTH = 96, 128
BLACK, WHITE = (512, 512, 512, 512), 16383
# Linear interpolation between sensor pixels at most two apart errs by half the second derivative: 0.2 / 20² / 2 x 2 =
# 0.0005 for the sine below, nothing for the ramps; rounding to 14 bits adds 0.00003, the matrix of the file 0.00005
# times the value (it is inverted with four decimals). At the picture's rim LibRaw repeats a neighbour.
TRUTH = 0.001


def light(gain: float = 1.0) -> Float[np.ndarray, "h w 3"]:
    """A smooth picture in linear light, each channel its own."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    red, green = 0.1 + 0.6 * x / WIDTH, 0.2 + 0.5 * y / HEIGHT
    return gain * np.stack([red, green, 0.5 - 0.3 * x / WIDTH + 0.2 * np.sin(y / 20)], axis=-1)


def shot(path: Path, picture: np.ndarray | None = None, white: int = WHITE, **tags: Any) -> Path:
    """A photo of the light or of another picture; `tags` say other things of it than are so."""
    pixels = mosaic(light() if picture is None else picture, "RGGB", BLACK, white)
    write_dng(path, pixels, DngTags(**{"black": BLACK, "white": white, **tags}))
    return path


def inside(picture: np.ndarray) -> np.ndarray:
    """Without the rim."""
    return picture[1:-1, 1:-1]


def test_srgb_curve():
    x = np.linspace(0, 1, 257)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(x)), x, atol=1e-12)
    assert srgb_from_linear(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0])
    assert srgb_from_linear(np.array(0.2140411)) == pytest.approx(0.5, abs=1e-6)  # IEC 61966-2-1


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize(
    ("black", "white"), [((0, 0, 0, 0), 65535), (BLACK, WHITE), ((500, 512, 520, 530), 4095)]
)
def test_develops_to_its_own_truth(tmp_path, pattern, black, white):
    path = tmp_path / "a.dng"
    write_dng(
        path, mosaic(light(), pattern, black, white), DngTags(pattern=pattern, black=black, white=white)
    )
    photo = develop(path)
    np.testing.assert_allclose(inside(photo.linear / 65535), inside(light()), atol=TRUTH)
    # Eight bits: half a level more, and the slope of the curve at the darkest value (0.1) is 1.6.
    np.testing.assert_allclose(
        inside(photo.rgb / 255), inside(srgb_from_linear(light())), atol=1.6 * TRUTH + 0.5 / 255
    )
    assert photo.clipped == 0 and photo.below_black == 0 and photo.header.white == white


def test_exposures_keep_their_ratio(tmp_path):
    """No automatic brightness: a photo with half the light is half as bright."""
    for gain in (0.25, 0.5, 1.0):
        shot(tmp_path / f"{gain}.dng", light(gain))
    recipe = recipe_for([tmp_path / "1.0.dng"])
    pictures = {gain: develop(tmp_path / f"{gain}.dng", recipe).linear / 65535 for gain in (0.25, 0.5, 1.0)}
    for gain in (0.25, 0.5):
        np.testing.assert_allclose(inside(pictures[gain]), gain * inside(pictures[1.0]), atol=2 * TRUTH)


def test_one_white_balance_and_one_white_level_for_all(tmp_path):
    a = shot(tmp_path / "a.dng", light(0.5))
    # what the camera chose for this photo has no say
    b = tmp_path / "b.dng"
    write_dng(
        b,
        mosaic(light(0.5), "RGGB", BLACK, WHITE),
        DngTags(black=BLACK, white=12000, neutral=(0.5, 1.0, 0.7)),
    )
    b_says = develop(b).header
    assert b_says.as_shot is not None and b_says.as_shot == pytest.approx((2, 1, 1 / 0.7), rel=1e-5)
    assert b_says.white == 12000
    recipe = recipe_for([a, b])
    assert max(recipe.white_balance) == pytest.approx(1, abs=1e-3)
    one, other = (develop(path, recipe).linear for path in (a, b))
    np.testing.assert_array_equal(one, other)
    given = recipe_for([a, b], (4.0, 2.0, 2.0, 2.0))
    assert given.white_balance == (2.0, 1.0, 1.0, 1.0)
    red = develop(a, given).linear[..., 0] / 65535
    np.testing.assert_allclose(inside(red), inside(light()[..., 0]), atol=2 * TRUTH)


def test_a_set_is_turned_once_and_alike(tmp_path):
    for name, orientation in (("0.dng", 6), ("1.dng", 1), ("2.dng", 6)):  # held upright but for one
        shot(tmp_path / name, orientation=orientation)
    paths = [tmp_path / f"{n}.dng" for n in range(3)]
    recipe = recipe_for(paths)
    assert [develop(path).header.upright.degrees for path in paths] == [270, 0, 270]
    assert recipe.upright.degrees == 270
    for path in paths:  # one sensor, one set of intrinsics
        got = develop(path, recipe).linear / 65535
        np.testing.assert_allclose(inside(got), inside(np.rot90(light(), -1)), atol=TRUTH)
    info = probe_picture(tmp_path / "0.dng")
    assert (info.width, info.height, info.upright.degrees) == (HEIGHT, WIDTH, 270)
    assert read_picture(tmp_path / "0.dng").shape == (WIDTH, HEIGHT, 3)


def test_set_on_disk(tmp_path):
    for n in range(5):
        shot(tmp_path / f"{n}.dng", light(1 - 0.1 * n))
    jobs = [(n, tmp_path / f"{n}.dng") for n in (0, 1, 3, 4)]
    out = tmp_path / "out"
    photos = develop_set(jobs, out, "static")
    assert list(photos) == [0, 1, 3, 4]
    sidecar = read_raw_sidecar(out / "raw" / "static.json")
    recipe, files = sidecar["recipe"], sidecar["files"]
    assert recipe["white"] == WHITE and recipe["demosaic"] == "AHD" and recipe["auto_bright"] is False
    assert recipe["libraw"].count(".") == 2 and recipe["curve"] == "sRGB"
    for (index, path), entry in zip(jobs, files, strict=True):
        photo = photos[index]
        assert entry["source"] == path.name
        assert entry["file"] == photo.file == f"frames/static/{index:06d}.png"
        assert entry["black"] == list(BLACK) and entry["white"] == WHITE and len(entry["camera_matrix"]) == 3
        linear = develop(path).linear / 65535
        np.testing.assert_allclose(inside(linear), inside(light(1 - 0.1 * index)), atol=TRUTH)
        rgb = read_picture(out / photo.file)
        np.testing.assert_array_equal(rgb, develop(path).rgb)
        assert (photo.height, photo.width) == rgb.shape[:2]
    (out / "raw" / "static.json").write_text(json.dumps({"files": []}))
    with refused("file-damaged", "static.json", "--from ingest", kind=CaptureError):
        read_raw_sidecar(out / "raw" / "static.json")


def test_side_by_side_and_no_more(tmp_path, monkeypatch):
    """As many photos at once as there are cores, however many there are."""
    shot(tmp_path / "a.dng")
    cores = usable_cores()
    at_once, most, guard = 0, 0, threading.Lock()

    def slow(path: Path, recipe: Recipe) -> Development:
        nonlocal at_once, most
        with guard:
            at_once += 1
            most = max(most, at_once)
        time.sleep(0.1)  # long against the start of a thread
        with guard:
            at_once -= 1
        return develop(path, recipe)

    monkeypatch.setattr(raw_set, "develop", slow)
    jobs = [(n, tmp_path / "a.dng") for n in range(3 * cores)]
    done: list[float] = []
    develop_set(jobs, tmp_path / "out", "static", None, lambda share, _: done.append(share))
    assert most == cores and done == sorted(done) and done[-1] == 1


def test_folder(tmp_path):
    """A folder of RAW photos, of which the sharpest of each window is used."""
    rng = np.random.default_rng(0)
    (tmp_path / "in").mkdir()
    for n in range(4):
        texture = rng.uniform(0.2, 0.2 + 0.2 * (n % 2), (HEIGHT, WIDTH, 3))  # odd ones have more of it
        shot(tmp_path / "in" / f"{n}.dng", texture)
    out = tmp_path / "out"
    frames = extract_folder(
        tmp_path / "in", out, "static", "sweep", "in", most=2, white_balance=(2.0, 1.0, 1.0, 1.0)
    )
    assert (frames.width, frames.height) == (WIDTH, HEIGHT)
    assert [frame.index for frame in frames.used] == [1, 3]
    assert sorted(p.name for p in (out / "frames/static").iterdir()) == ["000001.png", "000003.png"]
    sidecar = read_raw_sidecar(out / "raw" / "static.json")
    assert len(sidecar["files"]) == 4 and sidecar["recipe"]["white_balance"] == [2.0, 1.0, 1.0, 1.0]


def test_wrong_levels_are_measured(tmp_path):
    raw = mosaic(light(0.1), "RGGB", BLACK, WHITE)
    write_dng(
        tmp_path / "black.dng", raw, DngTags(black=(1500, 1500, 1500, 1500), white=WHITE)
    )  # true is 512
    write_dng(tmp_path / "none.dng", raw, DngTags(white=WHITE))
    saturated = np.minimum(mosaic(light(2.0), "RGGB", BLACK, 4095), 3800)
    write_dng(tmp_path / "white.dng", saturated, DngTags(black=BLACK, white=4095))
    high, none, white = (develop(tmp_path / f"{name}.dng") for name in ("black", "none", "white"))
    below = float((raw < 1500 - 0.002 * (WHITE - 1500)).mean())
    assert high.below_black == pytest.approx(below, abs=1e-3) and below > 0.05
    assert none.floor > 0.03 and none.below_black == 0
    assert white.highest == 3800 and white.at_highest > 100  # pixels pile up below the white level
    bright = develop(shot(tmp_path / "bright.dng", np.clip(light(2.0), 0, 1)))
    assert bright.clipped > 0.2  # red is at white in the right quarter: 0.1 + 0.6 x at twice the light


def test_real_raw_file(data_dir):
    path = data_dir / "raw" / "RAW_KODAK_DC50.KDC"
    assert is_raw(path) and not is_raw(path.with_suffix(".jpg"))
    one = develop(path)
    assert one.rgb.shape == (512, 768, 3) and 60 < one.rgb.mean() < 160 and one.clipped < 0.01
    red = develop(path, recipe_for([path], (2.0, 1.0, 1.0, 1.0))).linear.mean(axis=(0, 1))
    as_is = one.linear.mean(axis=(0, 1))
    assert (red[0] / red[1]) / (
        as_is[0] / as_is[1]
    ) > 1.5  # the balance that is given is the one that is used


def test_not_raw(tmp_path):
    path = tmp_path / "a.dng"
    path.write_text("hello")
    with refused("file-not-raw", "a.dng", kind=InputError):
        develop(path)
    with refused("file-missing", "b.dng", kind=InputError):
        develop(tmp_path / "b.dng")


def test_damaged(tmp_path):
    path = shot(tmp_path / "a.dng")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with refused("file-damaged", "a.dng", kind=CaptureError):
        develop(path)
    shot(tmp_path / "b.dng")
    with refused("file-damaged", "a.dng", kind=CaptureError):
        develop_set([(0, tmp_path / "b.dng"), (1, path)], tmp_path / "out", "static")
    other = recipe_for([tmp_path / "b.dng"])
    high = (20000, 20000, 20000, 20000)
    write_dng(path, mosaic(light(), "RGGB", high, 65535), DngTags(black=high))
    with refused("raw-levels-differ", "20000", "16383", kind=CaptureError):
        develop(path, other)
