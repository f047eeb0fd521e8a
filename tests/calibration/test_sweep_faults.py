"""Each way a sweep goes wrong fires its own health row with its remedy; a healthy sweep fires none.

Numbers in brackets (B5, ...) are the failure cases of static poses. Faults that pictures show go through the whole
worker; faults of lens or motion are made by projecting the recovered points with a camera that has them.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests import judged
from tests.refused import refused

from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.sweep.checks import open_loop, picture_fits, two_zooms
from devrf.calibration.sweep.static_poses import SweepModel, SweepOptions
from devrf.calibration.sweep.two_views import TwoViews, against_model, torn_apart
from devrf.calibration.sweep.zoom_step import TwoLenses, zoom_step
from devrf.capture.camera import Camera
from devrf.capture.exif import Exif, Place
from devrf.capture.system.errors import HealthError
from devrf.capture.view_axes import look_at
from devrf.pipelines.health.judge import HealthRow
from devrf.pipelines.health.sweep_rows import LINKED, sweep_measures

FOCAL, SIZE = 300.0, (320, 240)  # what the corner is drawn with


def fired(model: SweepModel) -> dict[str, HealthRow]:
    return judged.fired(sweep_measures(model))


def changed(model: SweepModel, **report) -> SweepModel:
    return replace(model, report=model.report | report)


def rotation_about_y(deg: float) -> np.ndarray:
    a = np.radians(deg)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


# --- healthy ---


def test_a_healthy_sweep_fires_nothing(corner):
    assert fired(corner.model) == {}
    assert [attempt["name"] for attempt in corner.model.report["attempts"]] == ["incremental"]


# --- what pictures show ---


@pytest.mark.full
def test_turning_on_the_spot_is_named(draw, tmp_path):
    """B1, B5: all pairs fit a homography, nothing can be triangulated."""

    def turning(angle):
        aim = 0.2 * angle - 0.15
        return np.array([4.2, 4.2, -1.5]), np.array([0.5 + 5 * aim, 0.5 - 5 * aim, -1.5])

    with refused("sweep-without-parallax", " %", kind=HealthError):
        draw(tmp_path / "in", path=turning, views=5).recover(tmp_path / "out")


@pytest.mark.full
def test_a_flat_scene_is_named(draw, tmp_path):
    """B6: one wall."""

    def before(angle):
        return np.array([0.5 + 2 * angle, 3.0 + 0.5 * np.sin(4 * angle), -1.5]), np.array([1.5, 0.0, -1.5])

    rows = fired(draw(tmp_path / "in", path=before, walls=1).recover(tmp_path / "out"))
    assert "sweep-flat" in rows


@pytest.mark.full
def test_pictures_without_texture_are_named(draw, tmp_path):
    """B9: three pictures see a blank wall."""

    def blank(picture, n):
        return np.full_like(picture, 120) if n in (3, 4, 5) else picture

    rows = fired(draw(tmp_path / "in", draw=blank).recover(tmp_path / "out"))
    assert "static/000004.png" in rows["sweep-registered"].remedy  # 6 of 9, B2's row


def wanderer(picture: np.ndarray, n: int) -> np.ndarray:
    """A textured board that moves up and down while the camera goes around: 90 x 110 pixels."""
    rng = np.random.default_rng(5)
    board = cv2.GaussianBlur(rng.integers(0, 256, (110, 90)).astype(np.float64), (0, 0), 1.5)
    # the blur took three quarters of its contrast
    board = np.clip(128 + 4 * (board - 128), 0, 255).astype(np.uint8)
    top = (10, 60, 30, 110, 80, 20, 120, 50, 90)[n]
    out = picture.copy()
    out[top : top + 110, 120:210] = board
    return out


@pytest.mark.full
def test_something_that_moves_is_named_and_masks_take_it_out(draw, tmp_path):
    """B11."""
    drawn = draw(tmp_path / "in", draw=wanderer, views=6)
    row = fired(drawn.recover(tmp_path / "out"))["sweep-moving"]
    assert "calibration.static_poses.masks" in row.remedy and "static/00000" in row.remedy
    masks = tmp_path / "masks"
    (masks / "static").mkdir(parents=True)
    mask = np.full(SIZE[::-1], 255, dtype=np.uint8)
    mask[:, 115:215] = 0
    for name in drawn.truth:
        cv2.imwrite(str(masks / f"{name}.png"), mask)
    masked = drawn.recover(tmp_path / "masked", masks=masks)
    assert not ((masked.obs_xy[:, 0] > 116) & (masked.obs_xy[:, 0] < 214)).any()
    assert "sweep-moving" not in fired(masked)


@pytest.mark.full
def test_a_logo_is_named(draw, tmp_path):
    """B21: a frame of text that is the same in every picture."""
    rng = np.random.default_rng(7)
    text = cv2.resize(
        rng.integers(0, 2, (60, 80)).astype(np.uint8) * 255, SIZE, interpolation=cv2.INTER_NEAREST
    )

    def overlay(picture, n):
        out = text.copy()
        out[24:-24, 32:-32] = picture[24:-24, 32:-32]  # 10 % on each side
        return out

    try:
        rows = fired(draw(tmp_path / "in", draw=overlay, views=4).recover(tmp_path / "out"))
    except HealthError as error:
        assert error.code == "sweep-under-overlay"
    else:
        assert "sweep-overlay" in rows


@pytest.mark.full
def test_two_zooms_are_two_cameras_where_exif_tells(draw, tmp_path):
    """B12, first half: tags tell the zooms apart, and each focal length is found."""
    drawn = draw(tmp_path / "in", focal_px=lambda n: 300.0 if n % 2 else 390.0)
    exif = {name: Exif("camera", 300.0 if n % 2 else 390.0) for n, name in enumerate(sorted(drawn.truth))}
    model = replace(drawn, exif=exif).recover(tmp_path / "out")
    found = sorted(c["K"][0][0] for c in model.report["cameras"].values())
    # The corner's 9 pictures fix one focal length within 2 % (test_static_poses); with half of them each, 3 %
    assert found == pytest.approx([300.0, 390.0], rel=0.03)
    assert fired(model) == {}


@pytest.mark.full
def test_a_wrong_exif_focal_is_named(draw, tmp_path):
    """B17: 35 mm equivalent of another crop, 30 % too long."""
    model = draw(tmp_path / "in", exif_focal_px=1.3 * FOCAL, views=6).recover(tmp_path / "out")
    row = next(row for row in fired(model).values() if row.code == "sweep-focal")
    assert row.value == pytest.approx(100 * (1 - 1 / 1.3), abs=2.0)  # recovered within 2 %
    assert "390 px" in row.remedy


@pytest.mark.full
def test_out_of_time_says_what_was_left_out(draw, tmp_path):
    """B25: no time at all; the mapper is stopped after a second."""
    drawn = draw(tmp_path / "in")
    try:
        model = drawn.recover(tmp_path / "out", SweepOptions(time_s=0.0))
    except HealthError as error:  # a machine so slow that nothing was mapped
        assert error.code == "sweep-out-of-time"
        return
    row = fired(model)["sweep-unfinished"]
    assert "incremental" in str(row.value) and "budget.time_minutes" in row.remedy


def test_pairs_left_out_are_counted(corner):
    """B25 as the issue words it."""
    pairs = {"all": 4950, "wanted": 4950, "matched": 1200, "seconds": 390.0}
    row = fired(changed(corner.model, pairs=pairs))["sweep-unfinished"]
    assert "3750" in str(row.value) and "4950" in str(row.value)
    assert fired(changed(corner.model, pairs=pairs | {"wanted": 920})) == {}  # more than were wanted at first


# --- GPS ---


def place(metres: np.ndarray, std_m: float) -> Place:
    """East, north, up about 47 N 8 E; a degree of latitude is 111.17 km there (WGS 84), of longitude 76.06 km."""
    return Place(47 + metres[1] / 111_170, 8 + metres[0] / 76_060, 400 + metres[2], std_m)


@pytest.mark.full
def test_places_guide_the_mapper_and_wrong_ones_do_no_harm(corner, tmp_path):
    """B22: two of nine places are 40 m off."""
    rng = np.random.default_rng(0)
    truth = corner.corner.truth
    places = {n: place(10 * w[:3, 3] + rng.normal(0, 0.3, 3), 0.3) for n, w in truth.items()}
    for name in sorted(truth)[:2]:
        places[name] = place(10 * truth[name][:3, 3] + [40, 0, 0], 0.3)
    model = corner.corner.recover(tmp_path, places=places)
    assert model.names == corner.model.names and fired(model) == {}
    assert model.report["mean_reprojection_px"] < 1.1 * corner.model.report["mean_reprojection_px"]


# --- lens and motion: the recovered points, seen by a camera with the fault ---


def seen_by(model: SweepModel, cameras: dict[int, Camera]) -> np.ndarray:
    """Observations [M, 2] where pictures are taken by other cameras than the model's."""
    out = model.obs_xy.copy()
    for n, camera in cameras.items():
        mine = model.obs_image == n
        out[mine] = camera.project(model.xyz[model.obs_point[mine]])
    return out


