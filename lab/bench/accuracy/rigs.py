"""Rigs from a board seen by several cameras: two real captures of caliscope's, and a simulated rig.

The real ones go through the pipeline's own stages up to `sync`, then every third 0.8 s is kept
out, the rest goes into the stage's entry point, and the kept ones are measured with what came out. caliscope's own
cameras are measured on the same frames the same way. Its pictures come late and unevenly, by up to a frame, against
`timestamps.csv`; lengths are given both with the pictures of one instant taken as simultaneous and with their times
found from the board's motion.
"""

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from devrf.calibration.rigs.board_route import BoardRig, rig_from_board
from devrf.calibration.rigs.cross_check import RigCheck, check_rig, hold_out
from devrf.calibration.rigs.given import read_given
from devrf.calibration.rigs.joint import disagreement, median_baseline
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.capture.frames import FrameSet
from devrf.capture.system.errors import CalibrationError
from devrf.lab.bench.accuracy.cases import Cases
from devrf.lab.bench.accuracy.synthetic_rig import (
    SPEC,
    SyntheticRig,
    claimed,
    synthetic_cameras,
    synthetic_views,
)
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.inputs.board_clips import BoardClips
from devrf.pipelines.inputs.board_spec import board_spec
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.rig.joint_clips import JointViews, read_joint_views
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE
from devrf.pipelines.terminal.shared_options import configured

SESSIONS = {"caliscope_charuco_calibration": (54.08, 0.44), "caliscope_post_optimization": (53.58, 0.47)}
"""Median and spread of held-out lengths that caliscope reaches, mm."""
EXTRINSIC = "calibration/extrinsic"
CALISCOPE = "caliscope's camera_array.toml, corners triangulated as if its pictures were simultaneous"
BOARD = {
    "type": "charuco", "squares": [4, 5], "square_m": 0.054, "marker_m": 0.0405, "dictionary": "DICT_4X4_1000",
}  # fmt: skip
SPREAD_MM, CORNERS_PX, TURN_DEG, SHIFT_PERCENT = 0.40, 1.0, 0.3, 1.0  # goals
SIMULATED = "caliscope, tests/synthetic: 3 % wrong focal length refined with the poses"
CLAIMS = {
    "focal length 3 % off, said to be known to 3 %": (0.03, 0.0),
    "focal length 3 % off, said to be known to 0.3 %": (0.003, 0.0),
    "the same, principal point known to 2 px": (0.03, 2.0),
}
"""By case of the simulated rig: the stated doubt of focal lengths (relative) and of principal points (px)."""
SEEDS = range(6)


def rigs(cases: Cases) -> list[Row]:
    """Held-out lengths and poses of the real captures; positions and rotations of the simulated rig."""
    rows: list[Row] = []
    for name in SESSIONS:
        rows += cases.measured(name, f"rigs/{name}", "mm", partial(_session, cases))
    for case, (claim, middle_px) in CLAIMS.items():
        rows += _simulated(f"rigs/simulated, {case}", claim, middle_px)
    return rows


def run_caliscope(work: Path, folder: Path, last: str, more: Mapping[str, Any], talk: Talk) -> Run:
    """A capture of caliscope's as a user would describe it, through the stages up to `last`."""
    _write_times(folder / EXTRINSIC / "timestamps.csv", work / "times.csv")
    capture = {"cameras": _clips(folder), "timestamps": "times.csv"} | more.get("capture", {})
    content = {"name": folder.name, "output": "run", "preset": "tiny", **more, "capture": capture}
    (work / "scene.yaml").write_text(yaml.safe_dump(content))
    config, scene_dir = configured(work, None, None)
    run = Run(config, scene_dir, STAGES, Choice(last=last), talk)
    if execute(run) != DONE:
        text = f"{folder.name}: a stage up to {last} failed; see {run.run_dir}/devrf.log"
        raise CalibrationError("stage-failed", text)
    return run


def _clips(folder: Path) -> dict[str, str]:
    return {f"cam{n}": str(folder / EXTRINSIC / f"cam_{n}.mp4") for n in range(4)}


