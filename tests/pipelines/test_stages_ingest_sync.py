"""The stages `ingest` and `sync`: what they make of their findings."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.capture.test_projection import eyes, wide
from tests.conftest import Command
from tests.judged import judged, named
from tests.make.clips import film
from tests.refused import refused

from devrf.capture.frames import CameraFrames, FrameRecord, FrameSet
from devrf.capture.measure import Measure
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import no_progress
from devrf.capture.video.audio import Sound, write_wav
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import ingest, sync

RATE_HZ = 48_000


def frames(role: Any = "camera", count: int = 60, start_s: float = 0.0, **more: Any) -> CameraFrames:
    records = tuple(FrameRecord(i, start_s + i / 30, 10.0, True, f"{i}.png") for i in range(count))
    values: dict[str, Any] = {
        "role": role, "source": "clip.mp4", "width": 64, "height": 48, "fps_mean": 30.0,
        "variable_rate": False, "has_audio": True, "exif_focal_px": None, "rotation_deg": 0,
        "frames": records, "level": 120.0,
    }  # fmt: skip
    return CameraFrames(**{**values, **more})


def sound(offset_s: float, seconds: float = 4.0) -> Sound:
    """Noise bursts at true times 0.9, 1.3 and 2.2 s as heard by a clock that is late by `offset_s`."""
    rng = np.random.default_rng(0)
    samples = 0.003 * np.random.default_rng(int(1e3 * (offset_s + 5))).normal(size=int(seconds * RATE_HZ))
    for time_s in (0.9, 1.3, 2.2):
        at = round((time_s - offset_s) * RATE_HZ)
        samples[at : at + 1000] += 0.3 * rng.normal(size=1000) * np.exp(-np.arange(1000) / 150)
    return Sound(samples.astype(np.float32), RATE_HZ, 0.0)


def context(tmp_path: Path, method: str = "auto") -> StageContext:
    config: Any = SimpleNamespace(
        calibration=SimpleNamespace(sync=SimpleNamespace(method=method, av_lag_s={}, readout_s={})),
        rest="start",
    )
    out = tmp_path / "sync"
    out.mkdir()
    return StageContext(config, tmp_path, tmp_path, out, no_progress, "cpu")


def write_ingest(tmp_path: Path, cameras: dict[str, CameraFrames], sounds: dict[str, Sound]) -> None:
    folder = tmp_path / "ingest"
    for name in ("audio", "motion", "brightness"):
        (folder / name).mkdir(parents=True)
    entries = {}
    for name, camera in cameras.items():
        heard = name in sounds
        if heard:
            write_wav(folder / "audio" / f"{name}.wav", sounds[name])
        entries[name] = replace(camera, has_audio=heard, audio_start_s=0.0 if heard else None)
        still = np.stack([np.arange(59) / 30, np.ones(59)], 1)
        np.save(folder / "motion" / f"{name}.npy", still)
        lit = np.column_stack([np.arange(60) / 30, np.full((60, 24), 120.0)])
        np.save(folder / "brightness" / f"{name}.npy", lit)
    FrameSet(entries).write(folder)


def verdicts(rows: list[HealthRow]) -> dict[str, str]:
    return {name: row.verdict for name, row in named(rows).items()}


def test_sync_writes_clocks_curves_and_health(tmp_path):
    cameras = {"cam0": frames(), "cam1": frames(), "witness": frames("test")}
    offsets = {"cam0": 0.0, "cam1": 0.25, "witness": -0.125}
    write_ingest(tmp_path, cameras, {n: sound(o) for n, o in offsets.items()})
    stage = context(tmp_path)
    sync.run(stage)
    written = json.loads((tmp_path / "sync" / "sync.json").read_text())
    assert list(written["cameras"]) == ["cam0", "cam1", "witness"] and written["reference"] == "cam0"
    for name, offset_s in offsets.items():
        clock = written["cameras"][name]
        assert clock["offset_s"] == pytest.approx(offset_s, abs=1e-4) and clock["drift_ppm"] == 0
    assert written["shared_s"] == pytest.approx([0.25, 59 / 30], abs=1e-3)  # test cameras do not count
    curves = json.loads((tmp_path / "sync" / "curves.json").read_text())
    assert {(c["first"], c["second"]) for c in curves["curves"]} == {("cam0", "cam1")}
    of_test = curves["tests"]["witness"]["curves"]
    assert {(c["first"], c["second"]) for c in of_test} == {("cam0", "witness"), ("cam1", "witness")}
    assert set(verdicts(stage.health).values()) == {"ok"}


def test_a_test_camera_refuses_nothing(tmp_path):
    """It is silent, nothing moves in it, and it films when nobody else does."""
    cameras = {"cam0": frames(), "cam1": frames(), "witness": frames("test", start_s=9.0)}
    write_ingest(tmp_path, cameras, {n: sound(o) for n, o in {"cam0": 0.0, "cam1": 0.25}.items()})
    stage = context(tmp_path)
    sync.run(stage)
    rows = verdicts(stage.health)
    assert set(rows.values()) == {"ok", "warn"}
    assert all("witness" in check for check, verdict in rows.items() if verdict == "warn")
    assert rows["camera-left-out witness"] == "warn"
    clock = json.loads((tmp_path / "sync" / "sync.json").read_text())["cameras"]["witness"]
    assert clock["std_s"] is None


def test_clips_that_do_not_overlap_fail(tmp_path):
    cameras = {"cam0": frames(count=20), "cam1": frames(count=20, start_s=1.5)}
    write_ingest(tmp_path, cameras, {n: sound(0.0 if n == "cam0" else 0.001) for n in cameras})
    stage = context(tmp_path)
    sync.run(stage)
    row = named(stage.health)["cameras-apart"]
    assert row.verdict == "fail" and "cam1: 1.50 to 2.13 s" in row.remedy


def test_a_silent_camera_in_which_nothing_moves_fails(tmp_path):
    write_ingest(tmp_path, {"cam0": frames(), "cam1": frames()}, {"cam0": sound(0.0)})
    stage = context(tmp_path)
    sync.run(stage)
    row = named(stage.health)["clock-unknown cam1"]
    assert row.verdict == "fail"
    assert "camera cam1: no sound" in row.remedy
    assert json.loads((tmp_path / "sync" / "sync.json").read_text())["cameras"]["cam1"]["std_s"] is None


def test_a_silent_camera_refuses_nothing_where_others_are_enough(tmp_path):
    write_ingest(
        tmp_path, {n: frames() for n in ("cam0", "cam1", "cam2")}, {n: sound(0.0) for n in ("cam0", "cam1")}
    )
    stage = context(tmp_path)
    sync.run(stage)
    assert named(stage.health)["clock-unknown cam2"].verdict == "warn"


@pytest.mark.parametrize(("counts", "verdict"), [((60, 60, 1), "warn"), ((60, 1), "fail")])
def test_a_clip_of_one_picture_refuses_nothing_where_others_are_enough(counts, verdict):
    filmed = FrameSet({f"cam{n}": frames(count=count) for n, count in enumerate(counts)})
    assert named(judge(ingest.ingested(filmed)))[f"clip-short cam{len(counts) - 1}"].verdict == verdict


def test_own_clocks_are_taken_with_a_warning(tmp_path):
    write_ingest(tmp_path, {"cam0": frames(), "cam1": frames()}, {})
    stage = context(tmp_path, "none")
    sync.run(stage)
    assert verdicts(stage.health)["clock-unknown cam1"] == "warn"


def test_joint_clips_have_a_clock_of_their_own(tmp_path):
    cameras = {n: frames() for n in ("cam0", "cam1")} | {
        n: frames("joint") for n in ("joint_cam0", "joint_cam1")
    }
    offsets = {"cam0": 0.0, "cam1": 0.25, "joint_cam0": 0.0, "joint_cam1": -0.5}
    write_ingest(tmp_path, cameras, {n: sound(o) for n, o in offsets.items()})
    sync.run(context(tmp_path))
    written = json.loads((tmp_path / "sync" / "sync.json").read_text())
    assert list(written["cameras"]) == ["cam0", "cam1"]
    assert written["joint"]["cameras"]["joint_cam1"]["offset_s"] == pytest.approx(-0.5, abs=1e-4)


def test_range_in_each_cameras_own_time():
    sounds = {"cam0": sound(0.0), "cam1": sound(0.25)}
    session = CaptureSession(cameras={n: Path(n) for n in ("cam0", "cam1", "silent")}, range_s=(1.0, 2.0))
    ranges = ingest.file_ranges(session, sounds, "auto")
    assert ranges["cam0"] == (1.0, 2.0) and "silent" not in ranges
    margin = ingest.RANGE_MARGIN_S
    assert ranges["cam1"] == pytest.approx((0.75 - margin, 1.75 + margin), abs=1e-3)
    assert set(ingest.file_ranges(session, {}, "none").values()) == {(1.0, 2.0)}
    assert ingest.file_ranges(session, sounds, "motion") == {"cam0": (1.0, 2.0)}
    assert ingest.file_ranges(replace(session, range_s=None), sounds, "auto") == {}


def test_a_clip_with_a_damaged_end_is_used_if_most_of_it_is_there():
    whole = FrameSet({"cam0": frames(), "cam1": frames()})
    ingest.refuse_damaged(whole)
    cut = replace(whole.cameras["cam1"], ended_early="ends at frame 60 of 100", announced_frames=100)
    usable = FrameSet({**whole.cameras, "cam1": cut})
    ingest.refuse_damaged(usable)
    row = judged(ingest.ingested(usable))["not-used cam1"]
    assert row.verdict == "warn" and row.value == cut.ended_early and row.remedy
    for little in (replace(cut, announced_frames=130), replace(cut, frames=cut.frames[:9])):
        with refused("clip-too-damaged", f"cam1: {cut.source} {cut.ended_early}", kind=CaptureError):
            ingest.refuse_damaged(FrameSet({**whole.cameras, "cam1": little}))


def test_faults_of_clips_are_warnings_with_their_remedies():
    fault = Measure("coding", "0.010 bits per pixel", why="bits")
    row = judged(ingest.ingested(FrameSet({"cam0": frames(faults=(fault,)), "cam1": frames()})))[
        "coding cam0"
    ]
    assert (row.value, row.verdict) == (fault.value, "warn") and row.remedy.startswith("clip.mp4: ")


def test_health_of_a_good_and_of_a_bad_capture():
    sweep = frames("sweep", 60)
    good = FrameSet({"static": sweep, "cam0": frames(), "cam1": frames()})
    assert set(verdicts(judge(ingest.ingested(good))).values()) == {"ok"}
    blurred = tuple(
        replace(f, sharpness=1.0 if i % 3 == 0 else 10.0) for i, f in enumerate(sweep.frames[:12])
    )
    bad = FrameSet(
        {
            "static": replace(sweep, frames=blurred, notes=("mixed sizes: 9 photos of 4x3 ...",)),
            "cam0": frames(level=60.0, missing_frames=5, notes=("3 frames missing in 1 gaps, after 1.20 s",)),
            "cam1": frames(count=1, width=66, has_audio=False),
        }
    )
    found = judged(ingest.ingested(bad))
    for name, verdict in (
        ("sweep-few-pictures", "warn"),
        ("sweep-blurred", "warn"),
        ("not-used sweep", "warn"),
        ("clip-short cam1", "fail"),
        ("frames-dropped cam0", "warn"),
        ("exposure-differs cam1 against cam0", "warn"),
    ):
        assert found[name].verdict == verdict, (name, found)
    blurry = found["sweep-blurred"].remedy
    assert re.match(r"clip.mp4: 4 of 12 .*frame 0 \(0.00 s\), frame 3 \(0.10 s\)", blurry)
    assert "3 frames missing in 1 gaps, after 1.20 s" in found["frames-dropped cam0"].remedy


@pytest.mark.parametrize(("odd", "code"), [("cam0", 0), ("cam2", 0), ("cam1 cam2", 3)])
def test_a_camera_that_no_lens_made_is_left_out_where_others_are_enough(
    tmp_path: Path, devrf: Command, odd: str, code: int
) -> None:
    """Two eyes in one picture; also of the first camera, whose clock the others keep; a calibration places all."""
    poses = {}
    for n, name in enumerate(("cam0", "cam1", "cam2")):
        pictures = [(eyes if name in odd.split() else wide)(5 * n + k) for k in range(12)]
        film(tmp_path / f"{name}.mp4", pictures, rate=10)
        poses[name] = {"R": np.eye(3).tolist(), "T": [0.1 * n, 0.0, 2.0]}
    lens = {
        "model": "OPENCV",
        "image_size": [160, 80],
        "K": [[90, 0, 80], [0, 90, 40], [0, 0, 1]],
        "dist": [[0.0] * 5],
    }
    (tmp_path / "rig.json").write_text(
        json.dumps({"cameras": dict.fromkeys(poses, lens), "camera_poses": poses})
    )
    scene = {
        "name": "odd",
        "output": "run",
        "preset": "tiny",
        "capture": {"cameras": {n: f"{n}.mp4" for n in poses}},
    }
    scene["calibration"] = {"rig": {"given": "rig.json", "given_unit": "m"}, "sync": {"method": "none"}}
    (tmp_path / "scene.yaml").write_text(json.dumps(scene))
    done = devrf("run", tmp_path, "--until", "rig")
    assert done.code == code, done.said
    assert all(f"{name}.mp4: Keep one eye" in done.said for name in odd.split())
    if code == 0:
        rig = json.loads((tmp_path / "run" / "rig" / "rig.json").read_text())
        assert list(rig["cameras"]) == [name for name in poses if name != odd]
        assert list(rig["left_out"]) == [odd]
        rows = json.loads((tmp_path / "run" / "rig" / "health.json").read_text())["rows"]
        assert [row["about"] for row in rows if row["code"] == "camera-left-out"] == [odd]


@pytest.mark.parametrize(("count", "verdict"), [(32, "fail"), (96, "warn")])
def test_a_sweep_is_refused_only_where_too_few_pictures_are_sharp(
    count: int, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quarter of them is: of 96 that is as many as a good sweep has."""
    monkeypatch.setattr(ingest, "sharp", lambda values: np.arange(len(values)) % 4 == 0)
    row = judged(ingest.ingested(FrameSet({"static": frames("sweep", count)})))["sweep-blurred"]
    assert row.verdict == verdict and f"{3 * count // 4} of {count}" in row.remedy
