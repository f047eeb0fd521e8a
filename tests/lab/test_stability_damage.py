"""Damage to a scene does what it says to what it names, and nothing else."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, read_rig, write_rig
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.colour.srgb import linear_from_srgb
from devrf.capture.formats.parts.scene_files import read_scene, write_scene
from devrf.capture.frames import CameraFrames, FrameRecord, FrameSet
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import no_progress
from devrf.capture.video.reader import VideoReader
from devrf.flow.store import read_pair, write_pair
from devrf.lab.bench.stability.damage import between, configuration, raw_files
from devrf.lab.bench.stability.damage.intact import Damage, DoesNotApply, Intact
from devrf.lab.bench.stability.suite import Extent, run_stability
from devrf.lab.simulate.render.sensor import ClipWriter
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import STAGES, canonical, deformation
from devrf.pipelines.terminal.console import Talk

CLOCK = {"offset_s": 0.5, "drift_ppm": 3.0}

# --- damage before the run ---

CAPTURE = """
name: sheet
preset: tiny
capture: {static: static.mp4, cameras: {cam0: a.mp4, cam1: b.mp4, cam2: c.mp4}, test_cameras: [cam1]}
"""


@pytest.fixture
def intact(tmp_path: Path, odd_scene: Scene) -> Intact:
    (tmp_path / "scene.yaml").write_text(CAPTURE)
    config = load_scene(tmp_path / "scene.yaml", check_files=False)
    return Intact(config, tmp_path, odd_scene, tmp_path, 1.0, 0)


def test_cameras_are_left_out_but_never_the_test_cameras(intact: Intact) -> None:
    assert intact.cameras == ("cam0", "cam1")  # of the scene
    config = configuration.fewer_cameras(_severe(intact, 1.0)).config
    assert config.capture is not None and list(config.capture.cameras) == ["cam0", "cam1"]
    with refused("cameras-too-few", " 2 ", kind=DoesNotApply):
        configuration.fewer_cameras(_severe(intact, 2.0))


def test_trainings_get_other_rates_and_another_seed(intact: Intact) -> None:
    usual = training_options(intact.config, intact.scene)
    faster = configuration.learning_rate(_severe(intact, 10.0))
    with faster.trained_otherwise("canonical"), faster.trained_otherwise("deformation"):
        rest = canonical.training_options(faster.config, intact.scene).canonical
        motion = deformation.training_options(faster.config, intact.scene).motion
    assert rest == replace(usual.canonical, learning_rate=10.0)
    assert motion == replace(usual.motion, learning_rate=10.0)
    assert canonical.training_options is deformation.training_options is training_options
    seeds = {configuration.other_seed(_severe(intact, n)).config.reconstruct.seed for n in (1.0, 2.0)}
    assert len(seeds) == 2 and 0 not in seeds


def test_a_sweep_of_photos_is_not_blurred(intact: Intact) -> None:
    (intact.scene_dir / "static.mp4").mkdir()
    with refused("sweep-is-photos", kind=DoesNotApply):
        raw_files.blurred_sweep(intact)


def _severe(intact: Intact, severity: float) -> Intact:
    return replace(intact, severity=severity)


def test_a_thinner_sweep_has_a_thinner_truth_and_is_written_once(intact: Intact) -> None:
    clip = ClipWriter(intact.scene_dir / "static.mp4", (32, 16), 10.0, 17)
    for n in range(7):
        clip.picture(np.full((16, 32, 3), 30 * n, np.uint8), n / 10)
    clip.close()
    (intact.scene_dir / "ground_truth.json").write_text(json.dumps({"static": list(range(7)), "cams": {}}))
    (intact.scene_dir / "witness_mask.npz").write_bytes(b"what moves")
    folder = intact.folder / "case"
    folder.mkdir()
    spoilt = replace(intact, folder=folder, severity=3.0)
    config = raw_files.fewer_sweep_pictures(spoilt).config
    assert config.capture is not None and config.capture.static is not None
    written = Path(config.capture.static)
    before, made = written.read_bytes(), written.stat().st_mtime_ns
    with VideoReader(written) as reader:
        assert [round(frame.time_s, 3) for frame in reader] == [0.0, 0.3, 0.6]
    truth = config.truth_path(intact.scene_dir)
    assert truth is not None and json.loads(truth.read_text()) == {"static": [0, 3, 6], "cams": {}}
    # measured as in the undisturbed scene
    assert truth.with_name("witness_mask.npz").read_bytes() == b"what moves"
    raw_files.fewer_sweep_pictures(spoilt)
    assert written.stat().st_mtime_ns == made
    raw_files.fewer_sweep_pictures(replace(spoilt, severity=2.0))
    assert written.read_bytes() != before
    # another sweep, in which it leaves two of three pictures
    (intact.scene_dir / "static.mp4").write_bytes(before)
    raw_files.fewer_sweep_pictures(replace(spoilt, severity=2.0))
    with VideoReader(written) as reader:
        assert [round(frame.time_s, 3) for frame in reader] == [0.0, 0.6]
    written.unlink()
    raw_files.fewer_sweep_pictures(replace(spoilt, severity=2.0))
    assert written.is_file()


@pytest.fixture
def filmed(intact: Intact) -> Intact:
    """The same with clips of eleven grey pictures; what is written anew goes into a folder of its own."""
    for name in ("a", "b", "c"):
        clip = ClipWriter(intact.scene_dir / f"{name}.mp4", (32, 16), 10.0, 17)
        for n in range(11):
            clip.picture(np.full((16, 32, 3), 128, np.uint8), n / 10)
        clip.close()
    folder = intact.folder / "case"
    folder.mkdir()
    return replace(intact, folder=folder)


def _shown(done: Damage, camera: str) -> list[tuple[float, np.ndarray]]:
    """Times and mean colours of a camera's pictures."""
    assert done.config.capture is not None
    with VideoReader(Path(done.config.capture.cameras[camera])) as reader:
        return [(round(frame.time_s, 3), frame.rgb.mean((0, 1)) / 255) for frame in reader]


