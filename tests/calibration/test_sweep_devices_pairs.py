"""Which pictures share a camera, which pairs are matched, masks on disk."""

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from tests.refused import refused

from devrf.calibration.intrinsics import from_vector, guess
from devrf.calibration.sweep.devices import device_groups
from devrf.calibration.sweep.gps import USUAL_STD_M, local_metres, why_not
from devrf.calibration.sweep.masks import prepare_masks
from devrf.calibration.sweep.pairs import EXHAUSTIVE_UP_TO, plan_pairs
from devrf.calibration.sweep.sfm_budget import CHUNK, Deadline, Matching
from devrf.calibration.sweep.static_poses import SweepOptions
from devrf.capture.exif import Exif, Place
from devrf.capture.frames import FrameSet
from devrf.capture.orientation import Upright
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.photos.upright_pictures import probe_picture
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stages.preflight import check_raw_files
from devrf.pipelines.stages.static_poses import Swept, recover_sweep


def test_groups_by_size_share_a_camera():
    known = from_vector(320, 240, np.array([300.0, 300, 160, 120, 0, 0, 0, 0, 0]))
    sizes = {"a": (320, 240), "b": (240, 320), "c": (320, 240)}
    tall, wide = device_groups(sizes, {}, known)
    assert wide.names == ("a", "c") and wide.source == "board" and wide.fixed and wide.intrinsics is known
    assert tall.names == ("b",) and tall.source == "guess"
    turned = device_groups(sizes, {}, known, turns={"b": Upright(1), "c": Upright(2)})
    assert [(g.names, g.source, g.intrinsics.width) for g in turned if g.source == "board"] == [
        (("a",), "board", 320)
    ]
    (tall,) = device_groups({"b": (240, 320)}, {}, known, turns={"b": Upright(1)})
    assert tall.source == "board" and tall.intrinsics.vector[:4].tolist() == [300, 300, 120, 160]
    by_exif = device_groups({"a": (320, 240)}, {"a": Exif("", 280.0)}, None)[0]
    assert by_exif.source == "EXIF" and not by_exif.fixed and by_exif.intrinsics.K[0, 0] == 280.0
    assert guess(320, 240).K[0, 0] == pytest.approx(384.0)


def test_each_zoom_and_each_device_has_a_camera():
    exif = {
        "a": Exif("phone", 300.0),
        "b": Exif("phone", 303.0),  # 1 %: rounding of the tag
        "c": Exif("phone", 600.0),
        "d": Exif("camera", 300.0),
        "e": Exif("phone", None),
    }
    groups = device_groups(dict.fromkeys(exif, (320, 240)), exif, None)
    assert sorted(group.names for group in groups) == [("a", "b"), ("c",), ("d",), ("e",)]
    by_name = {group.names[0]: group for group in groups}
    assert by_name["a"].intrinsics.K[0, 0] == pytest.approx(301.5)
    assert by_name["c"].intrinsics.K[0, 0] == 600.0 and "phone 320x240 at 600 px" in by_name["c"].label
    assert by_name["e"].source == "guess"


def test_pairs_of_small_and_long_films():
    names = [f"{n:03d}" for n in range(10)]
    small = plan_pairs(names, ordered=True)
    assert small.wanted == len(small.pairs) == 45
    names = [f"{n:03d}" for n in range(EXHAUSTIVE_UP_TO + 130)]
    plan, all_ = plan_pairs(names, ordered=True), len(names) * (len(names) - 1) // 2
    wanted = plan.pairs[: plan.wanted]
    assert len(set(plan.pairs)) == all_ and plan.wanted < all_ / 2
    assert (names[0], names[1]) in wanted and (names[0], names[-1]) in wanted  # neighbours, and the loop
    assert all(a < b for a, b in plan.pairs)
    assert plan_pairs(names, ordered=False).wanted == all_


def test_what_is_cut_for_time_is_far_away():
    names = [f"{n:03d}" for n in range(40)]
    plan = plan_pairs(names, ordered=False)
    steps = [int(b) - int(a) for a, b in plan.pairs[:200]]
    assert {1, 2, 3, 4} <= set(steps) and steps.count(1) == 39  # neighbours first, and all of them


def test_places_decide_which_pairs_come_first():
    names = [f"{n:03d}" for n in range(60)]
    places = np.zeros((60, 3))
    places[:, 0] = np.r_[np.arange(30), np.arange(30)[::-1]]  # there and back on the same path, metres
    first = plan_pairs(names, ordered=False, places=places).pairs[:500]
    assert (names[2], names[57]) in first  # 55 pictures apart, at the same place
    assert (names[2], names[28]) not in first  # 26 metres apart


