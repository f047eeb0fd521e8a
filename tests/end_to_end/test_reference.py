"""The published recipe and its most telling ablation, small enough for every run of the tests."""

import json
from pathlib import Path
from typing import Any

import pytest

from devrf.lab.simulate.protocol.dataset_options import DatasetOptions
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.reconstruct.evaluation.evaluate import motion_psnr

pytestmark = pytest.mark.full

SIZE, TIMES = 64, 6
SETTINGS = {"resolution": 32, "rays": 512, "canonical_iterations": 800, "motion_iterations": 300}
COARSE_TO_FINE_DB = 2.0  # over a field trained at its full resolution from the start
MOTION_DB = 3.0  # over the scene at rest, where it moves


@pytest.fixture(scope="module")
def out(devrf: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    # Of 50 published times six are a short piece: the arm moves less than through all of its way.
    options = DatasetOptions(static_views=48, static_test_views=4, times=TIMES, motion_scale=0.4)
    simulate_dataset(folder / "arm", Simulation("arm", 4, 0, (SIZE, SIZE), options))
    settings = [part for key, value in SETTINGS.items() for part in ("--set", f"reconstruct.{key}={value}")]
    done = devrf(
        "bench", "ablation", folder / "arm", "--preset", "reference", "--only", "base,c2f",
        "--out", folder / "out", "--device", "cpu", *settings,
    )  # fmt: skip
    assert done.code == 0, done.said[-3000:]
    return folder / "out"


def test_coarse_to_fine_pays(out: Path) -> None:
    rows = {row["name"]: row for row in json.loads((out / "ablation.json").read_text())["rows"]}
    assert rows["ablation/base to c2f/psnr"]["value"] >= COARSE_TO_FINE_DB


def test_motion_is_learned(out: Path) -> None:
    result = json.loads((out / "seed0" / "c2f" / "metrics.json").read_text())
    moving, still = motion_psnr(result)  # every test picture has a camera of its own: of whole pictures
    assert result["test_moving"]["psnr"] is None and moving is not None and still is not None
    gain = moving - still
    assert gain >= MOTION_DB
    train = result["train"]
    assert train["keys"] == TIMES and train["iterations"] == (TIMES - 1) * SETTINGS["motion_iterations"]


def test_the_coarse_model_found_the_box(out: Path) -> None:
    rest = json.loads((out / "seed0" / "rest" / "metrics.json").read_text())
    sides = [b - a for a, b in zip(*rest["aabb"], strict=True)]
    # the arm is slim; the first box was a cube of 2
    assert max(sides) < 2.0 and min(sides) < 0.6 * max(sides)
    assert rest["train_psnr"] > 28