def test_frames_are_lost_of_the_last_training_camera_or_evenly_of_all(filmed: Intact) -> None:
    dropped = raw_files.dropped_frames(_severe(filmed, 40.0))
    assert dropped.config.capture is not None and dropped.config.capture.cameras["cam0"] == "a.mp4"
    times = [time_s for time_s, _ in _shown(dropped, "cam1")]
    assert len(times) == 11 - 4 and (times[0], times[-1]) == (0.0, 1.0)
    slower = raw_files.lower_frame_rate(_severe(filmed, 4.0))
    assert slower.config.capture is not None and slower.config.capture.cameras["cam2"] == "c.mp4"
    for name in filmed.cameras:
        assert [time_s for time_s, _ in _shown(slower, name)] == [0.0, 0.4, 0.8]


def test_a_data_set_loses_frames_too_and_the_flow_that_led_to_them(filmed: Intact, tmp_path: Path) -> None:
    brought = replace(filmed.scene, dynamic=tuple(replace(f, flow=f.path) for f in filmed.scene.dynamic))
    write_scene(tmp_path / "scene", brought)
    data_set = replace(filmed, config=filmed.config.model_copy(update={"capture": None}), scene=brought)
    raw_files.lower_frame_rate(_severe(data_set, 2.0)).behind(_context(filmed, tmp_path / "scene"))
    left = read_scene(tmp_path / "scene").dynamic
    assert [f.index for f in left if f.camera_name == "cam0"] == [0, 2, 4]
    assert [f.index for f in left if f.camera_name == "witness"] == [0, 1, 2, 3, 4]
    assert all((f.flow is None) == (f.split == "train") for f in left)


def test_exposure_and_white_balance_drift_the_other_way_in_every_other_camera(filmed: Intact) -> None:
    for damaging, of_cam1 in (
        (raw_files.drifting_exposure, (1.0, 1.0, 1.0)),
        (raw_files.drifting_white_balance, (1.0, 0.0, -1.0)),
    ):
        folder = filmed.folder / damaging.__name__
        folder.mkdir()
        done = damaging(replace(filmed, folder=folder, severity=1.0))
        for name, sign in (("cam0", -1), ("cam1", 1)):
            first, middle, last = (linear_from_srgb(_shown(done, name)[n][1]) for n in (0, 5, 10))
            stops = sign * np.array(of_cam1)
            np.testing.assert_allclose(np.log2(middle / first), stops / 2, atol=0.06)
            np.testing.assert_allclose(np.log2(last / first), stops, atol=0.06)


