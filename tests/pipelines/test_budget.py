"""Budgets: estimates against what was measured, and how a stage is fitted into less."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import EXAMPLE
from tests.pipelines.planned_captures import configured, planned, source

from devrf.capture.amounts import size_text
from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.budget.estimate import stage_needs, static_poses_need
from devrf.pipelines.budget.fit import SIDES_PX, Fit, fit
from devrf.pipelines.budget.material import Material, find_material
from devrf.pipelines.budget.need import BudgetError, Need, most_on_disk
from devrf.pipelines.budget.training import BASE, FEW_S, SECONDS
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import FlowConfig, SceneConfig
from devrf.pipelines.stages.static_poses import coarser_rows
from devrf.pipelines.trained_model import PIECES

GB = 10**9

# Peaks of stages of the example session with `tiny` on two cores, each in a process of its own: GB of all its
# processes together, MB that its folder held in the end and at most, seconds (docs/budgets.md).
GOOD_MB = (
    2 * 4 * 46.6
)  # a value's copy at the last good point, old and new checkpoint: computed, newer than the rest
MEASURED = {
    "ingest": (0.41, 34.0, 34.0, 4.6),
    "static_poses": (0.68, 18.3, 34.5, 36.9),
    "sync": (0.40, 0.2, 0.2, 2.9),
    "rig": (0.62, 1.9, 9.0, 28.0),
    "colour": (0.38, 0.0, 0.0, 6.4),
    "scene": (0.73, 1.8, 1.8, 30.2),
    "flow": (0.36, 4.7, 4.7, 14.1),
    "canonical": (1.92, 14.7, 916.5 + GOOD_MB, 127.9),
    "deformation": (1.03, 1.2, 26.3, 69.6),
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


def test_fine_tuning_leaves_a_model_and_checkpoints_of_its_own() -> None:
    """Of every number in the box of the scene at rest: values and two moments of four bytes, old and new at once."""

    def need(*asked: str) -> Need:
        config = load_scene(EXAMPLE / "scene.yaml", asked)
        return stage_needs(config, find_material(config, EXAMPLE, EXAMPLE / "none"))["deformation"]

    plain, tuned = need(), need("reconstruct.fine_tuning_iterations=10")
    numbers = 13 * 112**3
    assert tuned.passing - plain.passing == 2 * 3 * 4 * numbers
    assert tuned.left - plain.left == pytest.approx(0.35 * numbers, abs=1)


@pytest.fixture
def config() -> SceneConfig:
    return configured()


# GB with one and with two at once, of a process of its own: 30 pictures of 3840x2160 (docs/budgets.md)
@pytest.mark.parametrize(("stage", "one_gb", "two_gb"), [("ingest", 0.25, 0.32), ("flow", 1.82, 2.87)])
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
