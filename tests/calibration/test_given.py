"""A calibration people own, fitted to a capture: names, picture sizes, unit of length; what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.judged import fired, judged
from tests.make.rigs import RIG_LAYOUTS
from tests.refused import refused

from devrf.calibration.rigs.given import Given, read_given
from devrf.calibration.rigs.rig import Rig, RigCamera, Scale, write_rig
from devrf.capture.camera import Camera
from devrf.capture.formats.colmap.colmap_model import Model, read_model, write_model
from devrf.capture.orientation import by_exif
from devrf.capture.system.errors import InputError
from devrf.capture.video.reader import VideoInfo
from devrf.pipelines.health.judge import judge

SIZE = (640, 480)
NAMES = ("cam0", "cam1", "cam2")


def cameras(names: tuple[str, ...] = NAMES, apart: float = 1.0) -> dict[str, Camera]:
    """Cameras side by side, each with a focal length of its own."""
    out = {}
    for n, name in enumerate(names):
        K = np.array([[500.0 + n, 0, 320], [0, 500 + n, 240], [0, 0, 1]])
        out[name] = Camera(*SIZE, K, np.column_stack([np.eye(3), [-apart * n, 0.0, 0.0]]), np.zeros(5))
    return out


def own_rig(path: Path, metric: bool = True, **changes: Camera) -> Path:
    """A rig.json with doubts."""
    rig = {n: RigCamera(c, "board", 0.01, 0.002, 120, 0.4) for n, c in {**cameras(), **changes}.items()}
    write_rig(path, Rig(rig, Scale(metric, "tape" if metric else "arbitrary scale", 0.3, 0.004)))
    return path


def read(path: Path, names: tuple[str, ...] = NAMES, size: tuple[int, int] = SIZE, **options: Any) -> Given:
    return read_given(path, list(names), dict.fromkeys(names, size), **options)


def rig_of(given: Given) -> Rig:
    assert given.rig is not None
    return given.rig


def test_our_own_rig_keeps_its_doubts(tmp_path: Path) -> None:
    own_rig(tmp_path / "rig.json")
    found = rig_of(read(tmp_path / "rig.json"))
    np.testing.assert_array_equal(found.cameras["cam2"].camera.K, cameras()["cam2"].K)
    assert found.cameras["cam1"].position_std == 0.002 and found.cameras["cam1"].inliers == 120
    assert found.scale == Scale(True, "tape", 1.0, 0.004) and found.route == "given"


@pytest.mark.parametrize(
    ("theirs", "ours", "focal", "word"),
    [
        (("cam0", "cam1", "cam2"), ("cam2", "cam0"), {"cam2": 502, "cam0": 500}, None),
        (("Cam_00", "Cam_02", "Cam_01"), ("c1", "c2"), {"c1": 502, "c2": 501}, "matched by number"),
        (
            ("int_cam01_img", "int_cam02_img"),
            ("cam02", "cam01"),
            {"cam01": 500, "cam02": 501},
            "matched by number",
        ),
        (
            ("00_00", "00_03", "00_10"),
            ("hd_00_03", "hd_00_00"),
            {"hd_00_03": 501, "hd_00_00": 500},
            "matched by the end of the name",
        ),
        (("cam0", "cam1"), ("left", "right"), {"left": 500, "right": 501}, "matched by order"),
        (("cam0", "cam1"), ("camA", "camB"), {"camA": 500, "camB": 501}, "matched by order"),
    ],
)
def test_names_are_matched(
    theirs: tuple[str, ...], ours: tuple[str, ...], focal: dict[str, float], word: str | None, tmp_path: Path
) -> None:
    RIG_LAYOUTS["pose2sim"](tmp_path, cameras(theirs), True)
    given = read(tmp_path / "Calib.toml", ours)
    assert {n: c.camera.K[0, 0] for n, c in rig_of(given).cameras.items()} == focal
    said = [row for row in judge(given.measures) if "matched" in str(row.value)]
    assert [str(row.value).split(":")[0] for row in said] == ([word] if word else [])
    assert all(bool(row.remedy) == (word == "matched by order") for row in said)  # a guess is to be looked at


@pytest.mark.parametrize(
    ("has", "wanted", "named"),
    [
        (("a", "b", "c"), ("cam0", "cam1"), ("no camera cam0, cam1;", "a, b, c", "has cam0, cam1")),
        (("cam0", "cam1"), ("cam1", "cam2"), ("no camera cam2;", "it has cam0, cam1")),  # none is renamed
    ],
)
def test_names_that_do_not_match_are_listed(tmp_path: Path, has: tuple, wanted: tuple, named: tuple) -> None:
    RIG_LAYOUTS["pose2sim"](tmp_path, cameras(has), True)
    with refused("camera-missing", *named, kind=InputError):
        read(tmp_path / "Calib.toml", wanted)


def test_a_smaller_clip_scales_the_calibration(tmp_path: Path) -> None:
    """Half the size: the same rays through half the pixels, corners of the picture and not centres of pixels fixed."""
    own_rig(tmp_path / "rig.json")
    given = read(tmp_path / "rig.json", size=(320, 240))
    whole, half = cameras()["cam1"], rig_of(given).cameras["cam1"].camera
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    np.testing.assert_allclose(half.project(points), whole.project(points) / 2, rtol=0, atol=1e-12)
    scaled = judged(given.measures)["noted cam1"]
    assert all(word in str(scaled.value) for word in ("640x480", "0.5", "320x240"))


def test_a_cropped_clip_is_refused(tmp_path: Path) -> None:
    own_rig(tmp_path / "rig.json")
    with refused("picture-size-wrong", "'cam0'", "640x480", "632x480", kind=InputError):
        read(tmp_path / "rig.json", size=(632, 480))


def without_size(folder: Path, apart: float = 1.0) -> Path:
    """EasyMocap's files as its older versions wrote them."""
    RIG_LAYOUTS["easymocap"](folder, cameras(apart=apart), True)
    lines = (folder / "intri.yml").read_text().splitlines()
    (folder / "intri.yml").write_text("\n".join(line for line in lines if not line.startswith(("H_", "W_"))))
    return folder / "intri.yml"