# --- damage behind a stage ---


def test_the_rig_is_damaged_but_not_its_test_camera(intact: Intact, tmp_path: Path) -> None:
    cameras = {f.camera_name: f.camera for f in intact.scene.dynamic}
    right = Rig({name: RigCamera(camera, "self") for name, camera in cameras.items()}, ARBITRARY)
    for damaging, severity in ((between.turned_cameras, 2.0), (between.wrong_focal_lengths, 10.0)):
        write_rig(tmp_path / "rig.json", right)
        done = damaging(_severe(intact, severity))
        assert done.stage == "rig"
        done.behind(_context(intact, tmp_path))
        wrong = read_rig(tmp_path / "rig.json").cameras
        assert np.array_equal(wrong["witness"].camera.cam_from_world, cameras["witness"].cam_from_world)
        for name in intact.cameras:
            turn = rotation_angle_deg(
                wrong[name].camera.cam_from_world[:, :3], cameras[name].cam_from_world[:, :3]
            )
            zoom = wrong[name].camera.K[0, 0] / cameras[name].K[0, 0]
            assert (turn, zoom) == pytest.approx((2.0, 1.0) if severity == 2.0 else (0.0, 1.1), abs=1e-4)


@pytest.fixture
def clocks(intact: Intact, tmp_path: Path) -> Callable[[Damage], dict]:
    """What a damage makes of two equal clocks, whose cameras have five frames from 0.2 s on at 20 a second."""

    def damaged(done: Damage) -> dict:
        frames = tuple(FrameRecord(n, 0.2 + n / 20, 100.0, True, None) for n in range(5))
        clip = CameraFrames("camera", "b.mp4", 80, 56, 20.0, False, False, None, 0, frames)
        (tmp_path / "ingest").mkdir()
        FrameSet({"cam0": clip, "cam1": clip}).write(tmp_path / "ingest")
        (tmp_path / "sync.json").write_text(json.dumps({"cameras": {"cam0": CLOCK, "cam1": CLOCK}}))
        assert done.stage == "sync"
        done.behind(_context(intact, tmp_path))
        return json.loads((tmp_path / "sync.json").read_text())["cameras"]

    return damaged


def test_the_last_training_cameras_clock_is_late_by_frames(
    intact: Intact, clocks: Callable[[Damage], dict]
) -> None:
    found = clocks(between.late_clock(_severe(intact, 2.0)))
    assert found == {"cam0": CLOCK, "cam1": CLOCK | {"offset_s": pytest.approx(0.6)}}


def test_a_clock_that_drifts_is_right_at_its_first_frame(
    intact: Intact, clocks: Callable[[Damage], dict]
) -> None:
    found = clocks(between.drifting_clock(_severe(intact, 2.0)))
    assert found["cam0"] == CLOCK

    def time_s(clock: dict, file_time_s: float) -> float:
        return clock["offset_s"] + (1 + 1e-6 * clock["drift_ppm"]) * file_time_s

    late_s = [time_s(found["cam1"], t) - time_s(CLOCK, t) for t in (0.2, 0.3, 0.4)]
    assert late_s == pytest.approx([0.0, 0.05, 0.1])  # two frames at the last


