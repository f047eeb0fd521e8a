"""A camera whose clock is wrong, and sure of itself, is found by the motion that the others see."""

from dataclasses import replace

import numpy as np
import pytest
from tests.reconstruct.conftest import ball_clips, true_motion

from devrf.capture.scene import Scene
from devrf.pipelines.health.training import late_rows
from devrf.reconstruct.clocks import with_offset
from devrf.reconstruct.late_camera import WIDE, fits_better, moved_by, offset_pictures
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.options import MotionOptions, preset
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.train_deformation import train_deformation

pytestmark = pytest.mark.full

TIMES, LATE = 11, 2  # pictures of each camera; pictures by which one is late
TRAVEL = np.array([0.6, 0.0, 0.3])
GAP_S = 1 / (TIMES - 1)
COST = {
    "seconds": 1.0, "iterations": 2, "rays": 3, "restarts": 1, "rate": 1.0, "peak_rss_gb": 1.0, "peak_gpu_gb": None,
}  # fmt: skip
MOTION = MotionOptions(levels=(4,), iterations=(1,), rays=300, importance=0.8, find_late_camera=True)


@pytest.fixture(scope="module")
def moving(ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The ball on its way, seen by four cameras."""
    return ball_clips(ball, tmp_path_factory.mktemp("late"), TIMES, TRAVEL)


def _scattered(lowest_at: float, deep: float) -> np.ndarray:
    """Errors of ten pictures, of which the first and last ones lie beyond the motion at some shifts."""
    rng = np.random.default_rng(0)
    curves = 10 + deep * (WIDE - lowest_at) ** 2 + rng.normal(0, 1, (10, len(WIDE)))
    for n, row in enumerate(curves):
        row[(n + WIDE < 0) | (n + WIDE > 9)] = np.nan
    return curves


def test_an_offset_is_where_pictures_fit_clearly_better() -> None:
    assert offset_pictures(_scattered(-1.75, 5.0), WIDE) == pytest.approx(-1.75, abs=0.25)
    assert offset_pictures(_scattered(2.0, 5.0), WIDE) == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize("curves", [_scattered(1.0, 0.0), _scattered(0.0, 5.0), _scattered(2.0, 5.0)[:3]])
def test_else_there_is_none(curves: np.ndarray) -> None:
    """Flat errors, a minimum where the clock is, and too few pictures to tell chance from offset."""
    assert offset_pictures(curves, WIDE) == 0.0


def test_pictures_beyond_what_is_modelled_are_left_out(moving: Scene) -> None:
    moved = moved_by(moving, "cam1", -2 * GAP_S)
    times = [f.time for f in moved.dynamic if f.camera_name == "cam1"]
    assert times == pytest.approx([n * GAP_S for n in range(TIMES - 2)])
    assert len([f for f in moved.dynamic if f.camera_name == "cam0"]) == TIMES


@pytest.fixture
def trained(ball, monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """Training finds the true motion, whatever it is given; what it was given."""
    motion = true_motion(ball.scene, TRAVEL)
    given: list[Scene] = []

    def train(scene: Scene, *_: object, **__: object) -> tuple[MotionField, dict]:
        given.append(scene)
        return motion, dict(COST)

    monkeypatch.setattr("devrf.reconstruct.train_deformation.train_motion", train)
    return given


def test_a_camera_two_pictures_late_is_brought_back(
    moving: Scene, rest: RestModel, trained: list[Scene]
) -> None:
    late = with_offset(moving, "cam1", LATE * GAP_S)
    late = replace(
        late, dynamic=tuple(f for f in late.dynamic if f.camera_name != "cam1" or f.index < TIMES - LATE)
    )
    _, metrics = train_deformation(late, rest, {}, MOTION, reference="cam0")
    found = metrics["late_camera"]
    assert found["name"] == "cam1" and found["pictures"] == pytest.approx(-LATE, abs=0.25)
    assert found["offset_s"] == pytest.approx(found["pictures"] * GAP_S)
    everything, others, moved = trained
    assert everything is late and {f.camera_name for f in others.dynamic} == {"cam0", "cam2", "cam3"}
    assert min(f.time or 0.0 for f in moved.dynamic if f.camera_name == "cam1") < 0.25 * GAP_S
    assert {name: metrics[name] for name in ("seconds", "iterations", "rays", "restarts")} == {
        name: 3 * COST[name] for name in ("seconds", "iterations", "rays", "restarts")
    }
    (row,) = late_rows(found)
    assert row.verdict == "warn" and f"(cam1, {1000 * found['offset_s']:+.0f} ms)" in row.check


def test_right_clocks_stay_and_cost_no_training(moving: Scene, rest: RestModel, trained: list[Scene]) -> None:
    _, metrics = train_deformation(moving, rest, {}, MOTION, reference="cam0")
    assert "late_camera" not in metrics and late_rows(metrics.get("late_camera")) == []
    assert len(trained) == 1


def test_a_second_motion_is_kept_only_if_it_fits_better_by_more_than_chance() -> None:
    rng = np.random.default_rng(0)
    before = {name: 10 + rng.normal(0, 1, (10, 1)) for name in ("a", "b", "c")}
    noise = {name: rng.normal(0, 0.2, (10, 1)) for name in before}
    assert not fits_better(before, {name: x + noise[name] - 0.01 for name, x in before.items()})
    better = {name: x + noise[name] - 3 * (name == "b") for name, x in before.items()}
    assert fits_better(before, better)
    better["b"][:3] = np.nan  # beyond the second motion
    assert fits_better(before, better)
    better["b"][:], better["a"][:], better["c"][:] = np.nan, np.nan, np.nan
    assert not fits_better(before, better)


def test_the_published_recipe_looks_for_none() -> None:
    assert not preset("reference").motion.find_late_camera and preset("fast").motion.find_late_camera
