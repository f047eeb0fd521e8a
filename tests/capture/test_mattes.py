"""Mattes against exact ones: a model passes before a screen (chroma); given."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.mattes.chroma import find_key, is_screen_hue, parse_colour
from devrf.capture.mattes.given import cameras_with_mattes, find_mattes, is_inverted, read_given
from devrf.capture.mattes.make import MatteClip, chroma_mattes, given_mattes
from devrf.capture.mattes.matched_files import files_of
from devrf.capture.mattes.matte_facts import measure
from devrf.capture.mattes.tidy import tidy
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.system.errors import CaptureError, HealthError, InputError

SIZE = (200, 150)
Passing = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def passing() -> Passing:
    """Pictures of a robot that passes, noisy, and its exact mattes."""
    pytest.importorskip("mitsuba")
    from tests.capture.passing import simulate_passing

    return simulate_passing("robot", 11, SIZE, seed=5, spp=8)


def clip_of(pictures: np.ndarray, folder: Path, camera: str = "cam0") -> MatteClip:
    """The pictures as a camera's compressed frames on disk."""
    files = []
    for n, picture in enumerate(pictures):
        files.append(folder / f"{n:06d}.jpg")
        cv2.imwrite(str(files[-1]), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    size = (pictures.shape[2], pictures.shape[1])
    return MatteClip(camera, tuple(files), {n: None for n in range(len(files))}, (size,) * len(files))


def shown(files: tuple[Path, ...]) -> np.ndarray:
    return np.stack([read_pixels(file)[..., 0] > 127 for file in files])


def overlap(ours: np.ndarray, true: np.ndarray) -> float:
    """Mean intersection over union."""
    return float(np.mean([(a & b).sum() / (a | b).sum() for a, b in zip(ours, true, strict=True)]))


def least_overlap(true: np.ndarray, pixels: int) -> float:
    """What is left of the truth where an edge that is off by some pixels all around has cost its part."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    inner = [cv2.erode(t.astype(np.uint8), disc, borderType=cv2.BORDER_REPLICATE) for t in true]
    return float(np.mean([i.sum() / t.sum() for i, t in zip(inner, true, strict=True)]))


@pytest.mark.parametrize("screen", [(30, 160, 70), (20, 60, 190)])
def test_a_screen_is_found_and_taken_away(passing: Passing, tmp_path: Path, screen: tuple[int, ...]) -> None:
    """Unevenly lit. One pixel of the edge is lost to compressed colour; the robot's parts of the screen's own colour,
    which no key can tell, are left out of the comparison."""
    pictures, mattes = passing
    light = 0.6 + 0.4 * np.sin(np.linspace(0, 3, SIZE[0]))[:, None]
    alpha = mattes[..., None]
    before = alpha * pictures + (1 - alpha) * np.array(screen) * light
    clip = clip_of(before.astype(np.uint8), tmp_path)
    key = find_key("cam0", clip.files)
    cosine = key @ screen / np.linalg.norm(key) / np.linalg.norm(screen)
    assert cosine > 0.99
    made = chroma_mattes(clip, None, tmp_path / "out")
    true, ours = mattes > 0.5, shown(made.files)
    rgb = pictures.astype(np.float32)
    strongest = np.argmax(screen)
    others = [n for n in range(3) if n != strongest]
    # green parts before green, blue before blue
    alike = rgb[..., strongest] > 1.15 * rgb[..., others].max(-1)
    assert overlap(ours & ~alike, true & ~alike) > least_overlap(true, 1)
    named = chroma_mattes(clip, parse_colour("#{:02x}{:02x}{:02x}".format(*screen)), tmp_path / "named")
    assert overlap(shown(named.files), ours) > 0.95
    soft = read_pixels(made.files[6])[..., 0]
    assert ((soft > 20) & (soft < 235)).sum() > 20  # edges are no steps


def test_no_screen_is_named(passing: Passing, tmp_path: Path) -> None:
    grey = passing[0].mean(axis=-1, keepdims=True).repeat(3, axis=-1).astype(np.uint8)
    clip = clip_of(grey[:3], tmp_path)
    with refused("key-colour-unfound", "'cam0'", "15 %", "colour: ", kind=HealthError):
        find_key("cam0", clip.files)
    named = chroma_mattes(clip, parse_colour("#00b140"), tmp_path / "out")  # what is proposed
    assert named.key_rgb == (0, 177, 64) and not named.doubtful_key


@pytest.mark.parametrize(
    ("colour", "screen"),
    [
        ("#00b140", True),  # chroma key green
        ("#0047bb", True),  # chroma key blue
        ("#c06020", False),  # an orange cloth
        ("#e0ac69", False),  # skin
        ("#b01030", False),  # red
        ("#8020a0", False),  # purple
    ],
)
def test_green_and_blue_are_screens(colour: str, screen: bool) -> None:
    assert is_screen_hue(parse_colour(colour)) == screen


def test_a_grey_screen_is_refused() -> None:
    with refused("key-colour-grey", "#808a80", "chroma 5 of 255", "at least 18", kind=InputError):
        parse_colour("#808a80")


# --- given ---


def blob(size: tuple[int, int] = (64, 48)) -> np.ndarray:
    matte = np.zeros(size[::-1], np.uint8)
    cv2.circle(matte, (size[0] // 2, size[1] // 2), size[1] // 4, 255, -1)
    return matte


@pytest.mark.parametrize(
    "called", ["12.png", "000012.png", "frame_012.png", "IMG_7.png", "img_7.jpg.png", "IMG_7.JPG"]
)
def test_names_of_given_mattes(tmp_path: Path, called: str) -> None:
    write_png(tmp_path / "x.png", blob())
    (tmp_path / "cam0").mkdir()
    (tmp_path / "x.png").rename(tmp_path / "cam0" / called)
    film, photo = {12: None}, {3: "IMG_7.jpg"}
    assert find_mattes(tmp_path / "cam0", film if "12" in called else photo).files.popitem()[1].name == called


def test_mattes_numbered_from_1_where_the_first_frames_are_not_used(tmp_path: Path) -> None:
    """As of a clip that begins with black pictures: each would have the matte of the frame before."""
    for n in range(1, 7):
        write_png(tmp_path / f"{n:04d}.png", blob())
    with refused("mattes-misnumbered", str(tmp_path), kind=CaptureError):
        find_mattes(tmp_path, dict.fromkeys(range(2, 6)))
    made_for_them = find_mattes(tmp_path, dict.fromkeys(range(1, 7)))
    assert {n: f.stem for n, f in made_for_them.files.items()} == {n: f"{n:04d}" for n in range(1, 7)}
    known = find_mattes(tmp_path, dict.fromkeys(range(2, 6)), 6)  # as many as there are frames
    assert known.from_1 and {n: f.stem for n, f in known.files.items()} == {
        n: f"{n + 1:04d}" for n in range(2, 6)
    }
    write_png(tmp_path / "0000.png", blob())
    assert find_mattes(tmp_path, dict.fromkeys(range(2, 6))).files[2].stem == "0002"


@pytest.mark.parametrize(
    ("photos", "files", "found"),
    [
        (("000.jpg", "001.jpg", "002.jpg"), ("000.png", "001.png", "002.png"), (0, 1, 2)),
        (("000.jpg", "001.jpg", "002.jpg"), ("001.png", "002.png", "003.png"), None),
        (("001.jpg", "002.jpg", "003.jpg"), ("000.png", "001.png", "002.png"), None),
        (("IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"), ("IMG_2.jpg.png", "IMG_3.jpg.png"), (None, 0, 1)),
        (("IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"), ("1.png", "2.png", "3.png"), (0, 1, 2)),
        (("IMG_7.jpg", "IMG_8.jpg", "IMG_9.jpg"), ("m_1.png", "m_2.png", "m_3.png"), (0, 1, 2)),
        (("IMG_7.jpg", "IMG_8.jpg", "IMG_9.jpg"), ("0.png", "1.png", "2.png"), (0, 1, 2)),
        (("IMG_7.jpg", "IMG_8.jpg", "IMG_9.jpg"), ("8.png",), (None, 0, None)),
        ((None, None, None), ("001.png", "002.png", "003.png"), (0, 1, 2)),
        ((None, None, None), ("000.png", "002.png"), (0, None, 1)),
    ],
)
def test_whose_a_file_is(
    tmp_path: Path,
    photos: tuple[str | None, ...],
    files: tuple[str, ...],
    found: tuple[int | None, ...] | None,
) -> None:
    """Three pictures, and for each the place of its file among those that are there."""
    paths, pictures = [tmp_path / name for name in files], dict(enumerate(photos))
    if found is None:
        with refused("mattes-misnumbered", "its 3 files", "3 photos", "rename", kind=CaptureError):
            files_of(paths, pictures, 3)
    else:
        expected = {n: paths[k] for n, k in enumerate(found) if k is not None}
        assert files_of(paths, pictures, 3).files == expected


def test_missing_mattes_are_named(tmp_path: Path) -> None:
    for n in range(1, 4):
        write_png(tmp_path / f"{n:04d}.png", blob())
    with refused("mattes-misnumbered", "2 of the camera's 3", "000000.png, 000007.png", kind=CaptureError):
        find_mattes(tmp_path, {0: None, 2: None, 7: None})
    with refused("matte-missing", "000009.png", kind=CaptureError):
        find_mattes(tmp_path, {9: None})


def test_which_cameras_have_mattes(tmp_path: Path) -> None:
    (tmp_path / "cam0").mkdir()
    (tmp_path / "Cam1").mkdir()
    assert cameras_with_mattes(tmp_path, ("cam0", "cam1"), sweep=True) == ("cam0",)
    (tmp_path / "static").mkdir()
    with refused("matte-missing", "cam1", "Cam1", kind=InputError):
        cameras_with_mattes(tmp_path, ("cam0", "cam1"), sweep=True)
    with refused("folder-missing", "left or right", "Cam1, cam0, static", kind=InputError):
        cameras_with_mattes(tmp_path, ("left", "right"), sweep=False)


def test_size_shape_and_kind_of_given_mattes(tmp_path: Path) -> None:
    matte = blob()
    write_png(tmp_path / "soft.png", cv2.GaussianBlur(matte, (0, 0), 2))
    cut_out = np.dstack([np.full((48, 64, 3), 90, np.uint8), matte])
    write_png(tmp_path / "cut.png", cut_out)
    write_png(tmp_path / "half.png", cv2.resize(matte, (32, 24), interpolation=cv2.INTER_AREA))
    write_png(tmp_path / "cropped.png", matte[:, :50])
    np.testing.assert_array_equal(read_given(tmp_path / "cut.png", 64, 48, False), matte)
    assert len(np.unique(read_given(tmp_path / "soft.png", 64, 48, False))) > 10
    half = read_given(tmp_path / "half.png", 64, 48, False)
    assert overlap((half > 127)[None], (matte > 127)[None]) > least_overlap((matte > 127)[None], 1)
    with refused("matte-size-wrong", "cropped.png", "50x48", "64x48", kind=CaptureError):
        read_given(tmp_path / "cropped.png", 64, 48, False)


def test_black_subjects_are_noticed(tmp_path: Path) -> None:
    for n in range(3):
        write_png(tmp_path / f"{n}.png", 255 - blob())
    files = [tmp_path / f"{n}.png" for n in range(3)]
    assert is_inverted(files)
    write_png(tmp_path / "full.png", np.full((48, 64), 255, np.uint8))
    write_png(tmp_path / "good.png", blob())
    assert not is_inverted([tmp_path / "good.png"]) and not is_inverted([tmp_path / "full.png"])
    pictures = np.full((3, 48, 64, 3), 90, np.uint8)
    (tmp_path / "in").mkdir()
    clip = clip_of(pictures, tmp_path / "in")
    found = given_mattes(clip, tmp_path, None, tmp_path / "a")
    assert found.inverted and shown(found.files).mean() < 0.5
    told = given_mattes(clip, tmp_path, True, tmp_path / "b")
    assert not told.inverted and (shown(told.files) == shown(found.files)).all()
    kept = given_mattes(clip, tmp_path, False, tmp_path / "c")
    assert not kept.inverted and shown(kept.files).mean() > 0.5


# --- what a matte says about itself ---


def test_specks_and_pinholes_go_gaps_stay() -> None:
    mask = np.zeros((100, 100), bool)
    mask[20:80, 20:80] = True
    mask[40:42, 40:42] = False  # 0.1 % of the subject
    mask[50:70, 50:60] = False  # 6 %: a gap that is seen through
    mask[5:8, 5:8] = True  # 0.3 % of it
    clean = tidy(mask)
    assert clean[41, 41] and not clean[60, 55] and not clean[6, 6] and clean[20:40, 20:80].all()


def test_how_much_of_a_picture_a_matte_shows_and_where() -> None:
    matte = np.zeros((120, 160), np.uint8)
    matte[30:90, 50:110] = 255
    found = measure(matte, (40, 30))
    assert found.area == pytest.approx(3600 / 19200) and found.small.shape == (30, 40)
    assert found.small[8:22, 13:27].all() and found.small.sum() < 17 * 17