def test_a_file_without_size_is_taken_at_the_clips_if_that_can_be(tmp_path: Path) -> None:
    given = read(without_size(tmp_path))
    assert "640x480" in str(judged(given.measures)["noted cam1"].value)
    with refused("principal-point-outside", "320, 240", "320x240", kind=InputError):
        read(tmp_path / "intri.yml", size=(320, 240))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("factor", factor) for factor in (0, -1, float("nan"), float("inf"))),
        ("K", [[1e308, 0, 320], [0, 500, 240], [0, 0, 1]]),
        ("K", [[500, 0, 320], [0, 1e-308, 240], [0, 0, 1]]),
        ("K", [[500, 0, 1e308], [0, 500, 240], [0, 0, 1]]),
        ("distortion", [1e300, 0, 0, 0, 0]),
        ("cam_from_world", [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 2]]),
    ],
)
def test_what_no_camera_or_scale_has_is_refused(tmp_path: Path, key: str, value: object) -> None:
    own_rig(tmp_path / "rig.json")
    content = json.loads((tmp_path / "rig.json").read_text())
    (content["scale"] if key == "factor" else content["cameras"]["cam1"])[key] = value
    (tmp_path / "rig.json").write_text(json.dumps(content))
    said = (
        ("file-damaged", "scale.factor") if key == "factor" else ("camera-implausible", "rig.json", "'cam1'")
    )
    with refused(*said, kind=InputError):
        read(tmp_path / "rig.json")


def test_a_lens_of_a_rig_under_another_name_is_asked_for(tmp_path: Path) -> None:
    own_rig(tmp_path / "rig.json")
    content = json.loads((tmp_path / "rig.json").read_text())
    content["cameras"]["cam1"]["dist_coeffs"] = content["cameras"]["cam1"].pop("distortion")
    (tmp_path / "rig.json").write_text(json.dumps(content))
    with refused("file-damaged", "rig.json", "'cam1'", "dist_coeffs", kind=InputError):
        read(tmp_path / "rig.json")


def test_either_file_of_a_pair_names_both(tmp_path: Path) -> None:
    RIG_LAYOUTS["easymocap"](tmp_path, cameras(), True)
    for name in ("intri.yml", "extri.yml"):
        assert rig_of(read(tmp_path / name)).cameras["cam2"].camera.K[0, 0] == 502
    (tmp_path / "intri.yml").write_bytes(b"\xff\xfe\x00")
    with refused("encoding-wrong", "intri.yml", kind=InputError):
        read(tmp_path / "extri.yml")
    (tmp_path / "intri.yml").write_text("%YAML:1.0\n---\nK_cam0: 1\n")
    with refused("entry-wrong", "intri.yml", "names is None", kind=InputError):
        read(tmp_path / "extri.yml")
    (tmp_path / "intri.yml").unlink()
    with refused("file-missing", "intri.yml", kind=InputError):
        read(tmp_path / "extri.yml")