def test_two_zooms_in_one_camera_are_named(corner):
    """B12: four pictures were taken 10 % closer, and nothing tells them apart."""
    model = corner.model
    K = np.diag([1.1, 1.1, 1.0]) @ model.cameras[0].K
    K[:2, 2] = model.cameras[0].K[:2, 2]
    closer = {n: replace(model.cameras[n], K=K) for n in (0, 2, 4, 6)}
    faulty = replace(model, obs_xy=seen_by(model, closer))
    zooms = two_zooms(faulty, picture_fits(faulty), 0.05)
    # One linear step towards 10 %, with the pose free to follow it: the second order is about a tenth of it
    assert zooms is not None and zooms.ratio == pytest.approx(1.1, abs=0.02)
    assert zooms.long == tuple(model.names[n] for n in (0, 2, 4, 6))
    row = fired(faulty)["sweep-focal one for all pictures"]
    assert "static/000000.png" in row.remedy and "EXIF" in row.remedy


@pytest.mark.parametrize(
    ("apart", "error", "verdict"),
    [(0.02, 0.9, "warn"), (0.05, 0.7, "fail"), (0.05, 0.98, None), (0.004, 0.9, None)],
)
def test_a_principal_point_that_moves_is_named(corner, apart, error, verdict):
    """Stabilisation hands on a crop that moves about: wide apart, and residuals want it."""
    assert corner.model.report["adjustment"]["crops"]["error"] > 0.98
    adjustment = corner.model.report["adjustment"] | {"crops": {"apart": apart, "error": error}}
    row = fired(changed(corner.model, adjustment=adjustment)).get("sweep-centre from picture to picture")
    assert (row and row.verdict) == verdict
    assert row is None or (row.value == pytest.approx(100 * apart) and "tabilisation" in row.remedy)
    zoom = {"from": "static/000004.png", "focal_px": [300.0, 345.0], "error": 1 - 2 * (1 - error)}
    zoomed = fired(changed(corner.model, adjustment=adjustment | {"zoom": zoom}))
    assert "sweep-centre from picture to picture" not in zoomed  # it explains twice as much
    zoom["error"] = error - 0.008  # it explains hardly more
    rows = fired(changed(corner.model, adjustment=adjustment | {"zoom": zoom}))
    assert ("sweep-centre from picture to picture" in rows) == (verdict is not None)


