"""Clocks on disk, as stage `sync` and the check by geometry write them."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from devrf.calibration.clocks.equations import Clock
from devrf.capture.system.durable import read_json, read_object

if TYPE_CHECKING:  # they bring OpenCV, which reading clocks does not need
    from devrf.calibration.clocks.cues import LagCurve
    from devrf.calibration.clocks.geometry import PairCheck

SURE_S = 5e-3  # standard deviation of a clock that is good to measure by: those by sound are better


def clock_dict(clock: Clock) -> dict[str, Any]:
    """A clock as it is written to `sync.json` and `clock_check.json`."""
    return asdict(clock) | {"std_s": clock.std_s if math.isfinite(clock.std_s) else None}


def curve_dict(curve: "LagCurve | PairCheck") -> dict[str, Any]:
    """How well clips agree at each lag, as `curves.json` and `clock_check.json` have it."""
    lags_s, values = curve.lags_s.tolist(), curve.values.tolist()
    rounded = {"lags_s": [round(x, 6) for x in lags_s], "values": [round(x, 5) for x in values]}
    return asdict(curve) | rounded


def read_clocks(run_dir: Path, joint: bool = False) -> dict[str, Clock]:
    """The moving cameras' clocks as stage `sync` wrote them; empty where it did not.

    Args:
        run_dir: The run folder.
        joint: Also those of clips that only show the board, under the clips' own names.
    """
    content = read_object(run_dir / "sync" / "sync.json")
    clips = content.get("joint", {}).get("cameras", {}) if joint else {}
    return _clocks({**clips, **content.get("cameras", {})})


def clocks_in_use(run_dir: Path) -> dict[str, Clock]:
    """The clocks that gave the scene its times: those of stage `sync`, unless geometry replaced some of them."""
    checked = read_object(run_dir / "scene" / "clock_check.json")
    return _clocks(checked["cameras"]) if checked else read_clocks(run_dir)


def sure_clocks(run_dir: Path) -> frozenset[str]:
    """Training cameras whose times sound and the geometry of what moves agree on, each to `SURE_S`.

    Geometry must agree with sound between a camera and another one that sound knows: the two would have to lag alike.
    """
    checked = read_object(run_dir / "scene" / "clock_check.json")
    clocks = _clocks(checked.get("cameras", {}))
    heard = {name for name, clock in clocks.items() if clock.heard_within(SURE_S)}

    def agree(pair: Mapping[str, Any]) -> bool:
        # Runs of an earlier version do not say whether a pair is shifted.
        return pair["sharp"] and pair.get("shifted") is False and pair["std_s"] <= SURE_S

    pairs = [{pair["first"], pair["second"]} for pair in checked.get("pairs", ()) if agree(pair)]
    return frozenset[str]().union(*(pair for pair in pairs if pair <= heard))


def read_contradictions(run_dir: Path) -> dict[str | None, float | None]:
    """Largest contradiction between pairs of cameras, seconds: of those that are trained on (None), of test cameras."""
    content = read_json(run_dir / "sync" / "sync.json")
    tests = {name: entry["loop_s"] for name, entry in content.get("tests", {}).items()}
    return {None: content.get("loop_s"), **tests}


def _clocks(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Clock]:
    """What `clock_dict` wrote of each."""
    return {
        name: Clock(**{**entry, "std_s": math.inf if entry["std_s"] is None else entry["std_s"]})
        for name, entry in entries.items()
    }