def test_without_poses_it_gives_intrinsics(tmp_path: Path) -> None:
    RIG_LAYOUTS["easymocap"](tmp_path, cameras(), True)
    (tmp_path / "extri.yml").unlink()
    given = read(tmp_path)
    assert given.rig is None and given.intrinsics["cam1"].K[0, 0] == 501


def one_file(path: Path, camera: Camera) -> Path:
    """OpenCV's file of one camera."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", camera.width)
    file.write("image_height", camera.height)
    file.write("camera_matrix", camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    file.write("distortion_coefficients", camera.distortion[None])
    file.release()
    return path


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_a_file_a_camera_in_a_folder_or_by_name(ending: str, tmp_path: Path) -> None:
    files = {n: one_file(tmp_path / f"{n}.{ending}", c) for n, c in cameras().items()}
    (tmp_path / "notes.xml").write_text("<?xml version='1.0'?><opencv_storage><a>1</a></opencv_storage>")
    for source in (tmp_path, files):
        given = read_given(source, list(NAMES), dict.fromkeys(NAMES, SIZE))
        assert given.rig is None
        assert {n: k.K[0, 2] for n, k in given.intrinsics.items()} == dict.fromkeys(NAMES, 320.0)
    with refused("entry-missing", "notes.xml", "camera_matrix", "'cam0'", kind=InputError):
        read_given({"cam0": tmp_path / "notes.xml"}, ["cam0"], {"cam0": SIZE})


@pytest.mark.parametrize(
    ("apart", "options", "metres", "guessed"),
    [
        (1.0, {}, 1.0, True),  # one unit apart can be metres, ...
        (700.0, {}, 0.7, True),  # ... 700 are millimetres
        (700.0, {"unit": "mm"}, 0.7, False),
        (70.0, {"unit": "cm"}, 0.7, False),
        (3.3, {"known_distance_m": 0.0832}, 0.0832, False),  # in squares of the board
    ],
)
def test_a_unit_that_the_format_leaves_open(
    apart: float, options: dict[str, Any], metres: float, guessed: bool, tmp_path: Path
) -> None:
    RIG_LAYOUTS["anipose"](tmp_path, cameras(apart=apart), True)
    given = read(tmp_path / "calibration.toml", **options)
    rig = rig_of(given)
    assert rig.scale.metric and rig.scale.factor == 1.0
    assert rig.cameras["cam1"].camera.centre == pytest.approx([metres, 0, 0])
    assert list(fired(given.measures)) == (["given-assumed unit"] if guessed else [])


@pytest.mark.parametrize("name", ["pose2sim", "kalibr", "easymocap", "rig-caliscope"])
def test_a_unit_that_the_format_says_is_not_guessed(name: str, tmp_path: Path) -> None:
    """Beyond what rigs measure it is doubted: the board may have been described in millimetres."""
    for apart, doubted in ((20.0, False), (1000.0, True)):
        RIG_LAYOUTS[name](tmp_path, cameras(apart=apart), True)
        source = tmp_path if name == "easymocap" else next(tmp_path.iterdir())
        given = read(source)
        centres = [c.camera.centre for c in rig_of(given).cameras.values()]
        assert np.linalg.norm(centres[1] - centres[0]) == pytest.approx(apart)
        units = fired(given.measures).values()
        assert [("given_unit" in row.remedy, "m" in str(row.value).split()[0]) for row in units] == [
            (True, True)
        ] * doubted
        assert fired(read(source, unit="m").measures) == {}


@pytest.mark.parametrize(("apart", "metres"), [(2828.0, 2.828), (2.828, 2.828)])
def test_where_all_lenses_are_fisheyes_aniposelib_may_have_written_it(
    apart: float, metres: float, tmp_path: Path
) -> None:
    wide = {name: replace(c, model="OPENCV_FISHEYE") for name, c in cameras(apart=apart).items()}
    RIG_LAYOUTS["anipose"](tmp_path, wide, True)
    given = read(tmp_path / "calibration.toml")
    assert given.format == "aniposelib"
    assert rig_of(given).cameras["cam1"].camera.centre[0] == pytest.approx(metres)
    assert "given_unit" in fired(given.measures)["given-assumed unit"].remedy


def test_an_arbitrary_scale_stays_so_or_is_measured(tmp_path: Path) -> None:
    RIG_LAYOUTS["rig-colmap"](tmp_path, cameras(), False)
    assert not rig_of(read(tmp_path)).scale.metric
    measured = rig_of(read(tmp_path, known_distance_m=0.25))
    assert measured.scale.metric and measured.cameras["cam2"].camera.centre[0] == pytest.approx(0.5)
    path = own_rig(tmp_path / "rig.json", metric=False)
    measured = rig_of(read(path, known_distance_m=0.25)).cameras["cam1"]
    assert measured.camera.centre[0] == 0.25 and measured.position_std is None  # its doubts had another unit


def test_cameras_on_top_of_each_other_are_refused(tmp_path: Path) -> None:
    other = replace(cameras()["cam1"], cam_from_world=cameras()["cam0"].cam_from_world)
    own_rig(tmp_path / "rig.json", cam1=other)
    with refused("poses-equal", "'cam0'", "'cam1'", kind=InputError):
        read(tmp_path / "rig.json")


def test_pictures_of_a_camera_that_moved_are_refused(tmp_path: Path) -> None:
    """Two images in one camera's folder: a fixed camera has one pose."""
    RIG_LAYOUTS["rig-colmap"](tmp_path, cameras(("0", "1", "2")), False)
    folder = tmp_path / "sparse" / "0"
    model = read_model(folder)
    names = {1: "a/000.png", 2: "a/001.png", 3: "b.png"}
    images = {n: replace(image, name=names[n]) for n, image in model.images.items()}
    write_model(folder, Model(model.cameras, images, {}))
    with refused("camera-not-fixed", "2 images of 'a'", kind=InputError):
        read(tmp_path, ("a", "b"))
    images[2] = replace(images[1], name=names[2])
    write_model(folder, Model(model.cameras, images, {}))
    assert set(rig_of(read(tmp_path, ("a", "b"))).cameras) == {"a", "b"}