def test_focal_lengths_across_and_down_that_differ_are_named(corner):
    model = corner.model
    stretched = [replace(c, K=np.diag([1.0, 1.04, 1.0]) @ c.K) for c in model.cameras]
    rows = fired(replace(model, cameras=tuple(stretched), obs_xy=seen_by(model, dict(enumerate(stretched)))))
    row = rows["sweep-focal horizontal (fx) against vertical (fy)"]
    assert row.value == pytest.approx(4, abs=0.1) and row.verdict == "warn" and "tabilisation" in row.remedy
    counts = dict(zip(model.names, range(20, 100), strict=False))
    points = fired(changed(replace(model, cameras=tuple(stretched)), points_per_image=counts))["sweep-points"]
    assert points.verdict == "fail" and "lens" in points.remedy and "texture" not in points.remedy
    said = sweep_measures(replace(model, cameras=tuple(stretched)), pixel_aspect=1.04)  # as the file says
    assert "sweep-focal horizontal (fx) against vertical (fy)" not in judged.fired(said)


@pytest.mark.parametrize(("later_px", "verdict"), [(320.0, "warn"), (345.0, "fail")])
def test_a_zoom_in_mid_sweep_and_weak_pictures_are_named(corner, later_px, verdict):
    zoom = {"from": "static/000004.png", "focal_px": [300.0, later_px], "error": 0.8}
    adjustment = corner.model.report["adjustment"] | {"zoom": zoom}
    rows = fired(changed(corner.model, adjustment=adjustment, weak=["static/000007.png"]))
    row = rows["sweep-focal one for all pictures"]
    assert "static/000004.png" in row.remedy and f"{later_px:.0f}" in row.remedy and row.verdict == verdict
    assert "static/000007.png" in rows["sweep-points"].remedy and rows["sweep-points"].verdict == "warn"


