"""A tiny session through the real entry point: what is written is what ground_truth.json says."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import yaml
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.lab.simulate.scenes.catalogue import Mesh
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.camera_rig import BOARD_SQUARES
from devrf.lab.simulate.session.moved import ways
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.lab.simulate.session.sound import SAMPLE_RATE_HZ, SPEED_OF_SOUND_M_S

SIZE = (96, 72)
TINY = SessionOptions(
    sweep_frames=4,
    fps=12,
    duration_s=0.9,
    rest_s=0.3,
    motion_speed=2,
    pts_jitter_ms=4,
    claps=2,
    spp=8,
    board_frames=4,
)
SHEET = Simulation("sheet", 1, 3, SIZE, TINY)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("simulate") / "session"
    told: list[float] = []
    path = simulate_session(out, SHEET, progress=lambda f, m: told.append(f))
    assert path == out / "scene.yaml"
    assert told == sorted(told) and told[-1] == pytest.approx(1)
    return out


def _truth(session: Path) -> dict:
    return json.loads((session / "ground_truth.json").read_text(encoding="utf-8"))


def _pictures(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    return np.array([f.time for f in frames]), np.stack([f.to_ndarray(format="rgb24") for f in frames])


def _sound(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        frames = list(container.decode(audio=0))
    assert frames[0].time == 0 and frames[0].sample_rate == SAMPLE_RATE_HZ
    return np.concatenate([f.to_ndarray().ravel() for f in frames])


def test_truth_has_what_the_contract_names(session: Path) -> None:
    truth = _truth(session)
    assert (truth["width"], truth["height"]) == SIZE
    assert len(truth["static"]) == TINY.sweep_frames
    assert list(truth["cams"]) == ["cam0", "witness"]
    for camera in truth["cams"].values():
        pose = np.array(camera["pose"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert abs(camera["offset_s"]) <= TINY.offset_range_s
        assert abs(camera["drift_ppm"]) <= TINY.drift_range_ppm
    assert truth["cams"]["cam0"]["offset_s"] == truth["cams"]["cam0"]["drift_ppm"] == 0
    assert truth["cams"]["witness"]["offset_s"] != 0 and truth["cams"]["witness"]["drift_ppm"] != 0
    assert truth["board"]["squares"] == list(BOARD_SQUARES)


def test_scene_yaml_names_files_that_exist(session: Path) -> None:
    config = yaml.safe_load((session / "scene.yaml").read_text(encoding="utf-8"))
    capture = config["capture"]
    assert capture["rest"] == "start" and config["preset"] == "tiny"
    assert list(capture["cameras"]) == ["cam0"] and list(capture["test_cameras"]) == ["witness"]
    files = [capture["static"], *capture["cameras"].values(), *capture["test_cameras"].values()]
    files += [*capture["board"]["clips"].values(), config["evaluate"]["truth"]]
    assert all((session / file).is_file() for file in files)


def test_presentation_times_are_the_true_file_times(session: Path) -> None:
    truth = _truth(session)
    for name, camera in truth["cams"].items():
        times, pictures = _pictures(session / f"{name}.mp4")
        assert pictures.shape[1:] == (SIZE[1], SIZE[0], 3)
        np.testing.assert_allclose(times, camera["file_times_s"], atol=1e-6)
        assert times[0] == 0 and np.ptp(np.diff(times)) > 1e-3  # jitter was asked for
    times, _ = _pictures(session / "static.mp4")
    np.testing.assert_allclose(times, np.arange(TINY.sweep_frames) / TINY.sweep_fps, atol=1e-6)


def test_pictures_are_at_rest_until_the_motion_begins(session: Path) -> None:
    for name, camera in _truth(session)["cams"].items():
        times, pictures = _pictures(session / f"{name}.mp4")
        true_s = camera["offset_s"] + (1 + 1e-6 * camera["drift_ppm"]) * times
        change = np.abs(pictures.astype(float) - pictures[0]).mean(axis=(1, 2, 3))
        at_rest = change[1:][true_s[1:] <= TINY.rest_s]
        assert len(at_rest) >= 1 and at_rest.max() < 3.0  # grey levels: noise of pixels and of light paths
        assert change[true_s > TINY.rest_s + 0.3].min() > 2 * at_rest.max()


def test_masks_are_where_the_witness_pictures_change(session: Path) -> None:
    times, pictures = _pictures(session / "witness.mp4")
    masks = np.load(session / "witness_mask.npz")["mask"]
    assert masks.shape == pictures.shape[:3] and masks.dtype == bool
    camera = _truth(session)["cams"]["witness"]
    true_s = camera["offset_s"] + (1 + 1e-6 * camera["drift_ppm"]) * times
    assert not masks[true_s <= TINY.rest_s].any()
    changed = np.abs(pictures[-1].astype(float) - pictures[0]).mean(-1)
    assert masks[-1].mean() > 0.05 and changed[masks[-1]].mean() > 4 * changed[~masks[-1]].mean()


def test_points_of_the_object_go_as_its_truth_says(session: Path) -> None:
    with np.load(session / "object_points.npz") as points:
        times_s, points_m = points["times_s"], points["points_m"]
    thing = _truth(session)["object"]
    assert points_m.shape == (len(times_s), 2000, 3)
    way = np.linalg.norm(points_m[-1] - points_m[0], axis=-1)
    near = int(np.argmin(np.abs(np.array(thing["times_s"]) - times_s[-1])))
    sparse = np.linalg.norm(np.subtract(thing["points_m"][near], thing["points_m"][0]), axis=-1)
    assert np.median(way) == pytest.approx(np.median(sparse), abs=0.06)


def test_points_of_the_truth_are_spread_evenly_over_large_triangles() -> None:
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [3, 0, 0.01], [3, 0, 0]])
    faces, uv, texture = np.array([[0, 1, 2], [1, 3, 4]]), np.zeros((5, 2)), np.zeros((2, 2, 3), np.uint8)
    at_rest = Mesh(corners, faces, uv, texture)
    points = ways([at_rest, replace(at_rest, vertices=corners + [0, 0, 2.0])])
    assert points.shape == (2, 2000, 3) and np.allclose(points[1], points[0] + [0, 0, 2.0], atol=1e-6)
    assert np.allclose(points[0].mean(0), [1, 1 / 3, 0], atol=0.05)  # the second triangle is next to nothing
    assert (points[0] @ [1 / 3, 1, 0]).max() <= 1 + 1e-6


def test_claps_are_heard_when_the_truth_says(session: Path) -> None:
    truth = _truth(session)
    for name, camera in truth["cams"].items():
        loud = np.abs(_sound(session / f"{name}.mp4"))
        heard_s = np.array(truth["claps"]["times_s"]) + camera["clapper_distance_m"] / SPEED_OF_SOUND_M_S
        for file_s in (heard_s - camera["offset_s"]) / (1 + 1e-6 * camera["drift_ppm"]):
            first = round((file_s - 0.003) * SAMPLE_RATE_HZ)
            window = loud[first : first + 480]
            onset_s = (first + np.argmax(window > 0.25 * window.max())) / SAMPLE_RATE_HZ
            assert 0 <= onset_s - file_s < 0.001  # the burst needs 0.4 ms to grow


@pytest.mark.full
def test_same_seed_same_session(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    options = SessionOptions(sweep_frames=2, fps=5, duration_s=0.5, spp=4, board=False, claps=1)
    for name in ("a", "b"):
        simulate_session(tmp_path / name, Simulation("column", 1, 1, (32, 24), options))
    assert _truth(tmp_path / "a") == _truth(tmp_path / "b")
    for file in ("static.mp4", "cam0.mp4", "witness.mp4"):
        one, other = (_pictures(tmp_path / name / file)[1].astype(float) for name in ("a", "b"))
        assert np.abs(one - other).mean() < 1.0  # grey levels: x264 itself rarely chooses otherwise
    np.testing.assert_array_equal(_sound(tmp_path / "a" / "cam0.mp4"), _sound(tmp_path / "b" / "cam0.mp4"))
    assert _truth(tmp_path / "a")["board"] is None
    assert "board" not in yaml.safe_load((tmp_path / "a" / "scene.yaml").read_text())["capture"]


def test_folder_with_files_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with refused("folder-exists", tmp_path, kind=InputError):
        simulate_session(tmp_path, SHEET)
    assert (tmp_path / "mine.txt").read_text() == "precious"


def test_missing_renderer_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with refused("package-missing", "pip install 'devrf[simulate]'", "-e '.[simulate]'", kind=InputError):
        simulate_session(tmp_path / "out", SHEET)
    assert not (tmp_path / "out").exists()
