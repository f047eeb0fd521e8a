"""Budgets: what a run is told before it starts, and refused."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import Command
from tests.pipelines.planned_captures import configured, leave, planned, source

from devrf.capture.video_writer import write_video
from devrf.pipelines.budget import forecast
from devrf.pipelines.budget.disk import Room
from devrf.pipelines.budget.estimate import stage_needs
from devrf.pipelines.budget.material import find_material
from devrf.pipelines.budget.need import Need
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.stages import stage_names

GB = 10**9


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
    found = forecast.forecast(config, clips, clips / "run", "cpu", stage_names())
    assert found is not None and any(re.search(expected, text) for text in found.refused)


def test_what_a_killed_run_has_left_does_not_stop_the_next(clips: Path, tmp_path: Path) -> None:
    config, stages = load_scene(clips / "scene.yaml", ["budget.disk_gb=1.9"]), list(stage_names())

    def refused(made: Collection[str] = ()) -> list[str]:
        to_do = [stage for stage in stages if stage not in made]
        found = forecast.forecast(config, clips, tmp_path, "cpu", to_do)
        assert found is not None
        return [text for text in found.refused if "disk" in text]

    assert not refused()
    for name in (".canonical.safetensors", ".canonical.coarse.safetensors", ".new-ingest-7-abc/frames/0.jpg"):
        leave(tmp_path / name, 942_000_000)
    assert not refused() and refused(made=["canonical"])  # nobody goes on from that checkpoint
    (tmp_path / ".canonical.safetensors").unlink()
    leave(tmp_path / "canonical" / "model.safetensors", 900_000_000)
    assert refused(made=["canonical"]) and refused()  # until it is replaced it takes its room
    (tmp_path / "canonical" / "model.safetensors").unlink()
    leave(tmp_path / "ingest" / "frames" / "0.jpg", 600_000_000)
    assert not refused() and refused(made=["ingest"])


def test_folders_that_a_cache_keeps_leave_no_room_on_its_disk(tmp_path: Path) -> None:
    """The budget gets them back, the disk does not: it is the tighter one, although more is left of it now."""
    config, mb = configured(), 10**6
    material = planned(config, static=source(role="sweep"))
    needs = {name: Need(name, 0, left=4 * mb) for name in ("ingest", "sync", "rig")}
    for name in needs:
        leave(tmp_path / name / "0.jpg", 4 * mb)

    def found(*rooms: Room) -> forecast.Forecast:
        return forecast.forecast_of(needs, config, material, "cpu", 100 * GB, rooms, tmp_path)

    budget, disk = Room(5 * mb, "the budget", "raise it"), Room(6 * mb, "the disk", "free some")
    assert found(budget, disk).room == budget and not found(budget, disk).refused
    kept = replace(disk, kept=True)
    (refused,) = found(budget, kept).refused
    assert "the disk" in refused and "needs about 12 MB" in refused and found(kept, budget).room == kept


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
    found = forecast.forecast(config, clips, clips / "run", "cpu", stage_names())
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
    """In processes of their own, as if there were 16 cores; the disk is slow, so that all are at work at once."""
    program = (
        "import os, re, sys, time\nfrom pathlib import Path\n"
        "from devrf.capture import picture_writer\n"
        "os.environ.pop('OMP_NUM_THREADS', None)\n"
        "os.sched_getaffinity = lambda pid: set(range(16))\n"
        "from devrf.pipelines.budget.keep import Budget\nfrom devrf.pipelines.config.load import load_scene\n"
        "from devrf.pipelines.stage import StageContext\nfrom devrf.pipelines.stages import ingest\n"
        "scene, out, *budget = sys.argv[1:]\n"
        "write, in_hand, most = picture_writer._write, [], []\n"
        "def slowly(path, frame):\n"
        "    in_hand.append(path)\n"
        "    time.sleep(0.1)\n"
        "    most.append(len(in_hand))\n"
        "    write(path, frame)\n"
        "    in_hand.remove(path)\n"
        "picture_writer._write = slowly\n"
        "config, folder, said = load_scene(Path(scene) / 'scene.yaml', budget), Path(scene), []\n"
        "allowance = Budget(config, folder, Path(out) / 'none', 'cpu').allowance('ingest', said.append)\n"
        "Path(out).mkdir()\n"
        "context = StageContext(config, folder, Path(out), Path(out), lambda *a: None, 'cpu', allowance=allowance)\n"
        "ingest.run(context)\n"
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]\n"
        "assert 'torch' not in sys.modules, 'estimates and ingest load 0.3 GB for nothing'\n"
        "print(allowance.at_once, max(most), peak, *said)\n"
    )

    def ingested(name: str, *budget: str) -> tuple[int, int, int, dict[Path, bytes]]:
        """Threads, most pictures in hand, most kilobytes, files."""
        out = tmp_path / name
        command = [sys.executable, "-c", program, str(clips), str(out), *budget]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        at_once, in_hand, kilobytes, *said = done.stdout.split()
        assert ("instead" in said) == bool(budget)
        files = {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
        return int(at_once), int(in_hand), int(kilobytes), files

    at_once, in_hand, kilobytes, pictures = ingested("tight", "budget.memory_gb=0.5")
    assert in_hand <= at_once < 8 and 1024 * kilobytes < 0.5e9 and len(pictures) > 40
    at_once, in_hand, _, same = ingested("free")
    assert at_once == 16 and in_hand > 8 and same == pictures


def test_a_forecast_needs_files_that_can_be_read(folder: Path) -> None:
    config = load_scene(folder / "scene.yaml", [])
    assert forecast.forecast(config, folder, folder / "run", "cpu", ["ingest"]) is None
