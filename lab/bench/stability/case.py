"""One case: the real pipeline on a damaged scene, in a run folder of its own, and what came of it.

What cases have in common is made once: a case begins with hard links of the undisturbed one's finished stages, of which
stamps say what still holds; a damaged stage has the damage among its inputs, so that they tell it from the real one. A
stage that fails is a result; a fault of the program or of the machine (no memory, a full disk) is none and ends the
suite, which goes on later.
"""

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from devrf.capture.measure import Verdict
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError, InputError
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.damage.intact import Damage, DoesNotApply, Intact
from devrf.pipelines.run_folder.outcomes import read_health
from devrf.pipelines.run_folder.workspace import is_disk_full
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import Stage
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.evaluate import NEEDS_TEST_VIEWS
from devrf.pipelines.stamps.code_version import code_version
from devrf.pipelines.stamps.stamp import STAMP, read_stamp
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, STOPPED
from devrf.reconstruct.evaluation.evaluate import motion_psnr

LAST = "evaluate"  # what follows shows the result and does not change it
TRAININGS = ("canonical", "deformation")
UNDISTURBED = "undisturbed"


@dataclass(frozen=True)
class Complaint:
    """A health row that warns or fails, of a kind that people in the field would see too.

    Attributes:
        stage, check, verdict, value: Of the row.
        code: Of the row: the same whichever camera it is about.
    """

    stage: str
    check: str
    verdict: Verdict
    value: float | str | None
    code: str


@dataclass(frozen=True)
class Result:
    """What came of one case.

    Attributes:
        axis, severity, seed: Which case; the axis of the undisturbed one is `UNDISTURBED`.
        stopped: What was said where a stage failed ("rig: ..."); None where the result is whole.
        psnr, lpips: Of the test views.
        psnr_moving: Of the test views, where they move; whole, where no test camera stands.
        baseline: The scene at rest in place of the test views, there too.
        rotation_deg, position_m, sync_ms: Largest errors of the fixed cameras and of the clocks; None without a truth.
        seconds: That its stages took, whether they were made for this case or for another.
        complaints: All health rows that warn or fail and need no answer to compare with.
        films_anew: Whether its test views show something else than those of the undisturbed case.
    """

    axis: str
    severity: float
    seed: int
    stopped: str | None = None
    psnr: float | None = None
    lpips: float | None = None
    psnr_moving: float | None = None
    baseline: float | None = None
    rotation_deg: float | None = None
    position_m: float | None = None
    sync_ms: float | None = None
    seconds: float = 0.0
    complaints: tuple[Complaint, ...] = ()
    films_anew: bool = False


class _Listener(Talk):
    """Prints nothing and remembers what went wrong; the run folder's log has the rest."""

    def __init__(self) -> None:
        super().__init__("quiet")
        self.out = self.err = Console(quiet=True)
        self.errors: list[tuple[str, str]] = []  # code and text

    def error(self, text: str, code: str) -> None:
        self.errors.append((code, text))
        super().error(text, code)


def run_case(
    base: Run, out: Path, axis: str, severity: float, seed: int, undisturbed: Scene | None = None
) -> tuple[Result, Path]:
    """Run one case, or go on with it.

    Args:
        base: The scene; its configuration is the undisturbed case's. Where its choice ends before `LAST`, so does the
            case, without scores.
        out: Folder of all cases.
        axis, severity, seed: Which.
        undisturbed: What the undisturbed case of the same seed made; None for that case itself.
    Returns:
        What came of it, and its run folder.
    Raises:
        DoesNotApply: The axis means nothing for this scene.
        InputError: The run folder cannot be used.
        DevrfError: The program or the machine failed, which says nothing about the damage.
    """
    folder, last = case_folder(out, axis, severity, seed), base.choice.last or LAST
    folder.mkdir(parents=True, exist_ok=True)
    config = base.config.model_copy(
        update={
            "output": str((folder / "run").resolve()),
            "reconstruct": base.config.reconstruct.model_copy(update={"seed": seed}),
            # A slow machine breaks nothing.
            "budget": base.config.budget.model_copy(update={"time_minutes": None}),
        }
    )
    done = Damage(config)
    if undisturbed is not None:
        intact = Intact(config, base.scene_dir, undisturbed, folder.resolve(), severity, seed)
        done = AXES[axis].damaging(intact)
        if done.options is not None and last != LAST:
            raise DoesNotApply("training-not-ours", "it damages the training of DeVRF alone")
    damaged = (done.stage,) if done.options is None else TRAININGS
    stages = [_damaged(s, done, folder, axis, severity, seed) if s.name in damaged else s for s in STAGES]
    _link_finished(_undisturbed_run(out, axis, seed), folder, damaged)
    heard, refusals = _Listener(), list[DevrfError]()
    watched = [_watched(stage, refusals) for stage in stages]
    run = Run(
        done.config, base.scene_dir, watched, Choice(last=last, allow_unhealthy=True), heard, base.device
    )
    code = execute(run)
    of_error, text = heard.errors[-1] if heard.errors else ("", "")
    if code == STOPPED:
        base.talk.error(text, of_error)
        raise typer.Exit(code)
    if code == BAD_INPUT:  # never of a stage: another run holds the folder, or it may not be written
        raise InputError(of_error, text)
    if code != DONE and not refusals:
        raise DevrfError(of_error, f"{axis} {severity:g}, seed {seed}: {text}")
    stopped = None if code == DONE else text.partition("\nlog: ")[0]
    result = _result(run.run_dir, axis, severity, seed, stopped, run.fresh)
    return (_scored(result, run.run_dir) if stopped is None and last == LAST else result), run.run_dir