def masked(tmp_path, name, mask):
    """Two pictures, one mask; what `prepare_masks` makes of it."""
    folder = tmp_path / "masks"
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / name), mask)
    pictures = {"static/000000.jpg": "IMG_1.jpg", "static/000001.jpg": "IMG_2.jpg"}
    return prepare_masks(folder, pictures, dict.fromkeys(pictures, (200, 100)), tmp_path / "out")[0]


def half(width: int = 200) -> np.ndarray:
    mask = np.full((100, width), 255, dtype=np.uint8)
    mask[:, : width // 2] = 0
    return mask


@pytest.mark.parametrize("name", ["IMG_1.jpg.png", "IMG_1.png", "000000.png", "0.png"])
def test_masks_by_any_of_a_pictures_names(tmp_path, name):
    assert masked(tmp_path, name, half()) == ["static/000001.jpg"]
    written = cv2.imread(str(tmp_path / "out" / "static" / "000000.jpg.png"), cv2.IMREAD_GRAYSCALE)
    assert written is not None and set(np.unique(written)) == {0, 255}
    assert not written[:, :102].any() and written[:, 103:].all()  # grown by 1 % of 200 pixels


@pytest.mark.parametrize(
    ("numbers", "masked"), [(range(1, 5), [0, 2]), (range(4), [1, 3]), (range(1, 4), [1, 3])]
)
def test_masks_of_a_film_may_be_numbered_from_1(tmp_path, numbers, masked):
    """Only where they are as many as its frames: then every mask is that of the frame before its number."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for k in numbers:  # masks of odd numbers ignore half of the picture
        cv2.imwrite(str(folder / f"{k:04d}.png"), half() if k % 2 else np.full((100, 200), 255, np.uint8))
    pictures = {f"static/{n:06d}.jpg": f"{n:06d}.jpg" for n in range(4)}
    sizes = dict.fromkeys(pictures, (200, 100))
    without, from_1 = prepare_masks(folder, pictures, sizes, tmp_path / "out", count=4)
    assert from_1 == (max(numbers) == 4)
    given = [n for n, name in enumerate(pictures) if name not in without]
    black = [n for n in given if not read_pixels(tmp_path / f"out/static/{n:06d}.jpg.png").all()]
    assert black == masked


def test_bad_masks_are_named(tmp_path):
    with refused("mask-size-wrong", "IMG_1.png", "100x100", "IMG_1.jpg", "200x100", kind=InputError):
        masked(tmp_path, "IMG_1.png", half(100))
    with refused("mask-ignores-all", "IMG_1.png", kind=InputError):
        masked(tmp_path, "IMG_1.png", np.zeros((100, 200), dtype=np.uint8))
    (tmp_path / "masks" / "IMG_1.png").unlink()
    with refused("mask-missing", "2 pictures", "IMG_1.jpg.png", kind=InputError):
        masked(tmp_path, "other.png", half())
    with refused("folder-missing", "calibration.static_poses.masks", kind=InputError):
        prepare_masks(tmp_path / "nowhere", {}, {}, tmp_path)


def test_exif_of_a_photo_with_gps(tmp_path):
    tags = Image.Exif()
    tags[ExifTags.Base.Make], tags[ExifTags.Base.Model] = "Maker", "Phone 3"
    tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    settings = tags.get_ifd(ExifTags.IFD.Exif)
    settings[ExifTags.Base.ExposureTime], settings[ExifTags.Base.FNumber] = 1 / 64, 2.0
    settings[ExifTags.Base.ISOSpeedRatings] = 128
    gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "S", (33.0, 30.0, 36.0)
    gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (151.0, 12.0, 0.0)
    gps[ExifTags.GPS.GPSAltitudeRef], gps[ExifTags.GPS.GPSAltitude] = b"\x01", 12.5  # below the sea
    gps[ExifTags.GPS.GPSHPositioningError] = 3.5
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=tags)
    exif = probe_picture(tmp_path / "a.jpg").exif
    assert exif is not None and exif.device == "Maker Phone 3"
    assert exif.focal_px == pytest.approx(26 * 500 / 43.2666)  # by the diagonal
    assert exif.exposure_stops == pytest.approx(-1.0)  # log2(1/64 * 128 / 4)
    assert exif.place is not None
    found = (exif.place.latitude_deg, exif.place.longitude_deg, exif.place.altitude_m, exif.place.std_m)
    assert found == pytest.approx((-33.51, 151.2, -12.5, 3.5))
    (tmp_path / "out").mkdir()
    frames = extract_folder(tmp_path, tmp_path / "out", "static", "sweep", "in")
    FrameSet({"static": frames}).write(tmp_path / "out")
    assert FrameSet.read(tmp_path / "out").cameras["static"].frames[0].exif == frames.frames[0].exif


def test_a_place_without_a_fix_is_none(tmp_path):
    tags = Image.Exif()
    gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "N", (0.0, 0.0, 0.0)
    gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (0.0, 0.0, 0.0)
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=tags)
    assert probe_picture(tmp_path / "a.jpg").exif == Exif()


def test_local_metres_of_known_distances():
    """One minute of latitude at 47 N is 1852.9 m, of longitude 1267.2 m (WGS 84 tables)."""
    places = {
        "a": Place(47.0, 8.0, 400.0),
        "b": Place(47 + 1 / 60, 8.0, 410.0),
        "c": Place(47.0, 8 + 1 / 60),
        "d": None,
    }
    metres, std_m = local_metres(places)
    assert metres["b"] - metres["a"] == pytest.approx([0.0, 1852.9, 10.0], abs=0.5)
    assert (metres["c"] - metres["a"])[:2] == pytest.approx([1267.2, 0.0], abs=0.5)
    assert set(metres) == {"a", "b", "c"} and std_m["a"] == USUAL_STD_M
    assert all(w in str(why_not(metres, std_m, 4)) for w in ("3 of 4", "6"))


def test_the_whole_stage_reads_masks_by_the_photos_own_names(tmp_path):
    """Names of photos, not of the copies that ingest makes; a missing folder is found before anything starts."""
    config = SceneConfig.model_validate(
        {"name": "x", "capture": {"static": "in"}, "calibration": {"static_poses": {"masks": "masks"}}}
    )
    (tmp_path / "in").mkdir()
    for n in range(3):
        Image.new("RGB", (60, 40)).save(tmp_path / "in" / f"IMG_{n}.jpg")
    problems = check_raw_files(config, tmp_path)
    assert len(problems) == 1
    assert "calibration.static_poses.masks: masks: no folder with PNG files" in problems[0]
    (tmp_path / "masks").mkdir()
    Image.new("L", (30, 40)).save(tmp_path / "masks" / "IMG_1.jpg.png")
    assert check_raw_files(config, tmp_path) == []
    sweep = extract_folder(tmp_path / "in", tmp_path / "ingest", "static", "sweep", "in")
    (tmp_path / "out").mkdir()
    with refused("mask-size-wrong", "IMG_1.jpg.png", "30x40", "IMG_1.jpg is", "60x40", kind=InputError):
        swept = Swept(tmp_path / "ingest", sweep, masks=(tmp_path / "masks", tmp_path / "in"))
        recover_sweep(swept, tmp_path / "out", SweepOptions(config.calibration.static_poses.mapper))


class SlowDeadline(Deadline):
    """A deadline that matching moves: 10 ms a pair."""

    def __init__(self, budget_s: float) -> None:
        super().__init__(None)
        self.left = budget_s

    def left_s(self) -> float:
        return self.left


def test_matching_stops_in_time_and_goes_on_where_it_may():
    """B25: half of what is left goes to matching; the rest is counted, not matched."""
    names = [f"{n:03d}" for n in range(100)]
    plan = plan_pairs(names, ordered=True)
    done: list[tuple[str, str]] = []

    def run(budget_s: float) -> Matching:
        deadline = SlowDeadline(budget_s)
        done.clear()

        def match(pairs):
            deadline.left -= 0.01 * len(pairs)
            done.extend(pairs)

        matching = Matching(plan.pairs, plan.wanted, match, deadline)
        matching.begin()
        return matching

    plenty = run(1e6)
    assert plenty.matched == plan.wanted == len(done) and plenty.report()["first_skipped"] is None
    assert plenty.go_on() and done == plan.pairs  # a weak result gets the other pairs too
    short = run(0.05)  # the first pairs take more
    assert done == plan.pairs[:CHUNK] and not short.go_on()
    assert short.report()["first_skipped"] == list(plan.pairs[CHUNK])