def _write_times(table: Path, out: Path) -> None:
    """caliscope's columns sync_index (one per frame), cam_id, frame_time as our table of timestamps."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    first = min(int(row["sync_index"]) for row in rows)
    lines = [f"cam{r['cam_id']},{int(r['sync_index']) - first},{r['frame_time']}" for r in rows]
    out.write_text("\n".join(["camera,frame_index,time_s", *lines]) + "\n")


def _session(cases: Cases, prefix: str, folder: Path) -> list[Row]:
    seen = _joint_views(cases.folder(prefix), folder, cases.talk)
    sizes = {n: (k.width, k.height) for n, k in seen.start.items()}
    given = read_given(folder / "camera_array.toml", list(seen.views), sizes)
    if given.rig is None:
        raise CalibrationError("rig-without-poses", f"{folder.name}/camera_array.toml holds no poses")
    reference = {n: c.camera for n, c in given.rig.cameras.items()}
    fit, held = hold_out(seen.views)
    ours = rig_from_board(fit, seen.spec, seen.start, seen.known)
    theirs = rig_from_board(fit, seen.spec, given.intrinsics, given.intrinsics)
    at_once = dict.fromkeys(seen.views, 0.0)
    rows = []
    for how, cameras, timed in (
        ("times found", ours.cameras, True),
        ("as if simultaneous", ours.cameras, False),
        ("caliscope's cameras, times found", reference, True),
        ("caliscope's cameras, as if simultaneous", reference, False),
    ):
        check = check_rig(cameras, ours.delay_s if timed else at_once, held, seen.spec, timed=timed)
        if check is not None:
            rows += _lengths(f"{prefix}/{how}", check, *SESSIONS[folder.name], judged=how == "times found")
    timing = ours.solution.problem.timing
    assert timing is not None
    worst = max(ours.delay_s.values(), key=abs)
    return [
        *rows,
        *_poses(f"{prefix}/poses against caliscope's", reference, ours, judged=True),
        *_poses(f"{prefix}/poses with caliscope's intrinsics against caliscope's", reference, theirs),
        Row(f"{prefix}/clock that is off most, against its timestamps", 1e3 * worst, "ms"),
        Row(f"{prefix}/scatter of single pictures' times", 1e3 * timing.lag_std_s, "ms"),
        Row(f"{prefix}/noise of a corner coordinate", ours.solution.sigma_px, "px"),
    ]


def _joint_views(work: Path, folder: Path, talk: Talk) -> JointViews:
    board = {"capture": {"board": BOARD | {"joint_clips": _clips(folder)}}}
    run = run_caliscope(work, folder, "sync", board, talk)
    spec = board_spec(run.config)
    assert spec is not None
    frames = FrameSet.read(run.run_dir / "ingest")
    return read_joint_views(BoardClips(run.run_dir, frames, spec), list(frames.moving), {})


def _lengths(prefix: str, check: RigCheck, length: float, spread: float, judged: bool) -> list[Row]:
    at, median = f"{prefix}/held-out", 1e3 * float(np.median(check.lengths_m))
    apart = Row(f"{at} lengths, spread", check.spread_mm, "mm", anchor=spread, source=CALISCOPE)
    return [
        apart.at_most(SPREAD_MM if judged else None),
        Row(f"{at} corners, rms", check.rms_px, "px").at_most(CORNERS_PX if judged else None),
        Row(f"{at} lengths, median (true 54)", median, "mm", anchor=length, source=CALISCOPE),
    ]


def _poses(prefix: str, reference: Mapping[str, Camera], rig: BoardRig, judged: bool = False) -> list[Row]:
    turns, shifts = zip(*disagreement(reference, rig.cameras).values(), strict=True)
    percent = 100 * max(shifts) / median_baseline(reference)
    shift = Row(f"{prefix}, largest shift", percent, "% of the cameras' distance")
    return [
        Row(f"{prefix}, largest turn", max(turns), "deg").at_most(TURN_DEG if judged else None),
        shift.at_most(SHIFT_PERCENT if judged else None),
    ]


def _simulated(prefix: str, claim: float, middle_px: float) -> list[Row]:
    turns, shifts = [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        rig = SyntheticRig()
        truth = synthetic_cameras(rig, rng)
        views = synthetic_views(rig, truth, rng)
        known = {n: claimed(c, rng, 0.03, claim, middle_px) for n, c in truth.items()}
        found = rig_from_board(views, SPEC, known, known)
        for name in list(truth)[1:]:
            ours, true = found.cameras[name], truth[name]
            turns.append(rotation_angle_deg(ours.cam_from_world[:, :3], true.cam_from_world[:, :3]))
            shifts.append(1e3 * float(np.linalg.norm(ours.centre - true.centre)))
    rows = []
    for what, values, unit, anchor, goal in (
        ("place at 2.5 m", shifts, "mm", 1.3, 1.0),
        ("rotation", turns, "deg", 0.03, 0.03),
    ):
        median = Row(f"{prefix}/{what}, median", float(np.median(values)), unit, None, anchor, SIMULATED)
        rows += [
            median.at_most(goal if middle_px == 0 else None),
            Row(f"{prefix}/{what}, largest", max(values), unit),
        ]
    return rows