@pytest.mark.parametrize(("cut", "found"), [(36, 36), (9, 9), (63, 63), (None, None)])
def test_where_a_film_zooms_is_found(cut, found):
    tried = []

    def fit(at: int) -> TwoLenses:
        tried.append(at)
        mixed = 36 if cut is None or not at else abs(at - cut)
        return TwoLenses(0.5 - (0.004 if at else 0) + 0.003 * (mixed if cut else 0), 300.0, 345.0)

    step = zoom_step(fit, 72)
    assert (None if step is None else step[0]) == found
    assert len(tried) < 20
    assert zoom_step(fit, 11) is None


@pytest.mark.full
def test_a_rolling_shutter_is_named(corner):
    """B20: the camera turns by 1 degree while it reads the picture out."""
    model, obs = corner.model, corner.model.obs_xy.copy()
    for n, camera in enumerate(model.cameras):
        mine = np.flatnonzero(model.obs_image == n)
        for m in mine:
            turn = rotation_about_y((-1.0 if n % 2 else 1.0) * (obs[m, 1] / camera.height - 0.5))
            pose = turn @ camera.cam_from_world
            obs[m] = replace(camera, cam_from_world=pose).project(model.xyz[model.obs_point[m]])
    row = fired(replace(model, obs_xy=obs))["sweep-rolling"]
    # 5.2 px from the first row to the last: 1.5 px root mean square; a roll of the camera takes half of it
    assert row.value == pytest.approx(0.8, abs=0.3)


@pytest.mark.parametrize(
    ("code", "lens"),
    [
        ("sweep-centre", {"cx": 30.0}),  # B14: 9 % of the width
        ("sweep-focal limits of its lens model", {"k1": -1.2}),  # B15
        ("sweep-focal limits of its lens model", {"f": 0.35}),  # B16: 117 degrees
    ],
)
def test_lenses_beyond_their_model_are_named(corner, code, lens):
    def bad(camera):
        K, distortion = camera.K.copy(), camera.distortion.copy()
        K[0, 2] += lens.get("cx", 0.0)
        K[:2, :2] *= lens.get("f", 1.0)
        distortion[:2] = [lens.get("k1", distortion[0]), 0.0]
        return replace(camera, K=K, distortion=distortion)

    faulty = replace(corner.model, cameras=tuple(bad(camera) for camera in corner.model.cameras))
    assert code in fired(faulty) and "sweep-focal limits of its lens model" not in fired(corner.model)


def test_a_principal_point_that_was_put_back_is_named(corner):
    """B14: it ran away in the adjustment."""
    adjustment = {"converged": True, "principal_point_free": False, "principal_point_put_back": [1]}
    row = fired(changed(corner.model, adjustment=adjustment))["sweep-centre"]
    assert " 5 %" in str(row.value) and "capture.board.clips.static" in row.remedy


def test_pictures_that_had_to_be_smaller_are_named(corner):
    row = judged.fired(sweep_measures(corner.model, side_px=720))["sweep-unfinished"]
    assert "720" in str(row.value) and "budget.memory_gb" in row.remedy


def test_an_adjustment_that_did_not_end_is_named(corner):
    """B18."""
    adjustment = corner.model.report["adjustment"] | {"converged": False}
    assert "sweep-unfinished" in fired(changed(corner.model, adjustment=adjustment))


def test_a_board_is_compared_with_its_own_device(corner):
    """Two devices: the board's is the second camera of the model; where none of its pictures is registered, nothing
    can be said."""
    one, start = corner.model.report["cameras"]["1"], corner.model.report["start"][0]
    K = np.array(one["K"]) * [[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]]
    width, height = SIZE
    board = Intrinsics(width, height, K, np.zeros(5))

    def row(camera_id: int | None):
        starts = [
            start | {"camera_id": 1, "source": "guess"},
            start | {"camera_id": camera_id, "source": "board"},
        ]
        model = changed(corner.model, cameras={"1": one, "2": one | {"K": K.tolist()}}, start=starts)
        return judged.judged(sweep_measures(model, board))["sweep-focal against the board"]

    assert row(2).value == 0 and row(2).verdict == "ok"
    assert row(1).value == pytest.approx(20) and row(1).verdict == "fail"  # 1 / 1.25 of the board's
    assert row(None).value is None and row(None).verdict == "warn"


# --- pairs, models, agreement ---


