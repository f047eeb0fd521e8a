"""Run the stages of a scene: skip what is fresh, say why, keep what is finished whatever happens."""

import logging
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

import devrf
from devrf.capture.system.amounts import GB, counted
from devrf.capture.system.errors import DevrfError, OutOfTime
from devrf.pipelines.budget.disk import watched
from devrf.pipelines.budget.keep import OPTIONAL, Budget
from devrf.pipelines.run_folder.outcomes import error_path, forced_path, remember_error, remember_forced
from devrf.pipelines.run_folder.workspace import Workspace, free_bytes, size_of
from devrf.pipelines.runner.failure import explain
from devrf.pipelines.runner.finish import finish
from devrf.pipelines.runner.run_state import Run, check_reads, skip_line
from devrf.pipelines.runner.standing import Standing
from devrf.pipelines.runner.supervise import crash_log, tell
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stamps.stamp import read_stamp
from devrf.pipelines.terminal.console import duration
from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED, UNHEALTHY, code_of
from devrf.pipelines.terminal.logs import Events, log_file
from devrf.pipelines.terminal.signals import stopped_by_signals

logger = logging.getLogger(__name__)


def execute(run: Run) -> int:
    """Run what has to be run.

    Returns:
        The exit code; the reason has been printed.
    """
    run.talk.prepare()
    with stopped_by_signals():
        return _answered(run, lambda: _execute(run))


def _execute(run: Run) -> int:
    check_reads(run)
    with (
        Workspace(run.run_dir, run.talk.say) as workspace,
        log_file(run.run_dir, run.name),
        crash_log(run.run_dir),
    ):
        return _answered(run, lambda: _run_logged(run, workspace))  # while the log is open: it gets the trace


def _run_logged(run: Run, workspace: Workspace) -> int:
    start = time.monotonic()
    budget_gb = run.config.budget.memory_gb
    memory_budget = None if budget_gb is None else int(budget_gb * GB)
    tell(run_dir=str(run.run_dir), run=run.name, memory_budget=memory_budget)
    logger.info("devrf %s, %s, output %s", devrf.__version__, run.config.name, run.run_dir)
    run.talk.events = Events(run.run_dir, run.name)
    run.talk.event(
        "run_started",
        scene=run.config.name,
        preset=run.config.preset,
        device=run.device,
        version=devrf.__version__,
        host=socket.gethostname(),
        pid=os.getpid(),
    )
    code = _answered(run, lambda: _run_stages(run, workspace))
    run.digests.save()
    run.talk.event(
        "run_finished",
        code=code,
        seconds=round(time.monotonic() - start, 3),
        executed=run.executed,
    )
    return code


def _answered(run: Run, work: Callable[[], int]) -> int:
    """The exit code of some work; why it did not succeed is said."""
    try:
        return work()
    except DevrfError as error:
        run.talk.error(str(error), error.code)
        return code_of(error)
    except KeyboardInterrupt:
        run.talk.error("stopped; finished stages are kept, the next run goes on from there", "stopped")
        return STOPPED
    except Exception as error:
        code, of_error, message = explain(run, None, error, 0, None)
        run.talk.error(message, of_error)
        return code


