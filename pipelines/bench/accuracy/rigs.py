"""Rigs from a board seen by several cameras: two real captures of caliscope's, and a simulated rig.

The real ones go through the pipeline's own stages up to `sync`, then every third 0.8 s is kept
out, the rest goes into the stage's entry point, and the kept ones are measured with what came out. caliscope's own
cameras are measured on the same frames the same way. Its pictures come late and unevenly, by up to a frame, against
`timestamps.csv`; lengths are given both with the pictures of one instant taken as simultaneous and with their times
found from the board's motion.
"""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from devrf.calibration.rigs.board_route import BoardRig, rig_from_board
from devrf.calibration.rigs.cross_check import RigCheck, check_rig, hold_out
from devrf.calibration.rigs.given import read_given
from devrf.calibration.rigs.joint import disagreement, median_baseline
from devrf.calibration.rigs.synthetic import SPEC, SyntheticRig, claimed, synthetic_cameras, synthetic_views
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.capture.errors import CalibrationError, InputError
from devrf.capture.frames import FrameSet
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.rows import Row, with_goal
from devrf.pipelines.board_clips import BoardClips
from devrf.pipelines.board_spec import board_spec
from devrf.pipelines.cli_options import configured
from devrf.pipelines.exit_codes import DONE
from devrf.pipelines.joint_clips import JointViews, read_joint_views
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stages import STAGES

SESSIONS = {"caliscope_charuco_calibration": (54.08, 0.44), "caliscope_post_optimization": (53.58, 0.47)}
CALISCOPE = "caliscope's camera_array.toml, corners triangulated as if its pictures were simultaneous"
SIMULATED = "caliscope, tests/synthetic: 3 % wrong focal length refined with the poses"
SEEDS = range(6)


def rigs(cases: Cases) -> list[Row]:
    """Held-out lengths and poses of the real captures; positions and rotations of the simulated rig."""
    rows: list[Row] = []
    for name in SESSIONS:
        folder = cases.real(name)
        rows += [not_there(f"rigs/{name}", "mm", name)] if folder is None else _session(cases, name, folder)
    for case, (claim, middle_px) in {
        "focal length 3 % off, said to be known to 3 %": (0.03, 0.0),
        "focal length 3 % off, said to be known to 0.3 %": (0.003, 0.0),
        "the same, principal point known to 2 px": (0.03, 2.0),
    }.items():
        rows += _simulated(f"rigs/simulated, {case}", claim, middle_px, goal=middle_px == 0)
    return rows


def _session(cases: Cases, name: str, folder: Path) -> list[Row]:
    seen = _joint_views(cases, name, folder)
    sizes = {n: (k.width, k.height) for n, k in seen.start.items()}
    given = read_given(folder / "camera_array.toml", list(seen.views), sizes)
    if given.rig is None:
        raise CalibrationError(f"{folder.name}/camera_array.toml holds no poses")
    reference = {n: c.camera for n, c in given.rig.cameras.items()}
    fit, held = hold_out(seen.views)
    ours = rig_from_board(fit, seen.spec, seen.start, seen.known)
    theirs = rig_from_board(fit, seen.spec, given.intrinsics, given.intrinsics)
    at_once = dict.fromkeys(seen.views, 0.0)
    length, spread = SESSIONS[name]
    checks = {
        "times found": check_rig(ours.cameras, ours.delay_s, held, seen.spec),
        "as if simultaneous": check_rig(ours.cameras, at_once, held, seen.spec, timed=False),
        "caliscope's cameras, times found": check_rig(reference, ours.delay_s, held, seen.spec),
        "caliscope's cameras, as if simultaneous": check_rig(
            reference, at_once, held, seen.spec, timed=False
        ),
    }
    prefix = f"rigs/{name}"
    rows = []
    for how, check in checks.items():
        if check is not None:
            rows += _lengths(f"{prefix}/{how}", check, length, spread, goal=how == "times found")
    return [
        *rows,
        *_poses(f"{prefix}/poses against caliscope's", reference, ours, goal=True),
        *_poses(f"{prefix}/poses with caliscope's intrinsics against caliscope's", reference, theirs),
        *_clocks(prefix, ours),
    ]


