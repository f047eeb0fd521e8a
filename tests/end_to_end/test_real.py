"""Real captures through the real command line: photos, webcams with a board, portrait clips, a data set."""

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.conftest import SMALL_FILM

from devrf.pipelines.stages import NO_CAMERAS, render
from devrf.reconstruct.evaluation.evaluate import motion_psnr

pytestmark = pytest.mark.full


def write_scene(folder: Path, **value: object) -> Path:
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({"output": str(folder / "run"), "preset": "tiny"} | value))
    return path


def read(path: Path) -> Any:
    return json.loads(path.read_text())


# --- fox_static: 50 photos, a scene at rest ---


@pytest.fixture(scope="module")
def fox(devrf: Callable, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the fox, from photos to the report."""
    folder = tmp_path_factory.mktemp("fox")
    capture = {"static": str(data_dir / "fox_static" / "images")}
    small = {"canonical_iterations": 100, "resolution": 64, "image_scale": 0.25}
    scene = write_scene(folder, name="fox", capture=capture, reconstruct=small)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(render.SIZES, "tiny", SMALL_FILM)
        result = devrf("run", scene)
    assert result.code == 0, result.said
    return folder


def test_fox_is_a_scene_at_rest(devrf: Callable, fox: Path) -> None:
    result = devrf("status", fox, "--json")
    stages = {stage["stage"]: stage for stage in json.loads(result.out)["stages"]}
    for name in ("sync", "rig", "flow", "deformation"):
        assert stages[name]["state"] == "not applicable"
        assert stages[name]["why"] == [NO_CAMERAS]
    assert all(stage["state"] == "fresh" for name, stage in stages.items() if not stage["why"])
    assert (fox / "run/report/index.html").is_file()
    assert list((fox / "run/render").glob("*.mp4"))


def test_fox_poses_agree_with_the_reference(fox: Path, data_dir: Path) -> None:
    poses = read(fox / "run/static_poses/static_poses.json")
    assert poses["given"] == 50
    assert poses["registered"] >= 48
    ingest = read(fox / "run/ingest/ingest.json")["cameras"]["static"]
    reference = {
        Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3, :3] @ np.diag([1.0, -1, -1])
        for frame in read(data_dir / "fox_static/transforms.json")["frames"]
    }
    sources = fox_sources(ingest, data_dir)
    ours, theirs = [], []
    for name, frame in poses["frames"].items():
        index = int(Path(name).stem)
        ours.append(np.array(frame["camera_from_world"])[:, :3].T)
        theirs.append(reference[sources[index]])
    angles = rotation_errors_deg(np.array(ours), np.array(theirs))
    assert np.median(angles) <= 0.5


def fox_sources(ingest: dict[str, Any], data_dir: Path) -> dict[int, str]:
    """Frame index -> name of the photo: natural order of the folder."""
    names = sorted((data_dir / "fox_static/images").iterdir(), key=lambda p: int(p.stem))
    assert len(names) == len(ingest["frames"])
    return {frame["index"]: name.name for frame, name in zip(ingest["frames"], names, strict=True)}


def rotation_errors_deg(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Angles between world-from-camera rotations after the rotation that brings both worlds together."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", theirs, ours))
    align = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    relative = np.einsum("nji,njk->nik", align @ ours, theirs)
    cos = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cos, -1, 1)))


def test_fox_held_out_photos(fox: Path) -> None:
    metrics = read(fox / "run/evaluate/metrics.json")
    assert metrics["test"]["psnr"] >= 20.0
    assert metrics["test_static"]["psnr"] == pytest.approx(metrics["test"]["psnr"])


# --- caliscope: four webcams, no sweep; true times in a table; an inverted board before all at once ---


def caliscope(folder: Path, data_dir: Path, end_s: float = 30, **changes: object) -> Path:
    source = data_dir / "caliscope_post_optimization" / "calibration" / "extrinsic"
    clips = {f"cam{n}": str(source / f"cam_{n}.mp4") for n in range(4)}
    times = folder / "times.csv"
    times.write_text(caliscope_times(source / "timestamps.csv"))
    board = {
        "type": "charuco",
        "squares": [4, 5],
        "square_m": 0.054,
        "marker_m": 0.0405,
        "dictionary": "DICT_4X4_1000",
        "joint_clips": clips,
    }
    capture = {"cameras": clips, "timestamps": str(times), "board": board, "range_s": [25, end_s]}
    return write_scene(folder, name="webcams", capture=capture, **changes)


def caliscope_times(table: Path) -> str:
    """Their columns sync_index (one per frame), cam_id, frame_time as camera, frame_index, time_s."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    first = min(int(row["sync_index"]) for row in rows)
    lines = [f"cam{r['cam_id']},{int(r['sync_index']) - first},{r['frame_time']}" for r in rows]
    return "\n".join(["camera,frame_index,time_s", *lines]) + "\n"


@pytest.fixture(scope="module")
def webcams(devrf: Callable, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The run folder of the webcams up to the rig, and what was said."""
    folder = tmp_path_factory.mktemp("webcams")
    result = devrf("run", caliscope(folder, data_dir), "--until", "rig", "--verbose")
    assert result.code == 0, result.said
    return folder / "run", result.said


def test_webcams_rig_comes_from_the_board(webcams: tuple[Path, str], data_dir: Path) -> None:
    rig = read(webcams[0] / "rig/rig.json")
    assert len(rig["cameras"]) == 4
    assert rig["scale"]["metric"] is True
    assert "board" in rig["scale"]["source"]


def test_webcams_measure_the_board_and_the_late_clock_is_named(webcams: tuple[Path, str]) -> None:
    """Lengths on views that no fit has seen; the table stamps cam1's pictures some 100 ms late.

    The pictures are 5 s long: its delay is known to about 5 ms, and its single pictures scatter by 20 ms.
    """
    rig, health = (read(webcams[0] / "rig" / name) for name in ("rig.json", "health.json"))
    rows = {(row["code"], row["about"]): row for row in health["rows"]}
    assert rows["board-lengths", ""]["verdict"] == "ok"
    assert -130 < rig["cameras"]["cam1"]["details"]["delay_ms"] < -50
    assert rows["clocks-disagree", "cam1"]["verdict"] == "warn"
    assert {(link["a"], link["b"]) for link in rig["graph"]} >= {("cam0", "cam1"), ("cam2", "cam3")}


def test_a_webcam_that_is_a_test_camera_moves_no_other(
    webcams: tuple[Path, str], devrf: Callable, data_dir: Path, tmp_path: Path
) -> None:
    """Without a sweep it is placed by the board, in the rig of those that are trained on."""
    rigs = {}
    for kind in ("as test camera", "without"):
        (tmp_path / kind).mkdir()
        scene = caliscope(tmp_path / kind, data_dir)
        content = yaml.safe_load(scene.read_text())
        capture = content["capture"]
        clips = capture["board"]["joint_clips"]
        capture["cameras"] = {name: clip for name, clip in clips.items() if name != "cam3"}
        if kind == "without":
            capture["board"]["joint_clips"] = capture["cameras"]
        else:
            capture["test_cameras"] = {"cam3": clips["cam3"]}
        scene.write_text(yaml.safe_dump(content))
        assert devrf("run", scene, "--until", "rig", "--allow-unhealthy").code == 0
        rigs[kind] = read(tmp_path / kind / "run" / "rig" / "rig.json")
    placed = rigs["as test camera"]["cameras"].pop("cam3")
    assert rigs["as test camera"]["cameras"] == rigs["without"]["cameras"]
    together = read(webcams[0] / "rig" / "rig.json")["cameras"]
    found = {**rigs["without"]["cameras"], "cam3": placed}
    theirs, ours = (
        np.array([np.array(cameras[name]["cam_from_world"])[:3, :3].T for name in sorted(found)])
        for cameras in (together, found)
    )
    assert rotation_errors_deg(ours, theirs).max() < 1.0


def test_webcams_clocks_come_from_the_table(webcams: tuple[Path, str]) -> None:
    sync = read(webcams[0] / "sync/sync.json")
    assert {camera["method"] for camera in sync["cameras"].values()} == {"timestamps"}


def test_webcams_unequal_exposure_is_reported(webcams: tuple[Path, str]) -> None:
    assert "exposure" in webcams[1]


def test_webcams_have_flow(
    devrf: Callable, webcams: tuple[Path, str], data_dir: Path, tmp_path: Path
) -> None:
    """A second of them, with the rig that was found."""
    calibration = {"rig": {"given": str(webcams[0] / "rig" / "rig.json")}}
    result = devrf("run", caliscope(tmp_path, data_dir, 26, calibration=calibration), "--until", "flow")
    assert result.code == 0, result.said
    assert len([path for path in (tmp_path / "run/flow").iterdir() if path.is_dir()]) == 4


def test_webcams_without_until_are_refused(devrf: Callable, data_dir: Path, tmp_path: Path) -> None:
    result = devrf("run", caliscope(tmp_path, data_dir))
    assert result.code == 2
    assert "--until flow" in result.err


# --- pose2sim: portrait clips of two sizes, two codecs ---


def portrait(folder: Path, data_dir: Path, given: Path) -> Path:
    source = data_dir / "pose2sim_single" / "videos"
    clips = {path.stem: str(path) for path in sorted(source.glob("cam*.mp4"))}
    assert len(clips) == 4
    capture = {"cameras": clips, "range_s": [0, 0.04]}
    calibration = {"rig": {"given": str(given)}, "sync": {"method": "none"}}
    return write_scene(folder, name="portrait", capture=capture, calibration=calibration)


def test_portrait_clips_of_two_sizes(devrf: Callable, data_dir: Path, tmp_path: Path) -> None:
    """Two codecs and two widths go through to flow, each camera at its own size."""
    sizes = {"cam01": 1080, "cam02": 1080, "cam03": 1088, "cam04": 1088}
    given = tmp_path / "rig.json"
    rig = {name: upright(width, at) for at, (name, width) in enumerate(sizes.items())}
    given.write_text(json.dumps({"cameras": rig}))
    result = devrf("run", portrait(tmp_path, data_dir, given), "--until", "flow")
    assert result.code == 0, result.said
    ingest = read(tmp_path / "run/ingest/ingest.json")["cameras"]
    assert {name: (c["width"], c["height"]) for name, c in ingest.items()} == {
        name: (width, 1920) for name, width in sizes.items()
    }
    assert {path.parent.name for path in (tmp_path / "run/flow").glob("*/*.npz")} == set(sizes)


def upright(width: int, x: float) -> dict[str, Any]:
    """A camera as rig.json has it; where it stands does not matter to flow."""
    centre = [width / 2, 960.0]
    K = [[1680.0, 0.0, centre[0]], [0.0, 1680.0, centre[1]], [0.0, 0.0, 1.0]]
    pose = [[1.0, 0.0, 0.0, -x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    std = {"rotation_deg": 0.1, "position": 0.01}
    return {
        "model": "OPENCV",
        "K": K,
        "distortion": [0.0] * 5,
        "width": width,
        "height": 1920,
        "cam_from_world": pose,
        "std": std,
    }


def test_a_calibration_of_uncropped_pictures_is_refused_by_name(
    devrf: Callable, data_dir: Path, tmp_path: Path
) -> None:
    given = data_dir / "pose2sim_single" / "calibration" / "Calib.qca.txt"
    result = devrf("run", portrait(tmp_path, data_dir, given), "--until", "flow")
    assert result.code == 2
    said = " ".join(result.err.split())
    assert "calibration.rig.given" in said and "Calib.qca.txt" in said
    assert re.search("'cam01' .*1088x1920.*1080x1920", said)


# --- devrf_cloth: a finished data set ---


@pytest.fixture(scope="module")
def cloth(devrf: Callable, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the waving sheet, to its metrics."""
    folder = tmp_path_factory.mktemp("cloth")
    dataset = {"format": "devrf", "path": str(data_dir / "devrf_cloth"), "frame_stride": 5}
    scene = write_scene(folder, name="cloth", dataset=dataset, reconstruct={"canonical_iterations": 300})
    result = devrf("run", scene, "--until", "evaluate")
    assert result.code == 0, result.said
    return folder / "run"


def test_cloth_motion_beats_standing_still(cloth: Path) -> None:
    moving, still = motion_psnr(read(cloth / "evaluate/metrics.json"))
    assert moving is not None and still is not None and moving - still >= 3.0


def test_cloth_needs_no_raw_files(cloth: Path) -> None:
    assert not any((cloth / name).exists() for name in ("ingest", "static_poses", "sync", "rig"))
