"""A forward-facing scene in the published layout, modelled by planes in normalised device coordinates."""

import json
from pathlib import Path
from typing import Any

import pytest
from tests.conftest import SMALL_FILM

from devrf.lab.simulate.protocol.dataset_options import ForwardOptions
from devrf.lab.simulate.protocol.forward import simulate_forward
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.pipelines.stages import render

pytestmark = pytest.mark.full

GAIN_DB = 3.0  # of the motion over the scene at rest, where it moves


@pytest.fixture(scope="module")
def run_dir(devrf: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("forward")
    options = ForwardOptions(static_views=24, times=6, spp=8)
    simulate_forward(folder / "set", Simulation("flower", 3, 0, (96, 54), options))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(render.SIZES, "tiny", SMALL_FILM)
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
    assert next((run_dir / "render").glob("*.mp4")).stat().st_size > 1_000
