"""A forward-facing scene in the published layout, modelled by planes in normalised device coordinates."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from devrf.lab.simulate.protocol.dataset_options import ForwardOptions
from devrf.lab.simulate.protocol.forward import simulate_forward

pytestmark = pytest.mark.full

GAIN_DB = 3.0  # of the motion over the scene at rest, where it moves


@pytest.fixture(scope="module")
def run_dir(devrf: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("forward")
    simulate_forward(
        folder / "set", "flower", size=(96, 54), options=ForwardOptions(static_views=24, times=6, spp=8)
    )
    done = devrf("run", folder / "set", "--preset", "tiny", "--until", "render")
    assert done.code == 0, done.said[-3000:]
    return folder / "set" / "runs" / "flower"


def test_a_run_inside_its_data_set_does_not_make_itself_stale(devrf: Any, run_dir: Path) -> None:
    again = devrf("run", run_dir.parents[1], "--preset", "tiny", "--until", "render")
    assert again.code == 0 and ": runs:" not in again.said, again.said


def test_motion_beats_standing_still(run_dir: Path) -> None:
    metrics = json.loads((run_dir / "evaluate" / "metrics.json").read_text())
    gain = metrics["test_moving"]["psnr"] - metrics["static_baseline"]["test_moving"]["psnr"]
    assert gain >= GAIN_DB
    assert metrics["test"]["views"] == 6  # one test camera
    assert metrics["test_static"]["psnr"] > 28


def test_checks_of_a_healthy_set_are_silent(run_dir: Path) -> None:
    """All three training cameras were asked, at rest and in motion."""
    for stage, cameras in (("canonical", "cameras"), ("deformation", None)):
        check = json.loads((run_dir / stage / "metrics.json").read_text())["check"]
        assert len(check[cameras] if cameras else check) == 3
        rows = json.loads((run_dir / stage / "health.json").read_text())["rows"]
        assert len(rows) >= 2 and {row["verdict"] for row in rows} == {"ok"}, rows


def test_it_is_modelled_by_planes(run_dir: Path) -> None:
    scene = json.loads((run_dir / "scene" / "scene.json").read_text())
    assert scene["kind"] == "forward" and scene["background"] == "white" and len(scene["ndc"]) == 2
    grid = json.loads((run_dir / "canonical" / "metrics.json").read_text())["grid"]
    assert grid[2] == 48  # planes of preset tiny


def test_flow_of_the_data_set_was_used(run_dir: Path) -> None:
    assert json.loads((run_dir / "flow" / "flow.json").read_text())["method"] == "given"
    assert json.loads((run_dir / "deformation" / "metrics.json").read_text())["flow_pictures"] == 3 * 5


def test_a_film_was_made(run_dir: Path) -> None:
    assert next((run_dir / "render").glob("*.mp4")).stat().st_size > 5_000


def test_the_blossoms_inside_takes_its_colour(devrf: Any, run_dir: Path) -> None:
    """What is hidden at rest is learned by fine-tuning from the pictures in motion."""
    tuned_dir = run_dir.with_name("tuned")
    shutil.copytree(run_dir, tuned_dir)
    more = ("--set", "reconstruct.fine_tuning_iterations=60", "--set", "output=runs/tuned")
    done = devrf("run", run_dir.parents[1], "--preset", "tiny", *more, "--until", "evaluate")
    assert done.code == 0 and "canonical: skipped" in done.said, done.said[-3000:]
    assert json.loads((tuned_dir / "deformation" / "metrics.json").read_text())["fine_tuning_gain_db"] > 0.3
    plain, tuned = (
        json.loads((folder / "evaluate" / "metrics.json").read_text()) for folder in (run_dir, tuned_dir)
    )
    assert tuned["test_moving"]["psnr"] > plain["test_moving"]["psnr"]
    assert tuned["test_static"]["psnr"] == plain["test_static"]["psnr"]  # pictures at rest are what they were
    models = [*tuned_dir.glob("canonical/*.safetensors"), *tuned_dir.glob("deformation/*.safetensors")]
    assert len(models) == 3
    size = sum(path.stat().st_size for path in models) / 1e6
    assert tuned["model_mb"] == pytest.approx(size, abs=1e-3)