def _joint_views(cases: Cases, name: str, folder: Path) -> JointViews:
    """The capture as a user would describe it, through `ingest` and `sync`."""
    work = cases.out / "rigs" / name
    work.mkdir(parents=True, exist_ok=True)
    clips = {f"cam{n}": str(folder / "calibration" / "extrinsic" / f"cam_{n}.mp4") for n in range(4)}
    write_times(folder / "calibration" / "extrinsic" / "timestamps.csv", work / "times.csv")
    board = {"type": "charuco", "squares": [4, 5], "square_m": 0.054, "marker_m": 0.0405}
    board |= {"dictionary": "DICT_4X4_1000", "joint_clips": clips}
    capture = {"cameras": clips, "timestamps": "times.csv", "board": board}
    scene = work / "scene.yaml"
    scene.write_text(yaml.safe_dump({"name": name, "output": "run", "preset": "tiny", "capture": capture}))
    config, scene_dir = configured(scene, None, None)
    run = Run(config, scene_dir, STAGES, Choice(last="sync"), cases.talk)
    if execute(run) != DONE:
        raise CalibrationError(f"{name}: the stages before the rig failed; see {run.run_dir}/devrf.log")
    spec = board_spec(config)
    if spec is None:
        raise InputError(f"{scene}: has no board")
    frames = FrameSet.read(run.run_dir / "ingest")
    return read_joint_views(BoardClips(run.run_dir, frames, spec), list(frames.moving), {})


def write_times(table: Path, out: Path) -> None:
    """caliscope's columns sync_index (one per frame), cam_id, frame_time as our table of timestamps."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    first = min(int(row["sync_index"]) for row in rows)
    lines = [f"cam{r['cam_id']},{int(r['sync_index']) - first},{r['frame_time']}" for r in rows]
    out.write_text("\n".join(["camera,frame_index,time_s", *lines]) + "\n")


def _lengths(prefix: str, check: RigCheck, length: float, spread: float, goal: bool) -> list[Row]:
    rows = [
        Row(f"{prefix}/held-out lengths, spread", check.spread_mm, "mm", anchor=spread, source=CALISCOPE),
        Row(f"{prefix}/held-out corners, rms", check.rms_px, "px"),
    ]
    median_mm = 1e3 * float(np.median(check.lengths_m))
    middle = Row(
        f"{prefix}/held-out lengths, median (true 54)", median_mm, "mm", anchor=length, source=CALISCOPE
    )
    if goal:
        rows = [with_goal(r, g, low_is_good=True) for r, g in zip(rows, (0.40, 1.0), strict=True)]
    return [*rows, middle]


def _poses(prefix: str, reference: Mapping[str, Camera], rig: BoardRig, goal: bool = False) -> list[Row]:
    differ = disagreement(reference, rig.cameras)
    turn = max(t for t, _ in differ.values())
    percent = 100 * max(s for _, s in differ.values()) / median_baseline(reference)
    rows = [
        Row(f"{prefix}, largest turn", turn, "deg"),
        Row(f"{prefix}, largest shift", percent, "% of the cameras' distance"),
    ]
    if not goal:
        return rows
    return [with_goal(r, g, low_is_good=True) for r, g in zip(rows, (0.3, 1.0), strict=True)]


def _clocks(prefix: str, rig: BoardRig) -> list[Row]:
    timing = rig.solution.problem.timing
    assert timing is not None
    worst = max(rig.delay_s.values(), key=abs)
    return [
        Row(f"{prefix}/clock that is off most, against its timestamps", 1e3 * worst, "ms"),
        Row(f"{prefix}/scatter of single pictures' times", 1e3 * timing.lag_std_s, "ms"),
        Row(f"{prefix}/noise of a corner coordinate", rig.solution.sigma_px, "px"),
    ]


def _simulated(prefix: str, claim: float, middle_px: float, goal: bool) -> list[Row]:
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
    rows = [
        Row(f"{prefix}/place at 2.5 m, median", float(np.median(shifts)), "mm", None, 1.3, SIMULATED),
        Row(f"{prefix}/rotation, median", float(np.median(turns)), "deg", None, 0.03, SIMULATED),
    ]
    if goal:
        rows = [with_goal(r, g, low_is_good=True) for r, g in zip(rows, (1.0, 0.03), strict=True)]
    return [
        *rows,
        Row(f"{prefix}/place at 2.5 m, largest", max(shifts), "mm"),
        Row(f"{prefix}/rotation, largest", max(turns), "deg"),
    ]