@pytest.mark.parametrize(("name", "text"), [("rig.json", "nonsense"), ("rig.json", "{}"), ("rig", " {}")])
def test_a_damaged_rig_is_named(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with refused("file-damaged", "rig.json", kind=InputError):
        read(tmp_path / name)


def clips(path: Path, orientation: int = 1, pixel_aspect: float = 1.0) -> dict[str, VideoInfo]:
    """What clips say that were turned so."""
    upright = by_exif(orientation)
    info = VideoInfo(path, *upright.size(*SIZE), "h264", 1.0, 30, 30.0, False, upright, (), 8, pixel_aspect)
    return dict.fromkeys(NAMES, info)


@pytest.mark.parametrize("orientation", [6, 8])
def test_a_calibration_of_stored_pictures_is_turned_as_the_clips_are(
    tmp_path: Path, orientation: int
) -> None:
    """Lens and pose: what the camera sees, it sees where the turned pictures show it."""
    RIG_LAYOUTS["pose2sim"](tmp_path, cameras(), True)
    upright, place = by_exif(orientation), np.array([[0.3, 0.2, 2.0]])
    given = read(tmp_path / "Calib.toml", size=(SIZE[1], SIZE[0]), clips=clips(tmp_path, orientation))
    for name, c in rig_of(given).cameras.items():
        seen = upright.points(cameras()[name].project(place), *SIZE)
        np.testing.assert_allclose(c.camera.project(place), seen, atol=1e-6)
        assert given.intrinsics[name].width == SIZE[1]
    assert fired(given.measures).keys() <= {"given-assumed unit"}


def test_where_a_turn_leaves_the_size_it_is_asked_which_pictures_were_calibrated(tmp_path: Path) -> None:
    own_rig(tmp_path / "rig.json")
    row = fired(read(tmp_path / "rig.json", clips=clips(tmp_path, 3)).measures)["given-assumed cam0"]
    assert "180" in str(row.value) and "ffmpeg -display_rotation 0" in row.remedy
    assert not fired(read(tmp_path / "rig.json", clips=clips(tmp_path)).measures)  # the command takes it out


def test_a_calibration_with_square_pixels_of_clips_with_others(tmp_path: Path) -> None:
    """Made at 640x480 of a clip of 480x480 whose pixels are 4:3."""
    own_rig(tmp_path / "rig.json")
    given = read(tmp_path / "rig.json", size=(480, 480), clips=clips(tmp_path, 1, 4 / 3))
    K = given.intrinsics["cam0"].K
    assert (K[0, 0], K[1, 1], K[0, 2]) == pytest.approx((375, 500, 240))
    with refused("picture-size-wrong", "480x480", kind=InputError):
        read(tmp_path / "rig.json", size=(480, 480))


def test_a_calibration_of_turned_pictures_of_which_nobody_says_how(tmp_path: Path) -> None:
    own_rig(tmp_path / "rig.json")
    with refused("picture-size-wrong", "480x640", "turned", kind=InputError):
        read(tmp_path / "rig.json", size=(SIZE[1], SIZE[0]))