def test_a_data_sets_clock_is_late_too(tmp_path: Path, odd_scene: Scene) -> None:
    (tmp_path / "scene.yaml").write_text("name: set\ndataset: {format: devrf, path: set}\n")
    intact = Intact(
        load_scene(tmp_path / "scene.yaml", check_files=False), tmp_path, odd_scene, tmp_path, 2.0, 0
    )
    before = {f.index: f.time_s or 0.0 for f in odd_scene.dynamic if f.camera_name == "cam1"}

    def late_s(done: Damage) -> dict[int, float]:
        assert done.stage == "scene"
        write_scene(tmp_path, odd_scene)
        done.behind(_context(intact, tmp_path))
        found = read_scene(tmp_path)
        others = [[f for f in of.dynamic if f.camera_name != "cam1"] for of in (found, odd_scene)]
        assert [(f.time_s, f.time) for f in others[0]] == [(f.time_s, f.time) for f in others[1]]
        cam1 = [f for f in found.dynamic if f.camera_name == "cam1"]
        for frame in cam1:
            assert frame.time_s is not None and frame.time is not None and frame.time <= 1
            assert frame.time == pytest.approx((frame.time_s - found.t0_s) / (found.t1_s - found.t0_s))
        return {f.index: (f.time_s or 0.0) - before[f.index] for f in cam1}

    assert late_s(between.late_clock(intact)) == pytest.approx({0: 1.5, 1: 1.5})  # a frame takes 0.75 s
    drifting = late_s(between.drifting_clock(_severe(intact, 1.0)))
    assert (
        list(drifting) == [0, 1, 2] and drifting[0] == pytest.approx(0.0) and drifting[2] > 1.9 * drifting[1]
    )


def test_flow_is_zeroed_and_made_noisy_only_where_it_is_trusted(intact: Intact, tmp_path: Path) -> None:
    flow = np.full((40, 50, 2), 3.0, np.float32)
    trusted = np.zeros((40, 50), np.uint8)
    trusted[:, :40] = 9
    for damaging, severity in ((between.zeroed_flow, 50.0), (between.noisy_flow, 4.0)):
        for n in range(4):
            write_pair(tmp_path / f"flow/cam0/{n:06d}.npz", flow, trusted, {})
        done = damaging(_severe(intact, severity))
        assert done.stage == "flow"
        done.behind(_context(intact, tmp_path / "flow"))
        found = [read_pair(path) for path in sorted((tmp_path / "flow").glob("*/*.npz"))]
        assert all((confidence == trusted).all() for _, confidence in found)
        vectors = np.stack([f[:, :40].astype(float) for f, _ in found])
        if damaging is between.zeroed_flow:
            assert sorted(vectors.mean((1, 2, 3))) == [0, 0, 3, 3]
        else:
            assert (vectors - 3).std() == pytest.approx(0.04 * 50, rel=0.05)


def test_mattes_get_holes_in_training_pictures_alone(intact: Intact, tmp_path: Path) -> None:
    with refused("pictures-without-alpha", kind=DoesNotApply):
        between.mattes_with_holes(intact)
    for frame in intact.scene.frames:
        picture = np.full((frame.camera.height, frame.camera.width, 4), 90, np.uint8)
        picture[..., 3] = 0
        picture[10:40, 10:50, 3] = 255
        write_png(frame.path, picture)
    write_scene(tmp_path / "scene", intact.scene)
    between.mattes_with_holes(_severe(intact, 20.0)).behind(_context(intact, tmp_path / "scene"))
    spoilt = read_scene(tmp_path / "scene")
    for before, after in zip(intact.scene.frames, spoilt.frames, strict=True):
        alpha, had = (read_pixels(frame.path)[..., 3] for frame in (after, before))
        lost = 1 - (alpha > 0).sum() / (had > 0).sum()
        assert lost == 0 if before.split == "test" else 0.199 < lost < 0.35
        assert not alpha[had == 0].any()


def _context(intact: Intact, folder: Path) -> StageContext:
    return StageContext(intact.config, intact.scene_dir, folder, folder, no_progress, "cpu")


def test_a_scene_without_test_camera_is_refused_before_anything_runs(intact: Intact, tmp_path: Path) -> None:
    assert intact.capture is not None
    capture = intact.capture.model_copy(update={"test_cameras": ()})
    base = Run(
        intact.config.model_copy(update={"capture": capture}), tmp_path, STAGES, Choice(), Talk("quiet")
    )
    with refused("test-camera-missing", "capture.test_cameras", kind=InputError):
        run_stability(base, tmp_path / "o", ["seeds"], Extent(1, [0]), tmp_path / "o/s.json")
    assert not (tmp_path / "o").exists()
