"""Evaluation with models whose scores are known beforehand."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.evaluation.evaluate import Known, LpipsNets, evaluate, motion_psnr

WIDTH, HEIGHT, SCALE = 100, 80, 0.5
TIMES = (0.0, 0.5, 1.0)
NO_LPIPS = LpipsNets.load(None)


def background() -> np.ndarray:
    """A smooth picture [HEIGHT, WIDTH, 3] whose reduction to half size is exact in 8 bits."""
    small = np.random.default_rng(0).integers(60, 160, (10, 10, 3)).astype(np.uint8)
    half = cv2.resize(small, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_CUBIC)
    return half.repeat(2, axis=0).repeat(2, axis=1)


def at(time: float | None) -> np.ndarray:
    """The scene: a bright square that moves right with time; at rest as at time 0."""
    picture = background()
    x = 10 + int(40 * (time or 0.0))
    picture[30:50, x : x + 20] = 250
    return picture


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A witness at three times, a training camera, and two sweep pictures of which one is held out."""
    K = np.array([[80.0, 0, 50], [0, 80, 40], [0, 0, 1]])
    camera = Camera(WIDTH, HEIGHT, K, np.eye(4)[:3])

    def frame(name: str, index: int, time: float | None, split) -> PosedFrame:
        path = tmp_path / f"{name}{index}.png"
        cv2.imwrite(str(path), at(time)[..., ::-1])
        return PosedFrame(path, camera, name, index, None if time is None else 2 * time, time, split)

    sweep = frame("static", 0, None, "test"), frame("static", 1, None, "train")
    splits = {"witness": "test", "cam0": "train"}
    fixed = [frame(name, 3 * n, t, splits[name]) for name in splits for n, t in enumerate(TIMES)]
    return scene_of(sweep, fixed, 0.5, t1_s=2.0, image_scale=SCALE)


def model(error: float, moves: bool = True) -> tuple[Callable, list]:
    """A model that is wrong by `error` everywhere, and the calls it got."""
    calls = []

    def render(camera: Camera, time: float | None) -> np.ndarray:
        calls.append((camera.width, camera.height, time))
        full = at(time if moves else None)
        return full[::2, ::2].astype(np.float32) / 255 + np.float32(error)

    return render, calls


def test_scores_of_a_known_error(scene, tmp_path):
    render, calls = model(0.01)
    out = evaluate(scene, render, NO_LPIPS, tmp_path)
    for block in (out["test"], out["test_static"], out["test_moving"]):
        assert block["psnr"] == pytest.approx(40, abs=1e-3)  # 8-bit rounding would give another value
        assert block["ssim"] > 0.99
        assert (
            block["lpips_vgg"] is None and "lpips_weights" in str(block["why"]) or block is out["test_moving"]
        )
    assert out["test"]["views"] == 3 and out["test_moving"]["views"] == 2 and out["test_static"]["views"] == 1
    assert {(w, h) for w, h, _ in calls} == {(50, 40)}
    # the witness stands: at rest it is rendered once, besides its three times and the held-out picture
    assert [t for *_, t in calls].count(None) == 2 and len(calls) == 5
    assert out["render_fps"] > 0


def test_baseline_is_the_scene_at_rest_on_the_same_pixels(scene, tmp_path):
    moving = evaluate(scene, model(0.01)[0], NO_LPIPS, tmp_path / "a")
    still = evaluate(scene, model(0.01, moves=False)[0], NO_LPIPS, tmp_path / "b")
    for part in ("test", "test_moving"):
        base = moving["static_baseline"][part]
        assert base["psnr"] == pytest.approx(still[part]["psnr"])  # a model that never moves is the baseline
        assert base["psnr"] == pytest.approx(still["static_baseline"][part]["psnr"])
        assert base["psnr"] < moving[part]["psnr"] - 10
    # what does not move is left out, so the baseline looks worse there than over the whole picture
    assert moving["static_baseline"]["test_moving"]["psnr"] < moving["static_baseline"]["test"]["psnr"] - 2


