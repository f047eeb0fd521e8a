"""Clocks of cameras that are not trained on: which are asked, what becomes of them, and what is said."""

import json
import math
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from devrf.calibration.clocks.equations import Clock
from devrf.capture.scene import Scene
from devrf.pipelines.health.judge import judge
from devrf.pipelines.health.training_rows import moved_clock_measures
from devrf.pipelines.report.run_reader import RunFolder
from devrf.pipelines.report.views_section import views
from devrf.pipelines.run_folder.clocks import clock_dict, sure_clocks
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import deformation, stage_names
from devrf.pipelines.stages.deformation import unknown_test_clocks
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.retimed import as_trained
from devrf.reconstruct.training.test_clocks import ViewOffset


@pytest.mark.parametrize(
    ("std_s", "unknown"), [(0.03, ["witness"]), (math.inf, ["witness"]), (0.0002, []), (0.0, [])]
)
def test_only_clocks_that_are_not_known_are_learned(
    odd_scene: Scene, std_s: float, unknown: list[str]
) -> None:
    clocks = {name: Clock(0.0, 0.0, std_s) for name in ("cam0", "cam1", "witness", "films nothing")}
    assert unknown_test_clocks(odd_scene, clocks) == unknown


SEEN = {"first": "cam0", "second": "cam1", "std_s": 2e-3, "sharp": True, "shifted": False}


@pytest.mark.parametrize(
    ("clock", "seen", "sure"),
    [
        (Clock(0.1, 0.0, 1e-4, "audio"), {}, True),
        (Clock(0.1, 0.0, 1e-4, "motion"), {}, False),  # both are by what moves
        (Clock(0.1, 0.0, 1e-2, "audio"), {}, False),
        (Clock(0.1, 0.0, 1e-4, "audio"), {"std_s": 8e-3}, False),
        (Clock(0.1, 0.0, 1e-4, "audio"), {"sharp": False}, False),
        (Clock(0.1, 0.0, 1e-4, "audio"), {"shifted": True}, False),  # sound lags behind its pictures
        (Clock(0.1, 0.0, 1e-4, "audio"), {"shifted": None}, False),  # of an earlier version
        (Clock(0.1, 0.0, 1e-4, "audio"), {"first": "cam2"}, False),  # beside one of which nothing is known
    ],
)
def test_clocks_are_sure_where_sound_and_geometry_agree(
    tmp_path: Path, clock: Clock, seen: dict[str, Any], sure: bool
) -> None:
    assert sure_clocks(tmp_path) == frozenset()  # nothing was checked
    clocks = {
        "cam0": Clock(0.0, 0.0, 0.0, "reference"),
        "cam1": clock,
        "cam2": Clock(0.0, 0.0, math.inf, "none"),
    }
    checked = {
        "cameras": {name: clock_dict(c) for name, c in clocks.items()},
        "pairs": [SEEN | seen, SEEN | {"second": "cam2"}],
    }
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "clock_check.json").write_text(json.dumps(checked))
    assert sure_clocks(tmp_path) == (frozenset({"cam0", "cam1"}) if sure else frozenset())


@pytest.mark.parametrize("tracked", [True, False])
@pytest.mark.parametrize("found", [ViewOffset(0.028), ViewOffset(None, "not clear")])
def test_what_is_found_moves_no_picture(
    odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: ViewOffset, tracked: bool
) -> None:
    (tmp_path / "sync").mkdir()
    clocks = {name: clock_dict(Clock(0.0, 0.0, std_s)) for name, std_s in (("witness", 0.03), ("cam0", 0.0))}
    (tmp_path / "sync" / "sync.json").write_text(json.dumps({"cameras": clocks}))
    context = Mock(
        spec=StageContext, progress=Mock(), run_dir=tmp_path, scene_dir=tmp_path, config=None, device="cpu"
    )
    monkeypatch.setattr(deformation, "flow_estimator", lambda *_: None)
    monkeypatch.setattr(deformation, "view_offset", lambda *_: found)
    model = Mock(spec=DynamicModel, movers=object() if tracked else None)
    metrics: dict[str, Any] = {"clock_offsets_s": {"cam0": 0.01}}
    told = deformation._test_clocks(context, odd_scene, model, metrics)
    assert metrics == {"clock_offsets_s": {"cam0": 0.01}}
    assert told == {
        "witness": {"std_s": 0.03, "offset_s": found.offset_s, "why": found.why}
        if tracked
        else {"std_s": 0.03, "offset_s": None, "why": deformation.FIELD}
    }
    views = [[f for f in s.dynamic if f.camera_name == "witness"] for s in (
        odd_scene, as_trained(odd_scene, metrics | {"test_clocks": told})
    )]  # fmt: skip
    assert views[0] == views[1] != []


def test_offsets_of_test_clocks_are_said(tmp_path: Path) -> None:
    clocks = {
        "one": {"std_s": 0.03, "offset_s": 0.028, "why": ""},
        "two": {"std_s": None, "offset_s": None, "why": "not clear"},
    }
    (row,) = judge(moved_clock_measures({"one": 0.028, "two": None}, "test"))
    assert row.verdict == "warn" and row.value == pytest.approx(28) and row.about == "one"
    assert "test_moving_retimed" in row.remedy and moved_clock_measures({"two": None}, "test") == []
    shown = [{"camera": camera, "time": 0.5} for camera in ("cam0", "two", "one")]
    for stage, metrics in (("evaluate", {"per_view": shown}), ("deformation", {"test_clocks": clocks})):
        (tmp_path / stage).mkdir()
        (tmp_path / stage / "metrics.json").write_text(json.dumps(metrics))
    one, two = views(RunFolder(tmp_path, stage_names(), {}))["clocks"]
    assert one.startswith("one ") and "+28 ms" in one and "(not clear)" in two


def test_pictures_of_a_test_camera_stay_whatever_its_clock(odd_scene: Scene) -> None:
    """Training pictures beyond what is modelled go; a test camera's are shown at its end."""
    moved = as_trained(odd_scene, {"clock_offsets_s": {name: 1.5 for name in ("cam0", "witness")}})
    for name, all_stay in (("witness", True), ("cam0", False)):
        before, after = ([f.index for f in s.dynamic if f.camera_name == name] for s in (odd_scene, moved))
        assert (before == after) == all_stay, name
    assert all(0 <= (f.time or 0.0) <= 1 for f in moved.dynamic)
