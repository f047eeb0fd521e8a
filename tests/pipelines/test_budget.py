"""Budgets: estimates against what was measured, what is decided within them, what is refused, what is stopped."""

import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.conftest import EXAMPLE, Command
from tests.pipelines.small_stages import job, small_stages, write
from tests.reconstruct.test_model_io import _camera, _model

from devrf.capture.amounts import size_text
from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.video_writer import write_video
from devrf.pipelines.budget import disk, forecast, keep
from devrf.pipelines.budget.allowance import Allowance
from devrf.pipelines.budget.disk import Room, room_for, watched
from devrf.pipelines.budget.estimate import stage_needs, static_poses_need
from devrf.pipelines.budget.fit import SIDES_PX, Fit, fit
from devrf.pipelines.budget.keep import Budget
from devrf.pipelines.budget.material import Material, Source, find_material, planned_material
from devrf.pipelines.budget.need import BudgetError, Need, most_on_disk
from devrf.pipelines.budget.training import BASE, FEW_S, SECONDS
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import FlowConfig, SceneConfig, StaticPosesConfig
from devrf.pipelines.exit_codes import DONE, FAILED
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.static_poses import _options, coarser_rows
from devrf.pipelines.trained_model import PIECES
from devrf.reconstruct import model as models
from devrf.reconstruct.model import CHUNK, FEWEST_AT_ONCE, render_view

GB = 10**9

# Peaks of stages of the example session with `tiny` on two cores, each in a process of its own: GB of all its
# processes together, MB that its folder held in the end and at most, seconds (docs/budgets.md).
MEASURED = {
    "ingest": (0.41, 34.0, 34.0, 4.6),
    "static_poses": (0.68, 18.3, 34.5, 36.9),
    "sync": (0.40, 0.2, 0.2, 2.9),
    "rig": (0.62, 1.9, 9.0, 28.0),
    "colour": (0.38, 0.0, 0.0, 6.4),
    "scene": (0.73, 1.8, 1.8, 30.2),
    "flow": (0.36, 4.7, 4.7, 14.1),
    "canonical": (1.92, 14.7, 638.0, 127.9),
    "deformation": (1.03, 1.2, 26.0, 69.6),
    "evaluate": (0.99, 17.1, 17.1, 43.2),
    "render": (1.03, 0.5, 0.5, 64.8),
    "report": (0.41, 4.0, 4.0, 6.0),
}
MEMORY_FACTOR = 1.5
FEW_MB = 15.0  # what is not counted stage by stage


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("devrf.pipelines.budget.estimate.usable_cores", lambda: 2)


@pytest.fixture(scope="module")
def example() -> tuple[SceneConfig, Material]:
    config = load_scene(EXAMPLE / "scene.yaml", [])
    return config, find_material(config, EXAMPLE, EXAMPLE / "none")


def test_estimates_of_the_example_are_near_what_was_measured(
    example: tuple[SceneConfig, Material], two_cores: None
) -> None:
    needs = stage_needs(*example)
    assert list(needs) == list(MEASURED)
    for name, (memory_gb, left_mb, most_mb, seconds) in MEASURED.items():
        need = needs[name]
        assert 0.9 * memory_gb < Fit(need, need.at_once).memory / GB < MEMORY_FACTOR * memory_gb, name
        assert left_mb / 1.5 < need.left / 1e6 < 1.5 * left_mb + FEW_MB, name
        assert most_mb / 1.5 < need.disk / 1e6, name
        assert need.seconds is not None and seconds / 3 < need.seconds < 3 * seconds, name