def test_what_counts_as_moving_does_not_depend_on_the_model(scene, tmp_path):
    def render(camera: Camera, time: float | None) -> np.ndarray:
        picture = at(time)[::2, ::2].astype(np.float32) / 255
        if time == 0.0:
            picture += np.float32(0.5)  # wrong where nothing has moved yet: must not count
        picture[:5] = 0  # wrong far from motion, at rest as well: must not count either
        return picture

    out = evaluate(scene, render, NO_LPIPS, tmp_path)
    assert out["test_moving"]["psnr"] == 100
    assert out["test"]["psnr"] < 40
    rows = [row for row in out["per_view"] if row["camera"] == "witness"]
    assert "moving" not in rows[0]
    # at the end the square has left its place: 10 x 10 pixels there and here, and around each what the blur and the
    # dilation add, two pixels each
    assert 2 * 14 * 14 / 2000 < rows[2]["moving"]["share"] < 2 * 18 * 18 / 2000
    perfect = evaluate(scene, model(0.0)[0], NO_LPIPS, tmp_path)
    assert [r["moving"]["share"] for r in rows[1:]] == [
        r["moving"]["share"] for r in perfect["per_view"] if "moving" in r
    ]


def test_what_stands_is_measured_on_the_test_cameras_picture_at_rest(scene, tmp_path):
    out = evaluate(scene, model(0.01)[0], NO_LPIPS, tmp_path)
    assert out["test_rest"]["psnr"] == pytest.approx(40, abs=1e-3) and out["test_rest"]["views"] == 1
    (row,) = out["still_pictures"]
    assert row["camera"] == "witness" and row["source"] == "rest" and row["known"] == 1
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / row["true"])), at(0.0)[::2, ::2])
    assert (tmp_path / row["rendered"]).is_file()


def test_without_a_picture_at_rest_a_clean_plate_shows_what_stands(scene, tmp_path):
    times = np.linspace(0, 1, 11)
    for n, time in enumerate(times):
        cv2.imwrite(str(tmp_path / f"long{n}.png"), at(time)[..., ::-1])
    camera = scene.dynamic[0]
    clip = tuple(
        replace(camera, path=tmp_path / f"long{n}.png", index=n, time=t, time_s=2 * t)
        for n, t in enumerate(times.tolist())
    )
    scene = replace(scene, dynamic=clip, rest_time=None)

    def render(camera: Camera, time: float | None) -> np.ndarray:
        if time is None:  # what stands: no square at all
            return background()[::2, ::2].astype(np.float32) / 255 + np.float32(0.01)
        return at(time)[::2, ::2].astype(np.float32) / 255

    out = evaluate(scene, render, NO_LPIPS, tmp_path)
    (row,) = out["still_pictures"]
    assert row["source"] == "plate" and 0.6 < row["known"] <= 1
    assert out["test_rest"]["psnr"] == pytest.approx(40, abs=0.5)
    assert out["test_moving"]["psnr"] == 100 and out["test_moving"]["views"] == 11
    assert out["static_baseline"]["test_moving"]["psnr"] < 20


def test_a_test_camera_that_moves_shows_nothing_at_rest(scene, tmp_path):
    moved = tuple(
        replace(f, camera=replace(f.camera, cam_from_world=np.eye(4)[:3] + [0, 0, 0, n]))
        for n, f in enumerate(scene.dynamic)
    )
    out = evaluate(replace(scene, dynamic=moved), model(0.01)[0], NO_LPIPS, tmp_path)
    for block in (out["test_moving"], out["test_rest"], out["static_baseline"]["test_moving"]):
        assert block["psnr"] is None and "static_baseline.test" in block["why"]["psnr"]
    assert out["still_pictures"] == [] and out["test"]["psnr"] == pytest.approx(40, abs=1e-3)
    # so motion is measured on whole pictures; where a test camera stands, and nothing moves, it is not measured
    assert motion_psnr(out) == (out["test"]["psnr"], out["static_baseline"]["test"]["psnr"])
    still = tuple(replace(f, path=scene.dynamic[0].path) for f in scene.dynamic)
    assert motion_psnr(evaluate(replace(scene, dynamic=still), model(0.01)[0], NO_LPIPS, tmp_path)) == (
        None,
        None,
    )


