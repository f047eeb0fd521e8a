"""The evaluate stage through its entry point, with a model that is known."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from tests.make.scenes import scene_of
from tests.reconstruct.conftest import look_at

from devrf.calibration.truth import read_truth
from devrf.capture.camera import Camera
from devrf.capture.formats import read_scene, write_scene
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.progress import no_progress
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.judge import judge
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import evaluate

K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
MOVE = np.diag([2.0, 2.0, 2.0, 1.0])  # the recovered world is twice as large as the true one
TIMES = (0.0, 0.5, 1.0)


def _camera(degrees: float, height: float) -> Camera:
    angle = np.radians(degrees)
    return replace(look_at(np.array([2 * np.cos(angle), 2 * np.sin(angle), height]), 64, 48), K=K)


def _picture(time: float | None) -> np.ndarray:
    picture = np.full((48, 64, 3), 0.25, np.float32)
    x = 8 + int(30 * (time or 0))
    picture[10:30, x : x + 12] = 0.75
    return picture


@pytest.fixture
def context(tmp_path: Path) -> StageContext:
    """A run folder as the stages before leave it, true poses and clocks beside scene.yaml."""
    run = tmp_path / "run"
    sweep = [_camera(30.0 * n, 0.5 + 0.05 * (n % 3)) for n in range(12)]
    fixed = {"cam0": _camera(-40.0, 1.0), "cam1": _camera(40.0, 1.2), "witness": _camera(0.0, 1.1)}

    def frame(name: str, camera: Camera, index: int, time: float | None, split) -> PosedFrame:
        path = tmp_path / f"{name}{index}.png"
        cv2.imwrite(str(path), np.round(_picture(time) * 255).astype(np.uint8))
        return PosedFrame(
            path, camera.moved(MOVE), name, index, None if time is None else 2 * time, time, split
        )

    still = [frame("static", c, n, None, "test" if n % 4 == 0 else "train") for n, c in enumerate(sweep)]
    moving = [
        frame(name, c, n, t, "test" if name == "witness" else "train")
        for name, c in fixed.items()
        for n, t in enumerate(TIMES)
    ]
    scene = scene_of(still, moving, 0.5, t1_s=2.0)
    for name in ("scene", "canonical", "deformation", "sync", "ingest", "evaluate"):
        (run / name).mkdir(parents=True)
    write_scene(run / "scene", scene)
    cost = {"seconds": 10.0, "iterations": 100, "rays": 5000, "peak_rss_gb": 1.0, "peak_gpu_gb": None}
    _json(run / "canonical/metrics.json", {**cost, "device": "cpu"})
    _json(run / "deformation/metrics.json", {**cost, "seconds": 30.0, "peak_rss_gb": 2.0, "device": "cpu"})
    (run / "deformation" / "stamp.json").touch()
    for name in ("canonical", "deformation"):
        (run / name / "model.safetensors").write_bytes(b"x" * 500_000)
    clock = {"std_s": 0.0, "method": "audio", "confidence": 1.0}
    found = {"cam0": (0.0, 0.0), "cam1": (0.1004, 0.0), "witness": (-0.2, 0.0)}
    clocks = {n: {"offset_s": a, "drift_ppm": b, **clock} for n, (a, b) in found.items()}
    _json(run / "sync/sync.json", {"cameras": clocks})
    times = [{"index": n, "time_s": 0.5 * n} for n in range(5)]
    _json(run / "ingest/ingest.json", {"cameras": {name: {"frames": times} for name in found}})
    true_clocks = {"cam0": (0.0, 0.0), "cam1": (0.1, 0.0), "witness": (-0.2, 0.0)}
    truth = {
        "static": [c.world_from_cam.tolist() for c in sweep],
        "cams": {
            n: {"pose": c.world_from_cam.tolist(), "offset_s": true_clocks[n][0], "drift_ppm": 0}
            for n, c in fixed.items()
        },
    }
    _json(tmp_path / "ground_truth.json", truth)
    config = SceneConfig.model_validate(
        {"name": "x", "preset": "tiny", "capture": {"static": "s.mp4", "cameras": {"cam0": "c.mp4"}}}
    )
    return StageContext(config, tmp_path, run, run / "evaluate", no_progress, "cpu")


def _json(path: Path, value: dict) -> None:
    path.write_text(json.dumps(value))


def _known(moves: bool = True) -> Callable:
    def render(camera: Camera, time: float | None) -> np.ndarray:
        picture = _picture(time if moves else None) + np.float32(0.01)
        return cv2.resize(picture, (camera.width, camera.height))

    return lambda run_dir, device: render


def _run(
    context: StageContext,
    monkeypatch,
    moves: bool = True,
    unseen_share: float = 0.2,
    asked: Callable | None = None,
    unshaded: Callable | None = None,
) -> dict:
    render = _known(moves)(context.run_dir, "cpu")
    seen_by = [{"cameras": 0, "share": unseen_share}, {"cameras": 1, "share": 1 - unseen_share}]
    shares = {"moves": True, "unseen_share": unseen_share, "seen_by": seen_by}
    model = SimpleNamespace(unshaded=lambda: unshaded and unshaded(render))
    monkeypatch.setattr(evaluate, "load_model", lambda run_dir, device: model)
    monkeypatch.setattr(evaluate, "partial", lambda view, asked: render if asked is model else asked)
    monkeypatch.setattr(evaluate, "subject_seen", asked or (lambda scene, model: shares))
    evaluate.run(context)
    return json.loads((context.out / "metrics.json").read_text())


def test_what_shading_has_to_do_with_it(context: StageContext, monkeypatch):
    """The known model is 0.01 off where it moves; in constant light it is 0.05 darker."""
    assert _run(context, monkeypatch)["shading"] == {"psnr": None, "unshaded_psnr": None, "views": 0}
    shares = _run(context, monkeypatch, unshaded=lambda render: lambda *at: render(*at) - 0.05)["shading"]
    assert shares["views"] > 0 and shares["psnr"] == pytest.approx(40, abs=1.5)
    assert shares["unshaded_psnr"] == pytest.approx(-20 * np.log10(0.04), abs=2.5)


def test_every_block_of_the_contract(context: StageContext, monkeypatch):
    metrics = _run(context, monkeypatch)
    assert metrics["test"]["psnr"] == pytest.approx(40, abs=1.5)  # 8-bit pictures: 0.01 off to within 0.002
    assert metrics["test_moving"]["psnr"] > metrics["static_baseline"]["test_moving"]["psnr"] + 10
    assert metrics["test_static"]["views"] == 3
    assert metrics["train"] == {
        "canonical_s": 10.0,
        "deformation_s": 30.0,
        "total_s": 40.0,
        "iterations": 200,
        "rays_per_s": 250.0,
        "peak_gpu_gb": None,
        "peak_rss_gb": 2.0,
        "device": "cpu",
    }
    assert metrics["model_mb"] == 1.0 and metrics["seed"] == 0 and "torch" in metrics["versions"]
    truth = metrics["truth"]
    assert truth["pose_rotation_deg"] == pytest.approx(0, abs=1e-4)
    assert truth["rig_position_percent"] == pytest.approx(0, abs=1e-4)
    assert truth["sync_ms"] == pytest.approx(0.4, abs=1e-6) and truth["scale"] == pytest.approx(0.5)
    assert all(row.verdict == "ok" for row in context.health)


def test_motion_that_explains_nothing_is_told(context: StageContext, monkeypatch):
    _run(context, monkeypatch, moves=False)
    doubtful = [row for row in context.health if row.verdict != "ok"]
    assert any(row.code == "views-gain" and "capture.rest" in row.remedy for row in doubtful)


def test_confidence_is_kept_and_judged(context: StageContext, monkeypatch):
    metrics = _run(context, monkeypatch, unseen_share=0.6)
    assert metrics["confidence"]["seen_by"][0] == {"cameras": 0, "share": 0.6}
    row = next(row for row in context.health if row.code == "surface-unseen")
    assert row.verdict == "warn" and row.value == 60


def test_confidence_takes_the_times_that_were_trained_with(context: StageContext, monkeypatch):
    """A camera's clock that training moved by a quarter of the scene's two seconds."""
    path, seen = context.run_dir / "deformation/metrics.json", {}
    _json(path, {**json.loads(path.read_text()), "clock_offsets_s": {"cam1": 0.5}})

    def asked(scene: Scene, model: object) -> dict:
        for frame in scene.dynamic:
            seen.setdefault(frame.camera_name, []).append(frame.time)
        return {"moves": False, "unseen_share": None, "seen_by": [{"cameras": 3, "share": 1.0}]}

    _run(context, monkeypatch, asked=asked)
    assert not any(row.code == "surface-unseen" for row in context.health)
    assert seen["cam1"] == [0.25, 0.75]  # the last one is beyond the motion
    assert seen["cam0"] == seen["witness"] == list(TIMES)


@pytest.mark.parametrize(
    ("moved_s", "off_ms"),
    [
        # cam1's clock is ahead of the truth by 0.4 ms; the others are right.
        ({"cam1": -0.0004}, 0.0),
        ({"cam1": 0.002}, 2.4),
        # All times are those of the first camera's clock.
        ({"cam0": 0.003}, 3.0),
        ({"cam0": 0.0004, "cam1": 0.0}, 0.4),
    ],
)
def test_clocks_that_training_moved_are_held_against_the_truth(
    context: StageContext, moved_s: dict[str, float], off_ms: float
):
    path = context.run_dir / "deformation/metrics.json"
    _json(path, {**json.loads(path.read_text()), "clock_offsets_s": moved_s})
    truth = read_truth(context.scene_dir / "ground_truth.json")
    found = evaluate.compare(truth, read_scene(context.run_dir / "scene"), context.run_dir)
    assert found["sync_ms"] == pytest.approx(off_ms, abs=1e-6)


def test_a_box_without_anything_solid_is_told():
    (row,) = judge(evaluate.surface_seen({"moves": False, "unseen_share": None, "seen_by": []}))
    assert row.verdict == "warn" and isinstance(row.value, str)


def test_a_test_camera_without_a_place_is_named(tmp_path: Path) -> None:
    capture = {"static": "static.mp4", "cameras": {"cam0": "cam0.mp4"}, "test_cameras": {"witness": "w.mp4"}}
    config = SceneConfig.model_validate({"name": "room", "output": "run", "capture": capture})
    assert evaluate.why_no_test_views(config, tmp_path).startswith("test camera witness: it takes no picture")
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / "rig.json").write_text(json.dumps({"left_out": {"witness": "shares no view"}}))
    assert evaluate.why_no_test_views(config, tmp_path) == "test camera witness: shares no view"
    plain = SceneConfig.model_validate({"name": "room", "output": "run", "capture": {"static": "static.mp4"}})
    assert evaluate.why_no_test_views(plain, tmp_path).startswith("no test camera")


def test_no_truth_no_block(context: StageContext, monkeypatch):
    (context.scene_dir / "ground_truth.json").unlink()
    assert "truth" not in _run(context, monkeypatch)