def test_the_time_of_a_training_follows_what_is_asked_for() -> None:
    def seconds(stage: str, *asked: str) -> float | None:
        config = load_scene(EXAMPLE / "scene.yaml", [f"reconstruct.{text}" for text in asked])
        return stage_needs(config, find_material(config, EXAMPLE, EXAMPLE / "none"))[stage].seconds

    def share(stage: str, *asked: str) -> float:
        found = seconds(stage, *asked)
        assert found is not None
        return (found - FEW_S) / (SECONDS[stage]["tiny"] - FEW_S)

    assert share("canonical") == share("deformation") == 1
    assert share("canonical", "canonical_iterations=200") == pytest.approx(1 / 3)
    assert share("canonical", "rays=1024", "motion_iterations=40") == 1  # samples bound what rays cost
    assert share("deformation", "motion_iterations=40") == pytest.approx(0.4)
    assert share("deformation", "rays=3072", "canonical_iterations=200") == pytest.approx(2)
    assert share("deformation", "key_times=5") == pytest.approx(5 / 25)


def source(**changes: object) -> Source:
    made = Source("camera", "clip", 3840, 2160, 300, 300, 3e6)
    return replace(made, **changes)  # type: ignore[arg-type]


def planned(config: SceneConfig, **sources: Source) -> Material:
    return planned_material(config, sources)


@pytest.fixture
def config() -> SceneConfig:
    return SceneConfig.model_validate(
        {"name": "x", "capture": {"static": "s.mp4", "cameras": {"cam0": "c.mp4"}}}
    )


# GB with one and with two at once, of a process of its own: 30 pictures of 3840x2160 (docs/budgets.md)
@pytest.mark.parametrize(("stage", "one_gb", "two_gb"), [("ingest", 0.25, 0.32), ("flow", 1.83, 2.87)])
def test_large_pictures_cost_what_was_measured(
    config: SceneConfig, two_cores: None, stage: str, one_gb: float, two_gb: float
) -> None:
    sweep = source(role="sweep", used=120)
    need = stage_needs(config, planned(config, static=sweep, cam0=source()))[stage]
    assert need.at_once == 2
    assert one_gb < need.least / GB < 1.5 * one_gb + 0.35  # with libraries of the whole pipeline
    assert two_gb < Fit(need, need.at_once).memory / GB < 1.5 * two_gb + 0.35
    more = need.each / GB / (two_gb - one_gb)
    assert 0.7 < more < 1.8


def test_what_fits_is_done_with_fewer_at_once(config: SceneConfig) -> None:
    need = Need("flow", GB, GB, 8)
    config = config.model_copy(update={"flow": FlowConfig(method="raft", weights="raft.pth")})
    found = [fit(need, config, planned(config, static=source(role="sweep")), n * GB) for n in (20, 9, 4, 2)]
    assert [f.at_once for f in found] == [8, 8, 3, 1]
    assert found[1].said is None and "3 instead of 8 at once" in (found[2].said or "")
    with pytest.raises(BudgetError, match="^needs about 2 GB.*left on this machine; close.*flow.method: dis"):
        fit(need, config, planned(config, static=source(role="sweep")), 2 * GB - 1)


def test_only_remedies_that_can_help_are_named(config: SceneConfig) -> None:
    material = planned(config, static=source(role="sweep"), cam0=source())
    camera = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), np.eye(4)[:3])
    first = PosedFrame(Path("0.png"), camera, "cam0", 0, 0.0, 0.0, "train")
    second = replace(first, index=1, time_s=1.0, time=1.0, flow=Path("1.npz"))
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    scene = Scene((), (first, second), np.eye(4), box, 0.1, 3.0, "inward", "white", 0.0, 1.0, None, 1.0)
    brought = replace(material, scene=scene)

    def said(stage: str, material: Material = material, **changes: object) -> str:
        changed = config.model_copy(update=changes)
        with pytest.raises(BudgetError) as refused:
            fit(Need(stage, GB, GB), changed, material, GB)
        return str(refused.value).partition("or use ")[2]

    raft = FlowConfig(method="raft", weights="raft.pth")
    assert said("flow", flow=raft) == "flow.method: dis, or smaller pictures"
    assert said("flow") == said("flow", brought, flow=raft) == "smaller pictures"
    assert "--preset tiny" in said("render") and "--preset" not in said("render", preset="tiny")
    assert not said("report")
    with pytest.raises(BudgetError, match="larger machine$"):
        fit(Need("ingest", BASE, 1), config, material, BASE)  # libraries alone fill it


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_with_enough_memory_all_rays_are_rendered_at_once(config: SceneConfig, device: str) -> None:
    material = planned(config, static=source(role="sweep", used=120), cam0=source())
    needs = stage_needs(config, material, device)
    for stage in ("evaluate", "render"):
        found = fit(needs[stage], config, material, 100 * GB, device)
        assert found.at_once == PIECES and found.said is None