def _result(
    run_dir: Path,
    axis: str,
    severity: float,
    seed: int,
    stopped: str | None,
    stages: Sequence[str],
) -> Result:
    """What a run folder says of a case; of stages that are the case's own, not of an earlier run's."""
    complaints = tuple(
        Complaint(stage, row.title, row.verdict, row.value, row.code)
        for stage in stages
        for row in read_health(run_dir / stage)
        if row.verdict != "ok" and row.about not in NEEDS_TEST_VIEWS
    )
    stamps = [read_stamp(run_dir / stage) or {} for stage in stages]
    seconds = sum(stamp.get("seconds") or 0.0 for stamp in stamps)
    anew = axis in AXES and AXES[axis].films_anew
    return Result(axis, severity, seed, stopped, seconds=seconds, complaints=complaints, films_anew=anew)


def _scored(result: Result, run_dir: Path) -> Result:
    """The same with what stage `evaluate` found."""
    metrics = json.loads((run_dir / LAST / "metrics.json").read_text())
    truth = metrics.get("truth", {})
    moving, baseline = motion_psnr(metrics)
    return replace(
        result,
        psnr=metrics["test"]["psnr"],
        lpips=metrics["test"]["lpips_vgg"],
        psnr_moving=moving,
        baseline=baseline,
        rotation_deg=truth.get("rig_rotation_deg"),
        position_m=truth.get("rig_position_m"),
        sync_ms=truth.get("sync_ms"),
    )


def is_made(out: Path, axis: str, severity: float, seed: int) -> bool:
    """Whether a case was run to its end already; it may have to be run again all the same."""
    return (case_folder(out, axis, severity, seed) / "run" / LAST / STAMP).is_file()


def case_folder(out: Path, axis: str, severity: float, seed: int) -> Path:
    """Where a case is."""
    return out / f"{axis}-{severity:g}" / f"seed{seed}"


def _undisturbed_run(out: Path, axis: str, seed: int) -> Path | None:
    """Run folder of the undisturbed case of a seed; for that case itself, another seed's, if there is one."""
    if axis != UNDISTURBED:
        return case_folder(out, UNDISTURBED, 0.0, seed) / "run"
    own = case_folder(out, axis, 0.0, seed)
    return next((other / "run" for other in sorted(own.parent.glob("seed*")) if other != own), None)


def _link_finished(source: Path | None, folder: Path, damaged: Sequence[str | None]) -> None:
    """Hard links of a run's finished stages in a case's run folder, for those that it lacks and no damage reaches."""
    reached = {LAST, *damaged}
    for stage in STAGES:
        target = folder / "run" / stage.name
        if stage.name in reached or reached.intersection(stage.reads):
            reached.add(stage.name)
            continue
        if source is None or target.exists() or read_stamp(source / stage.name) is None:
            continue
        half_made = folder / "linked"  # beside the run: what carries a stage's name there is complete
        shutil.rmtree(half_made, ignore_errors=True)
        shutil.copytree(source / stage.name, half_made, copy_function=_link)
        target.parent.mkdir(exist_ok=True)
        half_made.rename(target)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copy2(source, target)


def _watched(stage: Stage, refusals: list[DevrfError]) -> Stage:
    """The stage; the errors by which it says what is wrong with the scene are kept. No other is of the damage."""

    def run(context: Any) -> None:
        try:
            stage.run(context)
        except DevrfError as error:
            if not is_disk_full(error):
                refusals.append(error)
            raise

    return replace(stage, run=run)


def _damaged(stage: Stage, done: Damage, folder: Path, axis: str, severity: float, seed: int) -> Stage:
    """The stage with other options of its training, or with damage behind it."""
    file = folder / "damage.json"
    code = code_version("lab/bench/stability/damage", "lab/simulate/session")
    file.write_text(json.dumps({"axis": axis, "severity": severity, "seed": seed, "code": code}))

    def run(context: Any) -> None:
        with done.trained_otherwise(stage.name):
            stage.run(context)
        done.behind(context)

    return replace(stage, run=run, inputs=lambda *of: {**stage.inputs(*of), "damage": file})