def _run_stages(run: Run, workspace: Workspace) -> int:
    start = time.monotonic()
    budget = Budget(run.config, run.run_dir)
    left: list[str] = []  # optional stages for which there is no time
    for number, stage in enumerate(run.stages, 1):
        if not run.chosen(stage.name):
            run.talk.detail(f"{stage.name}: left alone (outside --from and --until)")
            continue
        now = run.standing(stage)
        run.digests.save()
        if not now.to_make:
            run.talk.event("stage_skipped", stage=stage.name, state=now.state, why=list(now.why))
            run.talk.say(skip_line(now), style="dim")
        else:
            to_come = [s.name for s in run.applying if s in run.stages[number - 1 :] and run.chosen(s.name)]
            late = budget.late(stage.name, to_come)
            if late is not None and stage.name == OPTIONAL:
                run.talk.say(f"{stage.name}: left for later: {late}", style="yellow")
                left.append(stage.name)
                continue
            if late is not None:
                run.talk.error(late, "out-of-time")
                return FAILED
            run.talk.say(
                f"[{number}/{len(run.stages)}] {stage.name}: runs: {'; '.join(now.why)}", style="bold"
            )
            run.talk.event("stage_started", stage=stage.name, why=list(now.why))
            tell(stage=stage.name)
            try:
                code = _run_stage(run, workspace, now, budget)
            finally:
                tell(stage=None)
            if code is not None:
                return code
            now = run.standing(stage, whole=True)
            stamp = read_stamp(run.run_dir / stage.name) or {}
            run.talk.event(
                "stage_finished",
                stage=stage.name,
                id=stamp.get("id"),
                seconds=now.seconds,
                peak_rss_gb=stamp.get("peak_rss_gb"),
            )
            run.talk.say(f"  {stage.name}: done in {duration(now.seconds or 0.0)}")
        if now.state == "fresh":
            run.fresh.append(stage.name)
            for of_earlier_tries in (error_path, forced_path):
                of_earlier_tries(run.run_dir, stage.name).unlink(missing_ok=True)
        code = _judge(run, now)
        if code is not None:
            return code
    count = len(run.executed)
    what = f"{counted(count, 'stage')} executed" if count else "nothing changed, no stage executed"
    run.talk.say(f"{what} in {duration(time.monotonic() - start)}; output in {run.run_dir}")
    if left:
        what = f"out of time: {', '.join(left)} is left; run again, or raise budget.time_minutes"
        run.talk.error(what, "out-of-time")
        return FAILED
    return DONE


def _judge(run: Run, now: Standing) -> int | None:
    """Say a stage's health; the exit code where it stops the run."""
    run.talk.health(now.stage.name, list(now.health))
    if now.verdict != "fail":
        return None
    if run.choice.allow_unhealthy:
        run.talk.say(f"  {now.stage.name}: unhealthy, going on (--allow-unhealthy)", style="yellow")
        return None
    failed = "\n".join(f"{row.title}: {row.remedy}" for row in now.health if row.verdict == "fail")
    run.talk.error(
        f"{now.stage.name}: its own check refused the result:\n{failed}\n"
        "The result is kept; mend the cause, or go on with --allow-unhealthy",
        "stage-unhealthy",
    )
    return UNHEALTHY


def _run_stage(run: Run, workspace: Workspace, now: Standing, budget: Budget) -> int | None:
    """Make one stage. None where it is finished, else the exit code."""
    stage, made_from = now.stage, now.made_from
    assert made_from is not None  # all that it reads has been made
    folder: Path | None = None
    context: StageContext | None = None
    try:
        if run.forced(stage.name):
            remember_forced(run.run_dir, stage.name)
        folder = workspace.new_folder(stage.name)
        folder.mkdir()

        def say(text: str, stage: str = stage.name) -> None:
            run.talk.event("decision", stage=stage, text=text.strip())
            run.talk.say(text)

        start = time.monotonic()
        with run.talk.progress(stage.name) as progress:
            context = StageContext(
                config=run.config,
                scene_dir=run.scene_dir,
                run_dir=run.run_dir,
                out=folder,
                progress=progress,
                device=run.device,
                say=say,
                made_from=made_from,
                allowance=budget.allowance(),
            )
            with watched(run.config, run.run_dir):
                stage.run(context)
        finish(run, folder, stage, context, time.monotonic() - start)
        workspace.commit(stage.name, folder)
        run.digests.renamed(folder, run.run_dir / stage.name)
        for act in context.afterwards:
            act()
        run.executed.append(stage.name)
        return None
    except BaseException as error:
        written = size_of(folder) if folder is not None else 0
        free = free_bytes(run.run_dir)
        logs = [] if folder is None else workspace.discard(folder)
        rows = context.health if context is not None else []
        if isinstance(error, KeyboardInterrupt):
            raise
        code, of_error, message = explain(run, stage, error, written, free)
        if logs:
            message += f"\nlog: {', '.join(map(str, logs))}"
        run.talk.health(stage.name, rows)
        run.talk.event("stage_failed", stage=stage.name, code=code, logs=[str(log) for log in logs])
        run.talk.error(message, of_error)
        if not isinstance(error, OutOfTime):
            remember_error(run.run_dir, stage.name, message, code, of_error)
        return code