def test_the_sweep_is_reduced_before_it_is_refused(config: SceneConfig, two_cores: None) -> None:
    material = planned(config, static=source(role="sweep", used=120))
    need = static_poses_need(config, material)
    smaller = static_poses_need(config, material, 720)
    found = fit(need, config, material, smaller.least)
    assert (found.side_px, found.at_once) == (720, 1)
    assert "features at 720 instead of 1280 pixels" in (found.said or "")
    (row,) = coarser_rows(found.side_px)
    assert row.verdict == "warn" and "budget.memory_gb" in row.remedy and coarser_rows(None) == []
    tight = config.model_copy(update={"budget": config.budget.model_copy(update={"memory_gb": 0.5})})
    with pytest.raises(BudgetError, match=r"^needs.*budget.memory_gb is 0.5; raise it.*fewer pictures"):
        fit(need, tight, material, GB // 2)
    assert SIDES_PX[0] > SIDES_PX[-1]


def test_disk_counts_what_stays_and_what_passes() -> None:
    needs = [Need("a", 0, left=10, passing=5), Need("b", 0, left=1, passing=20), Need("c", 0, left=3)]
    assert [most_on_disk(needs[:n]) for n in (1, 2, 3)] == [15, 31, 31]
    assert most_on_disk([]) == 0
    assert most_on_disk(needs, {"a": 10, "c": 100}) == 21  # the old folder of a goes before b begins
    assert [size_text(n) for n in (5e6, 0.36e9, 19e9, 250e9)] == ["5 MB", "0.36 GB", "19 GB", "250 GB"]


# --- on the command line ---


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep and a camera of 1920x1080."""
    folder = tmp_path_factory.mktemp("clips")
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (68, 120, 3)).astype(np.uint8).repeat(16, 0).repeat(16, 1)
    pictures = [np.ascontiguousarray(np.roll(coarse, 4 * n, 1)[:1080]) for n in range(24)]
    write_video(folder / "static.mp4", pictures, 24.0)
    shutil.copy(folder / "static.mp4", folder / "cam0.mp4")
    (folder / "scene.yaml").write_text(
        "name: x\noutput: run\npreset: tiny\ncapture: {static: static.mp4, cameras: {cam0: cam0.mp4}}\n"
    )
    return folder


def test_a_run_says_what_it_needs_before_it_starts(clips: Path, devrf: Command) -> None:
    said = devrf("run", clips, "--dry-run", "--set", "budget.time_minutes=0.5", "--set", "budget.disk_gb=3")
    assert said.code == 0, said.said
    assert "of main memory (canonical;" in said.out and "allowed)" in said.out
    assert "budget.disk_gb is 3" in said.out and "budget.time_minutes (0.5): use a faster preset" in said.out
    assert "  flow: memory" in said.out and "  report: memory" in said.out
    assert not (clips / "run").exists()


@pytest.mark.parametrize(
    ("budget", "expected"),
    [
        (
            "memory_gb=0.2",
            "ingest: needs about .* of main memory at the least, and budget.memory_gb is 0.2; raise it",
        ),
        (
            "memory_gb=0.8",
            "evaluate: needs about .* budget.memory_gb is 0.8; raise it, or use a lower reconstruct.resolution",
        ),
        ("memory_gb=0.5", "canonical: budget.memory_gb: the smallest training does not fit"),
        (
            "disk_gb=0.001",
            "the run needs about .* on the disk, .* more than there is: budget.disk_gb is 0.001",
        ),
    ],
)
def test_what_cannot_fit_is_named(clips: Path, budget: str, expected: str) -> None:
    config = load_scene(clips / "scene.yaml", [f"budget.{budget}"])
    found = forecast.forecast(config, clips, clips / "run", "cpu", MEASURED)
    assert found is not None and any(re.search(expected, text) for text in found.refused)


def leave(path: Path, size: int) -> None:
    """A file of a size, without writing it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.truncate(size)


def test_what_a_killed_run_has_left_does_not_stop_the_next(clips: Path, tmp_path: Path) -> None:
    config, stages = load_scene(clips / "scene.yaml", ["budget.disk_gb=1"]), list(MEASURED)

    def refused(made: Collection[str] = ()) -> list[str]:
        to_do = [stage for stage in stages if stage not in made]
        found = forecast.forecast(config, clips, tmp_path, "cpu", to_do)
        assert found is not None
        return [text for text in found.refused if "disk" in text]

    assert not refused()
    for name in (".canonical.safetensors", ".canonical.coarse.safetensors", ".new-ingest-7-abc/frames/0.jpg"):
        leave(tmp_path / name, 495_000_000)
    assert not refused() and refused(made=["canonical"])  # nobody goes on from that checkpoint
    (tmp_path / ".canonical.safetensors").unlink()
    leave(tmp_path / "canonical" / "model.safetensors", 900_000_000)
    assert refused(made=["canonical"]) and refused()  # until it is replaced it takes its room
    (tmp_path / "canonical" / "model.safetensors").unlink()
    leave(tmp_path / "ingest" / "frames" / "0.jpg", 600_000_000)
    assert not refused() and refused(made=["ingest"])


def test_unfinished_work_counts_as_room_for_those_who_go_on_from_it(tmp_path: Path) -> None:
    for name, size in (
        (".flow/cam0/1.npz", 1),
        (".canonical.box.safetensors", 2),
        (".digests.json.7.tmp", 4),
    ):
        leave(tmp_path / name, size * 10**6)
    for name, size in ((".new-flow-7-abc/1.npz", 8), (".old-rig-abc/rig.json", 16), ("rig/rig.json", 32)):
        leave(tmp_path / name, size * 10**6)
    left = 100 - 63
    assert room_for(tmp_path, 0.1).count == left * 10**6
    for stages, back in ((["flow"], 29), (["canonical"], 30), (["flow", "canonical"], 31), (["rig"], 28)):
        assert room_for(tmp_path, 0.1, None, stages).count == (left + back) * 10**6


def test_later_stages_are_estimated_with_the_model_that_was_trained(clips: Path, tmp_path: Path) -> None:
    config = load_scene(clips / "scene.yaml", [])

    def memory(anew: Collection[str] = ()) -> dict[str, int]:
        material = find_material(config, clips, tmp_path, anew)
        return {name: need.least for name, need in stage_needs(config, material).items()}

    def trained(stage: str, **metrics: object) -> None:
        (tmp_path / stage).mkdir()
        (tmp_path / stage / "metrics.json").write_text(json.dumps(metrics))

    planned = memory()
    trained("canonical", grid=[50, 40, 60], options={"channels": 12, "shell_resolution": 64})
    made = memory()
    for stage in ("deformation", "evaluate", "render"):
        assert made[stage] < planned[stage], stage
    assert made["canonical"] == planned["canonical"] and memory(["canonical"]) == planned
    trained("deformation", grid=[80, 80, 80], keys=100, options={})
    assert memory()["evaluate"] > made["evaluate"] + 4 * 2 * 3 * 100 * 70**3
    assert memory(["deformation"]) == made


def test_what_training_will_do_with_less_memory_is_said_before(clips: Path) -> None:
    config = load_scene(clips / "scene.yaml", ["budget.memory_gb=1.3"])
    found = forecast.forecast(config, clips, clips / "run", "cpu", MEASURED)
    assert found is not None and not found.refused
    assert all(fit.memory <= 1.3e9 for fit in found.fits)
    assert [
        line
        for line in found.details()
        if re.search("canonical: .*resolution at rest: .* instead of 112", line)
    ]


def test_what_cannot_fit_is_refused_before_anything_starts(clips: Path, devrf: Command) -> None:
    refused = devrf("run", clips, "--set", "budget.memory_gb=0.5")
    assert refused.code == 2 and "canonical: budget.memory_gb" in refused.err, refused.said
    assert not (clips / "run").exists() or not [p for p in (clips / "run").iterdir() if p.name[0] != "."]


def test_a_tight_budget_makes_the_same_pictures_with_less_memory(clips: Path, tmp_path: Path) -> None:
    """In processes of their own, as if there were 16 cores."""
    program = (
        "import os, re, sys\nfrom pathlib import Path\n"
        "os.environ.pop('OMP_NUM_THREADS', None)\n"
        "os.sched_getaffinity = lambda pid: set(range(16))\n"
        "from devrf.pipelines.budget.keep import Budget\nfrom devrf.pipelines.config.load import load_scene\n"
        "from devrf.pipelines.stage import StageContext\nfrom devrf.pipelines.stages import ingest\n"
        "scene, out, *budget = sys.argv[1:]\n"
        "config, folder, said = load_scene(Path(scene) / 'scene.yaml', budget), Path(scene), []\n"
        "allowance = Budget(config, folder, Path(out) / 'none', 'cpu').allowance('ingest', said.append)\n"
        "Path(out).mkdir()\n"
        "context = StageContext(config, folder, Path(out), Path(out), lambda *a: None, 'cpu', allowance=allowance)\n"
        "ingest.run(context)\n"
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]\n"
        "assert 'torch' not in sys.modules, 'estimates and ingest load 0.3 GB for nothing'\n"
        "print(allowance.at_once, peak, *said)\n"
    )

    def ingested(name: str, *budget: str) -> tuple[int, int, dict[Path, bytes]]:
        """Threads, most kilobytes, files."""
        out = tmp_path / name
        command = [sys.executable, "-c", program, str(clips), str(out), *budget]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        at_once, kilobytes, *said = done.stdout.split()
        assert ("instead" in said) == bool(budget)
        files = {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
        return int(at_once), int(kilobytes), files

    at_once, tight, pictures = ingested("tight", "budget.memory_gb=0.5")
    assert at_once < 16 and len(pictures) > 40
    # 16 decoders and 17 pictures being written, of 1920x1080 at 7 bytes a pixel, are 0.2 GB; on a busy machine they may
    # for once not all be at work at the same time
    peaks = []
    while not peaks or (len(peaks) < 5 and max(peaks) < tight + 60_000):
        at_once, most, same = ingested(f"free{len(peaks)}")
        assert at_once == 16 and same == pictures
        peaks.append(most)
    assert max(peaks) > tight + 60_000, (tight, peaks)


def test_a_stage_is_stopped_before_the_disk_is_full(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(disk, "WATCH_S", 0.05)

    def writes(context: StageContext) -> None:
        for n in range(400):
            (context.out / f"{n}.bin").write_bytes(bytes(100_000))
            time.sleep(0.02)

    run = job(folder, small_stages(second=writes), "budget.disk_gb=0.002")
    assert execute(run) == FAILED
    said = capsys.readouterr().err
    assert (
        "second: stopped before the disk is full: budget.disk_gb is 0.002" in said
        and "finished stages" in said
    )
    left = {p.name for p in (folder / "run").iterdir() if p.is_dir() and not p.name.startswith(".flow")}
    assert left == {"first"}
    assert sum(p.stat().st_size for p in (folder / "run").rglob("*") if p.is_file()) < 1e6
    run = job(folder, small_stages(), "budget.disk_gb=0.002")
    assert execute(run) == DONE and run.executed == ["second", "other", "third"]


def test_nothing_is_stopped_while_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "WATCH_S", 0.01)
    with watched(tmp_path, 1.0):
        time.sleep(0.1)
    room = room_for(tmp_path / "not" / "yet", None)
    assert 0 < room.count < shutil.disk_usage(tmp_path).free and "free on the disk" in room.bound
    assert "can be deleted" not in room.remedy
    cache = tmp_path / "cache"
    cache.mkdir()
    assert (
        f"{cache} holds results of earlier runs, which can be deleted"
        in room_for(tmp_path, None, cache).remedy
    )
    (tmp_path / "large").write_bytes(bytes(2_000_000))
    room = room_for(tmp_path, 0.001)
    assert room.count == -1_000_000 and "budget.disk_gb is 0.001" in room.bound


def test_no_room_is_said_before_a_stage_begins(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, config: SceneConfig
) -> None:
    material = planned(config, static=source(role="sweep"))
    monkeypatch.setattr(
        Budget, "_known", lambda self, stages: (material, {"flow": Need("flow", 0, left=5 * GB)})
    )
    monkeypatch.setattr(keep, "room_for", lambda *_: Room(2 * GB, "2 GB are free", "free some"))
    began: list[str] = []
    first, second, *_ = small_stages(second=lambda context: began.append("flow"))
    run = job(folder, (first, replace(second, name="flow")))
    assert execute(run) == FAILED and run.executed == ["first"] and not began
    said = capsys.readouterr().err
    assert "flow: it needs about 5 GB on the disk, 3 GB more than there is: 2 GB are free; free some" in said


def test_a_run_without_time_ends_between_stages_and_goes_on(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    def slow(context: StageContext) -> None:
        assert context.allowance.left_s is not None and context.allowance.left_s <= 0.6
        time.sleep(0.7)
        write("second")(context)

    run = job(folder, small_stages(second=slow), "budget.time_minutes=0.01")
    assert execute(run) == FAILED and run.executed == ["first", "second"]
    said = capsys.readouterr().err
    assert "no time left for other, third (budget.time_minutes: 0.01)" in said and "run again" in said
    run = job(folder, small_stages(second=slow))
    assert execute(run) == DONE and run.executed == ["other", "third"]


def test_the_film_is_left_for_later_and_the_report_is_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, config: SceneConfig
) -> None:
    material = planned(config, static=source(role="sweep"))
    monkeypatch.setattr(
        Budget, "_known", lambda self, stages: (material, {"render": Need("render", 0, seconds=100.0)})
    )
    first, second, *_ = small_stages()
    made = (
        first,
        replace(second, name="render", reads=()),
        replace(second, name="report", reads=("render",)),
    )
    run = job(folder, made, "budget.time_minutes=1")
    assert execute(run) == FAILED and run.executed == ["first", "report"]
    assert "render is left; run again" in capsys.readouterr().err
    run = job(folder, made, "budget.time_minutes=2")
    assert execute(run) == DONE and run.executed == ["render", "report"]


def test_structure_from_motion_takes_no_more_time_than_is_left() -> None:
    soon = Allowance(until=time.monotonic() + 60, at_once=3, side_px=720)
    options = _options(StaticPosesConfig(), soon)
    assert options.time_minutes == pytest.approx(1, abs=0.1) and (options.threads, options.side_px) == (
        3,
        720,
    )
    assert _options(StaticPosesConfig(time_minutes=0.5), soon).time_minutes == 0.5
    assert _options(StaticPosesConfig(time_minutes=None), Allowance()).time_minutes is None


def test_a_forecast_needs_files_that_can_be_read(folder: Path) -> None:
    config = load_scene(folder / "scene.yaml", [])
    assert forecast.forecast(config, folder, folder / "run", "cpu", ["ingest"]) is None


def test_a_full_gpu_is_tried_again_with_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = _camera().scaled(4.0)
    expected = render_view(_model("white"), camera, None)
    render_rest, most, tried = models.render_rest, 1 << 10, []

    def full(canonical, shell, plain, rays_o, rays_d, **options):
        tried.append(len(rays_o))
        if len(rays_o) > most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB")
        return render_rest(canonical, shell, plain, rays_o, rays_d, **options)

    monkeypatch.setattr(models, "render_rest", full)
    model = _model("white")
    np.testing.assert_allclose(render_view(model, camera, None), expected, atol=1e-6)
    assert model.chunk == most < CHUNK and max(tried) > most
    most = FEWEST_AT_ONCE - 1
    with pytest.raises(torch.OutOfMemoryError):
        render_view(model, camera, None)
