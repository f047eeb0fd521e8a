"""The flow stage through its entry point: what it computes, stores and says of a small scene."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.judged import named
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.formats import read_scene, write_scene
from devrf.capture.scene import PosedFrame
from devrf.capture.system.progress import no_progress
from devrf.flow.dis import DisFlow
from devrf.flow.store import read_flows
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import flow

STEP = 4  # pixels to the right per frame


@pytest.fixture
def context(tmp_path) -> StageContext:
    """Two training cameras and a witness see a textured picture slide; cam1 lost the frame at 0.3 s."""
    rng = np.random.default_rng(0)
    wide = cv2.resize(rng.integers(20, 235, (16, 40, 3)).astype(np.uint8), (200, 80))
    camera = Camera(128, 80, np.array([[90.0, 0, 64], [0, 90, 40], [0, 0, 1]]), np.eye(4)[:3])
    frames = []
    for name in ("cam0", "cam1", "witness"):
        for n in range(5):
            if name == "cam1" and n == 3:
                continue
            path = tmp_path / f"{name}{n}.png"
            cv2.imwrite(str(path), wide[:, 60 - STEP * n : 188 - STEP * n])
            split = "test" if name == "witness" else "train"
            frames.append(PosedFrame(path, camera, name, 10 + n, 0.1 * n, n / 4, split))
    # The order in the file is not the order in time.
    scene = scene_of((), frames[::-1], far=3.0, t1_s=0.4, rest_time=None, image_scale=0.5)
    for folder in ("scene", "flow"):
        (tmp_path / folder).mkdir()
    write_scene(tmp_path / "scene", scene)
    config = SceneConfig.model_validate({"name": "x", "dataset": {"format": "nerfstudio", "path": "x"}})
    return StageContext(config, tmp_path, tmp_path, tmp_path / "flow", no_progress, "cpu")


def test_training_cameras_only_backward_and_scaled(context: StageContext):
    flow.run(context)
    flows = read_flows(context.out)
    assert flows.keys() == {"cam0", "cam1"}
    assert flows["cam0"].index.tolist() == [11, 12, 13, 14] and flows["cam0"].flow.shape == (4, 40, 64, 2)
    inner = flows["cam0"].flow[:, 8:-8, 8:-8].astype(np.float32)
    np.testing.assert_allclose(np.median(inner, axis=(0, 1, 2)), [-STEP / 2, 0], atol=0.05)
    checks = json.loads((Path(context.out) / "flow.json").read_text())
    assert checks["method"] == "dis" and checks["cameras"]["cam0"]["pairs"] == 4
    assert not (context.run_dir / ".flow").exists()


def test_the_gap_is_found_and_told(context: StageContext):
    flow.run(context)
    cam1 = read_flows(context.out)["cam1"]
    assert cam1.index.tolist() == [11, 12, 14]
    assert cam1.valid[:2].any(axis=(1, 2)).all() and not cam1.valid[2].any()
    gaps = named(context.health)["frames-dropped cam1"]
    assert gaps.verdict == "warn" and str(gaps.value).startswith("1 gaps")
    slides = next(row for row in context.health if row.code == "flow-shake")
    assert slides.value == pytest.approx(STEP, abs=0.1)  # the cameras are fixed and all they see moves
    assert all(row.verdict == "ok" for row in context.health if row not in (gaps, slides))


def given(context: StageContext, scale: float = 1.0) -> None:
    """Let every frame but the first bring true flow of `scale` times the picture's size, and say so."""
    scene = read_scene(context.run_dir / "scene")
    out = []
    for frame in scene.dynamic:
        path = context.run_dir / "given" / f"{frame.camera_name}_{frame.index}.npz"
        shape = (round(80 * scale), round(128 * scale))
        flow = np.zeros((*shape, 2), np.float32) + np.array([-STEP * scale, 0], np.float32)
        mask = np.ones(shape, bool)
        mask[: shape[0] // 4] = False
        if frame.index > 10:
            path.parent.mkdir(exist_ok=True)
            np.savez_compressed(path, flow=flow, mask=mask)
        out.append(replace(frame, flow=path if frame.index > 10 else None))
    write_scene(context.run_dir / "scene", replace(scene, dynamic=tuple(out)))


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_flow_of_the_data_set_is_used(context: StageContext, scale: float):
    given(context, scale)
    flow.run(context)
    checks = json.loads((Path(context.out) / "flow.json").read_text())
    assert checks["method"] == "given" and checks["cameras"]["cam0"]["warp_ratio"] < 0.5
    cam0 = read_flows(context.out)["cam0"]
    assert cam0.index.tolist() == [11, 12, 13, 14] and cam0.flow.shape == (4, 40, 64, 2)
    assert not cam0.valid[:, :10].any() and cam0.valid[:, 10:].all()
    np.testing.assert_array_equal(cam0.flow[:, 12:], np.broadcast_to([-STEP / 2, 0], (4, 28, 64, 2)))
    assert "given" in str(named(context.health)["noted flow"].value)


def test_flow_is_computed_where_the_data_set_does_not_bring_all(context: StageContext):
    given(context)
    scene = read_scene(context.run_dir / "scene")
    some = tuple(replace(f, flow=None) if f.camera_name == "cam1" else f for f in scene.dynamic)
    write_scene(context.run_dir / "scene", replace(scene, dynamic=some))
    flow.run(context)
    assert json.loads((Path(context.out) / "flow.json").read_text())["method"] == "dis"


def test_mixed_up_frames_fail_the_checks(context: StageContext):
    rng = np.random.default_rng(1)
    for n in range(5):  # cam0's pictures have nothing to do with each other
        cv2.imwrite(
            str(context.run_dir / f"cam0{n}.png"), rng.integers(0, 255, (80, 128, 3)).astype(np.uint8)
        )
    flow.run(context)
    failed = [row for row in context.health if row.verdict != "ok" and row.about == "cam0"]
    assert {"flow-consistent", "flow-warping"} <= {row.code for row in failed} and all(
        row.remedy for row in failed
    )


def test_flow_of_a_first_frame_is_ignored_and_said(context: StageContext):
    given(context)
    scene = read_scene(context.run_dir / "scene")
    first = [replace(f, flow=scene.dynamic[0].flow) if f.index == 10 else f for f in scene.dynamic]
    write_scene(context.run_dir / "scene", replace(scene, dynamic=tuple(first)))
    flow.run(context)
    assert read_flows(context.out)["cam0"].index.tolist() == [11, 12, 13, 14]
    assert str(named(context.health)["noted flow"].value).endswith(": cam1, cam0")


class Counted(DisFlow):
    """DIS that is interrupted after some pairs (each is asked for two ways)."""

    parallel = False

    def __init__(self, most: int) -> None:
        super().__init__()
        self.most, self.asked = most, 0

    def estimate(self, image0, image1):
        if self.asked == self.most:
            raise KeyboardInterrupt
        self.asked += 1
        return super().estimate(image0, image1)


def test_a_run_that_was_stopped_finds_only_missing_pairs(context: StageContext, monkeypatch):
    def use(estimator: Counted) -> Counted:
        monkeypatch.setattr(flow, "flow_estimator", lambda *of: estimator)
        return estimator

    use(Counted(2 * 5))  # cam1 comes first in the file: its two pairs and a gap, then three of cam0's four
    with pytest.raises(KeyboardInterrupt):
        flow.run(context)
    assert len(list((context.run_dir / ".flow").rglob("*.npz"))) == 6
    assert not list(context.out.iterdir())
    rest = use(Counted(1000))
    flow.run(context)
    assert rest.asked == 2 * 1
    assert {name: len(clip.index) for name, clip in read_flows(context.out).items()} == {"cam0": 4, "cam1": 3}


def test_pairs_of_another_method_are_not_taken_over(context: StageContext, monkeypatch):
    monkeypatch.setattr(flow, "flow_estimator", lambda *of: Counted(2 * 3))
    with pytest.raises(KeyboardInterrupt):
        flow.run(context)
    config = context.config.model_copy(
        update={"flow": context.config.flow.model_copy(update={"method": "raft"})}
    )
    fresh = Counted(1000)
    monkeypatch.setattr(flow, "flow_estimator", lambda *of: fresh)
    made_from = {"config": {"flow.method": "raft"}}
    flow.run(replace(context, config=config, made_from=made_from))
    assert fresh.asked == 2 * 6  # all pairs of both cameras but the gap


def test_no_pair_crosses_from_one_camera_to_another(context: StageContext, monkeypatch):
    """Frames of both cameras are of one time each; every pair must be of one camera's pictures."""
    scene = read_scene(context.run_dir / "scene")
    shade = {"cam0": 60, "cam1": 200, "witness": 0}
    for frame in scene.dynamic:
        cv2.imwrite(str(frame.path), np.full((80, 128, 3), shade[frame.camera_name] + frame.index, np.uint8))
    seen = []

    class Watched(Counted):
        def estimate(self, image0, image1):
            seen.append((int(image0[0, 0, 0]), int(image1[0, 0, 0])))
            return super().estimate(image0, image1)

    monkeypatch.setattr(flow, "flow_estimator", lambda *of: Watched(1000))
    flow.run(context)
    forth = seen[::2]  # the other half asks back
    assert forth == [(200 + n, 199 + n) for n in (11, 12)] + [(60 + n, 59 + n) for n in (11, 12, 13, 14)]


@pytest.mark.parametrize(("image_scale", "asked"), [(0.5, (80, 128)), (0.25, (60, 96)), (0.1, (24, 38))])
def test_flow_is_found_at_three_times_the_size_at_most(
    context: StageContext, monkeypatch, image_scale: float, asked: tuple[int, int]
):
    folder = context.run_dir / "scene"
    write_scene(folder, replace(read_scene(folder), image_scale=image_scale))
    shapes = set()

    class Watched(Counted):
        def estimate(self, image0, image1):
            shapes.add(image0.shape[:2])
            return super().estimate(image0, image1)

    monkeypatch.setattr(flow, "flow_estimator", lambda *of: Watched(1000))
    flow.run(context)
    assert shapes == {asked}
    stored = read_flows(context.out)["cam0"].flow
    assert stored.shape[1:3] == (round(80 * image_scale), round(128 * image_scale))
    inner = stored[:, 2:-2, 2:-2].astype(np.float32)
    np.testing.assert_allclose(np.median(inner, axis=(0, 1, 2)), [-STEP * image_scale, 0], atol=0.05)