def test_masks_of_the_truth_say_what_moves(scene, tmp_path):
    masks = np.zeros((7, HEIGHT, WIDTH), dtype=bool)
    masks[3, 40:60, 20:60] = True
    out = evaluate(scene, model(0.01)[0], NO_LPIPS, tmp_path, known=Known({"witness": masks}))
    shares = [row.get("moving", {}).get("share") for row in out["per_view"] if row["camera"] == "witness"]
    assert shares == [None, 0.1, None]


def test_pictures_are_written_and_named(scene, tmp_path):
    out = evaluate(scene, model(0.0)[0], NO_LPIPS, tmp_path)
    row = next(row for row in out["per_view"] if row["time"] == 0.5)
    assert row["true"] == "views/witness/000003_true.png"
    assert row["camera"] == "witness" and row["index"] == 3 and row["time_s"] == 1.0
    for kind in ("true", "rendered", "rest", "error"):
        assert (tmp_path / row[kind]).is_file()
    rendered, error = (np.asarray(Image.open(tmp_path / row[kind])) for kind in ("rendered", "error"))
    np.testing.assert_array_equal(rendered, at(0.5)[::2, ::2])
    assert error.max() <= 10


def test_scene_at_rest(scene, tmp_path):
    out = evaluate(replace(scene, dynamic=()), model(0.1)[0], NO_LPIPS, tmp_path)
    assert out["test"] == out["test_static"] and out["test"]["psnr"] == pytest.approx(20, abs=1e-3)
    assert out["test_moving"]["psnr"] is None
    assert out["test_moving"]["why"]["psnr"] == out["static_baseline"]["test"]["why"]["psnr"] != ""


def test_no_test_camera(scene, tmp_path):
    only_training = tuple(f for f in scene.dynamic if f.split == "train")
    out = evaluate(replace(scene, dynamic=only_training), model(0.1)[0], NO_LPIPS, tmp_path)
    assert out["test"]["psnr"] is None and "capture.test_cameras" in out["test"]["why"]["psnr"]
    assert out["test_static"]["psnr"] == pytest.approx(20, abs=1e-3)


def test_lpips_where_weights_are_given(scene, tmp_path, data_dir):
    name = "lpips_alex_v0.1.npz"
    (tmp_path / name).symlink_to(data_dir / "weights" / name)
    alex = LpipsNets.load(tmp_path)  # the other network's weights are not there
    full = replace(scene, image_scale=1.0, dynamic=scene.dynamic[:2])

    def render(camera: Camera, time: float | None) -> np.ndarray:
        return at(time).astype(np.float32) / 255

    out = evaluate(full, render, alex, tmp_path)
    assert out["test"]["lpips_alex"] == pytest.approx(0, abs=1e-6)
    assert out["static_baseline"]["test"]["lpips_alex"] > 0.001
    assert out["test"]["lpips_vgg"] is None and "lpips_vgg_v0.1.npz" in out["test"]["why"]["lpips_vgg"]
    assert out["test_moving"]["lpips_alex"] is None and out["test_moving"]["why"]["lpips_alex"]
    small = evaluate(scene, model(0.0)[0], alex, tmp_path / "small")
    assert "64 pixels" in small["test"]["why"]["lpips_alex"]


LATE = 0.2  # of the modelled time, two pictures, by which the witness takes its pictures later than its clock says