def test_views_of_two_sides_matched_as_one_are_named(corner):
    """B7: a pair with 150 matches that agree among themselves, but not with where the model has its cameras."""
    model, rng = corner.model, np.random.default_rng(0)
    cameras = dict(zip(model.names, model.cameras, strict=True))
    points = model.xyz[rng.choice(len(model.xyz), 150, replace=len(model.xyz) < 150)]

    def views(second: Camera) -> TwoViews:
        xy = np.stack([model.cameras[0].project(points), second.project(points)], axis=1)
        return TwoViews(
            model.names,
            np.array([[0, 5]]),
            ("CALIBRATED",),
            np.zeros(150, dtype=np.int64),
            xy,
            np.ones(150, dtype=bool),
        )

    assert against_model(views(model.cameras[5]), cameras)["contradicting"] == []
    turn = rotation_about_y(25.0)
    other = replace(model.cameras[5], cam_from_world=turn @ model.cameras[5].cam_from_world)
    found = against_model(views(other), cameras)
    assert found["contradicting"][0]["names"] == [model.names[0], model.names[5]]
    faulty = changed(model, verified_pairs=model.report["verified_pairs"] | found)
    row = fired(faulty)["sweep-contradicts"]
    assert "static/000000.png - static/000005.png" in row.remedy


def test_a_film_whose_neighbours_lie_apart_in_the_model_is_torn(corner):
    """Each textured tile of the floor looks like the next: a model that follows those has its path in pieces."""
    model, rng = corner.model, np.random.default_rng(0)
    points = model.xyz[rng.choice(len(model.xyz), 150, replace=len(model.xyz) < 150)]
    pairs = np.array([[0, 1], [0, 5]])
    xy = np.concatenate(
        [np.stack([model.cameras[i].project(points) for i in pair], axis=1) for pair in pairs.tolist()]
    )
    views = TwoViews(
        model.names, pairs, ("CALIBRATED",) * 2, np.repeat([0, 1], 150), xy, np.ones(300, dtype=bool)
    )
    cameras = dict(zip(model.names, model.cameras, strict=True))

    def torn(turned: int | None) -> list[list[str]]:
        where = dict(cameras)
        if turned is not None:
            camera = model.cameras[turned]
            turn = rotation_about_y(25.0) @ camera.cam_from_world
            where[model.names[turned]] = replace(camera, cam_from_world=turn)
        return torn_apart(model.names, against_model(views, where)["contradicting"])

    assert torn(None) == [] and torn(5) == []  # far pictures may show two places that look the same
    assert torn(1) == [list(model.names[:2])]
    row = fired(changed(model, torn=torn(1)))["sweep-contradicts"]
    assert str(row.value).startswith("1 ") and "static/000000.png - static/000001.png" in row.remedy


def test_small_and_many_models_are_named(corner):
    """B2, B3."""
    small = changed(corner.model, registered=2, given=24, unregistered=["static/000007.png"])
    row = fired(small)["sweep-registered"]
    assert row.verdict == "fail"
    lost = ["a.png", "b.png"]
    many = changed(corner.model, models=[61, 22, 9], other_models=[["a.png"], ["b.png"]], unregistered=lost)
    row = fired(many)["sweep-in-parts"]
    assert "61, 22, 9" in str(row.value) and "a.png" in row.remedy
    assert "sweep-in-parts" not in fired(
        changed(corner.model, models=[61, 2], other_models=[["a.png", "b.png"]])
    )


def test_an_open_loop_is_named():
    """B19: a full circle whose end sees what its beginning saw, but shares no point with it."""
    n, rng = 30, np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (600, 3))
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        centre = 4 * np.array([np.cos(angle), 0, np.sin(angle)])
        K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
        cameras.append(Camera(*SIZE, K, look_at(centre, np.zeros(3), (0.0, -1.0, 0.0))))

    def sweep(closed: bool) -> SweepModel:
        image, point = [], []
        # each point is followed through five pictures, over the end where it is closed
        for p in range(len(xyz)):
            for i in range(p % n, p % n + 5):
                if closed or i < n:
                    image.append(i % n)
                    point.append(p)
        i, p = np.array(image), np.array(point)
        xy = np.array([cameras[a].project(xyz[b]) for a, b in zip(i, p, strict=True)])
        names = tuple(f"static/{k:06d}.png" for k in range(n))
        some = np.zeros(len(xyz))
        nothing = np.zeros((len(i), 128), np.uint8)
        return SweepModel(
            names, tuple(cameras), xyz, np.zeros((600, 3), np.uint8), some, p, i, xy, nothing, {}
        )

    loop = open_loop(sweep(closed=True))
    assert loop is not None and loop[0] > LINKED
    assert open_loop(sweep(closed=False)) == (0, ("static/000000.png", "static/000029.png"))