@pytest.fixture
def late(scene: Scene, tmp_path) -> Scene:
    """The witness films eleven pictures; what it shows at its end is beyond the modelled time."""
    camera, cam0 = scene.dynamic[0], scene.dynamic[len(TIMES)]
    frames = []
    for n, time in enumerate(np.linspace(0, 1, 11).tolist()):
        path = tmp_path / f"late{n}.png"
        cv2.imwrite(str(path), at(min(1.0, time + LATE if n else 0.0))[..., ::-1])
        frames.append(replace(camera, path=path, index=n, time=time, time_s=2 * time))
    return replace(scene, dynamic=(*frames[::-1], cam0))


def found(offset_s: float | None, why: str = "") -> dict:
    return {"witness": {"std_s": 0.1, "offset_s": offset_s, "why": why}}


def test_a_clock_that_was_found_is_scored_beside_the_calibrated_one(late: Scene, tmp_path) -> None:
    plain = evaluate(late, model(0.01)[0], NO_LPIPS, tmp_path / "a")
    out = evaluate(late, model(0.01)[0], NO_LPIPS, tmp_path / "b", known=Known(test_clocks=found(2 * LATE)))
    retimed, base = out.pop("test_moving_retimed"), out["static_baseline"].pop("test_moving_retimed")
    rows = {row["index"]: row.pop("retimed", None) for row in out["per_view"] if row["camera"] == "witness"}
    for result in (plain, out):
        del result["render_fps"]
    assert plain == out  # nothing that is by the calibrated clock depends on what was found
    # Found on pictures 0, 2, 4, …, scored on the others; those beyond the modelled time at its end.
    assert [n for n, row in rows.items() if row is not None] == [1, 3, 5, 7, 9]
    assert [rows[n]["time"] for n in (1, 7, 9)] == pytest.approx([0.3, 0.9, 1.0])
    assert retimed["psnr"] == pytest.approx(40, abs=1e-3) and retimed["views"] == 5
    assert retimed["offsets_ms"] == {"witness": pytest.approx(400)} and retimed["lpips_vgg"] is None
    odd = [row for row in plain["per_view"] if row["camera"] == "witness" and row["index"] % 2]
    assert retimed["calibrated_psnr"] == pytest.approx(np.mean([row["moving"]["psnr"] for row in odd]))
    still = [row["static_baseline"]["moving"]["psnr"] for row in odd]
    assert base["psnr"] == pytest.approx(np.mean(still)) and base["views"] == 5
    assert base["psnr"] < retimed["psnr"] - 10 and retimed["calibrated_psnr"] < retimed["psnr"] - 10


def test_the_pictures_that_are_scored_do_not_depend_on_the_clock(late: Scene, tmp_path) -> None:
    sets = []
    for n, offset_s in enumerate((-1.5, 0.1, 1.5)):
        out = evaluate(
            late, model(0.01)[0], NO_LPIPS, tmp_path / str(n), known=Known(test_clocks=found(offset_s))
        )
        sets.append([row["index"] for row in out["per_view"] if "retimed" in row])
        assert out["test_moving"]["views"] == 10
    assert sets[0] == sets[1] == sets[2] == [1, 3, 5, 7, 9]


def test_a_clock_that_is_not_clear_has_no_second_number(late: Scene, tmp_path) -> None:
    out = evaluate(
        late, model(0.01)[0], NO_LPIPS, tmp_path / "a", known=Known(test_clocks=found(None, "not clear"))
    )
    for block in (out["test_moving_retimed"], out["static_baseline"]["test_moving_retimed"]):
        assert block["psnr"] is None and "witness: not clear" in block["why"]["psnr"] and block["views"] == 0
    assert out["test_moving_retimed"]["offsets_ms"] == {"witness": None}
    known = evaluate(late, model(0.01)[0], NO_LPIPS, tmp_path / "b")
    assert "test_moving_retimed" not in known and "test_moving_retimed" not in known["static_baseline"]
