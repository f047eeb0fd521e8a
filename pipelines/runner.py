"""Run the stages of a scene: skip what is fresh, say why, keep what is finished whatever happens."""

import errno
import json
import logging
import math
import os
import platform
import resource
import secrets
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import FrameType
from typing import Any

import devrf
from devrf.capture.errors import DevrfError, HealthError, InputError
from devrf.capture.progress import Progress
from devrf.pipelines.budget.keep import OPTIONAL, Budget
from devrf.pipelines.cache import Cache, cache_of
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import Talk, duration
from devrf.pipelines.digests import Digests
from devrf.pipelines.durable import write_json
from devrf.pipelines.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED, UNHEALTHY
from devrf.pipelines.health.rows import HealthRow
from devrf.pipelines.logs import LOG_FILE, Events, log_file, new_run_name
from devrf.pipelines.plan import (
    Choice,
    Standing,
    error_path,
    forced_path,
    is_chosen,
    is_forced,
    remember_error,
    remember_forced,
    standing,
    standings,
)
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stamp import HEALTH, STAMP, code_of_stage, content_of, files_of, read_stamp
from devrf.pipelines.supervise import crash_log, tell
from devrf.pipelines.workspace import Workspace, disk_full_message, free_bytes, is_disk_full, size_of

NO_ROOM = 1_000_000  # bytes: with less than this free, a failure to write is a full disk whatever it says
NO_MEMORY = (
    "out of memory",
    "allocate memory",
    "bad_alloc",
    "bad allocation",
    "insufficient memory",
)  # messages
AGAIN_S = 0.01  # after which a signal that was lost is raised again
NEEDS_SWEEP = "canonical"  # the first stage that cannot do without a sweep

logger = logging.getLogger(__name__)


@dataclass
class Run:
    """One call of `devrf-pipeline run`.

    Attributes:
        config: The checked configuration.
        scene_dir: Folder of scene.yaml.
        stages: The pipeline.
        choice: Which stages to run.
        talk: Where to speak.
        device: "cpu" or "cuda".
        name: Its name in logs, events and stamps.
        executed: The stages that were made.
        taken: The stages that were taken from the cache.
        fresh: Those, and the ones that were skipped because nothing they depend on has changed.
    """

    config: SceneConfig
    scene_dir: Path
    stages: Sequence[Stage]
    choice: Choice
    talk: Talk
    device: str = "cpu"
    name: str = field(default_factory=new_run_name)
    executed: list[str] = field(default_factory=list)
    taken: list[str] = field(default_factory=list)
    fresh: list[str] = field(default_factory=list)

    @property
    def run_dir(self) -> Path:
        """The run folder."""
        return self.config.run_dir(self.scene_dir)

    @cached_property
    def digests(self) -> Digests:
        """Content digests, remembered from one look at the files to the next."""
        return Digests(self.run_dir)

    @cached_property
    def cache(self) -> Cache | None:
        """Where finished stages are kept."""
        return cache_of(self.config, self.scene_dir)

    def standings(self) -> list[Standing]:
        """Where every stage stands."""
        return standings(
            self.stages, self.config, self.scene_dir, self.run_dir, self.choice, self.digests, self.cache
        )

    def standing(self, stage: Stage) -> Standing:
        """Where one stage stands, those before it as they are."""
        return standing(
            stage, self.stages, self.config, self.scene_dir, self.run_dir, self.digests, self.cache
        )


def check_choice(config: SceneConfig, stages: Sequence[Stage], choice: Choice) -> None:
    """Refuse stage names that do not exist and ranges that make no sense.

    Raises:
        InputError: With every mistake.
    """
    names = [stage.name for stage in stages]
    mistakes = []
    options = [("--from", choice.first), ("--until", choice.last), *(("--force", s) for s in choice.force)]
    for option, name in options:
        if name is not None and name not in names and not (option == "--force" and name == "all"):
            mistakes.append(f"{option} {name}: no such stage; expected {', '.join(names)}")
    if not mistakes:
        if choice.first and choice.last and names.index(choice.first) > names.index(choice.last):
            mistakes.append(f"--from {choice.first} --until {choice.last}: the first comes after the last")
        for option, name in options:
            reason = next((s.applies(config) for s in stages if s.name == name), None)
            if reason and not (option == "--until" and config.kind != "cameras"):
                mistakes.append(f"{option} {name}: the stage does not apply: {reason}")
        until = choice.last or names[-1]
        if config.kind == "cameras" and NEEDS_SWEEP in names and not mistakes:
            if names.index(until) >= names.index(NEEDS_SWEEP):
                mistakes.append(
                    "capture.static: is missing; without a sweep of the scene at rest there is nothing to "
                    "reconstruct from: add one, or run with --until flow"
                )
    if mistakes:
        raise InputError("\n".join(mistakes))


def check_reads(run: Run, remedy: str | None = None) -> None:
    """Refuse to start at a stage that reads what neither is made nor will be.

    Raises:
        InputError: With the remedy; None advises to start at the first stage that is missing.
    """
    applying = [stage for stage in run.stages if stage.applies(run.config) is None]
    unmade = [stage.name for stage in applying if not (run.run_dir / stage.name).is_dir()]
    chosen = [stage for stage in applying if is_chosen(stage.name, run.stages, run.choice)]
    made = {stage.name for stage in chosen}
    for stage in chosen:
        missing = [name for name in stage.reads if name in unmade and name not in made]
        if missing:
            raise InputError(
                f"{stage.name} reads {', '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} "
                f"not made yet; {remedy or f'run without --from, or --from {unmade[0]}'}"
            )


def dry_run(run: Run) -> None:
    """Say what `execute` would do, and touch nothing."""
    for now in run.standings():
        name = now.stage.name
        if not is_chosen(name, run.stages, run.choice):
            run.talk.say(f"{name}: left alone (outside --from and --until)")
        elif now.state in ("fresh", "not applicable"):
            run.talk.say(_skip_line(now))
        else:
            would = "run" if now.cached is None else "be taken from the cache"
            run.talk.say(f"{name}: would {would}: {'; '.join(now.why)}")


def execute(run: Run) -> int:
    """Run what has to be run.

    Returns:
        The exit code; the reason has been printed.
    """
    with _stopped_by_signals():
        return _answered(run, lambda: _execute(run))


def _execute(run: Run) -> int:
    check_reads(run)
    with (
        Workspace(run.run_dir, run.talk.say) as workspace,
        log_file(run.run_dir, run.name),
        crash_log(run.run_dir),
    ):
        start = time.monotonic()
        budget_gb = run.config.budget.memory_gb
        memory_budget = None if budget_gb is None else int(budget_gb * 1e9)
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
            taken=run.taken,
        )
        return code


def _answered(run: Run, work: Callable[[], int]) -> int:
    """The exit code of some work; why it did not succeed is said."""
    try:
        return work()
    except InputError as error:
        run.talk.error(str(error))
        return BAD_INPUT
    except DevrfError as error:
        run.talk.error(str(error))
        return FAILED
    except KeyboardInterrupt:
        run.talk.error("stopped; finished stages are kept, the next run goes on from there")
        return STOPPED
    except Exception as error:
        logger.debug("%s", "".join(traceback.format_exception(error)))
        if is_disk_full(error):
            run.talk.error(disk_full_message(run.run_dir, "the run", 0))
        elif _is_no_memory(error):
            run.talk.error(
                f"not enough memory to go on ({_first_line(error)}); close other programs, then run again"
            )
        else:
            run.talk.error(_unexpected(run, error))
        return FAILED


def _run_stages(run: Run, workspace: Workspace) -> int:
    start = time.monotonic()
    budget = Budget(run.config, run.scene_dir, run.run_dir, run.device)
    left: list[str] = []  # optional stages for which there is no time
    for number, stage in enumerate(run.stages, 1):
        if not is_chosen(stage.name, run.stages, run.choice):
            run.talk.detail(f"{stage.name}: left alone (outside --from and --until)")
            continue
        now = run.standing(stage)
        run.digests.save()
        if now.state == "not applicable" or (now.state == "fresh" and not is_forced(stage.name, run.choice)):
            run.talk.event("stage_skipped", stage=stage.name, state=now.state, why=list(now.why))
            run.talk.say(_skip_line(now), style="dim")
        else:
            _keep(run, stage)
            why = "; ".join(now.why) or "forced"
            from_cache = now.cached is not None and not is_forced(stage.name, run.choice)
            late = None if from_cache else budget.late(stage.name, _to_come(run, stage))
            if late is not None and stage.name == OPTIONAL:
                run.talk.say(f"{stage.name}: left for later: {late}", style="yellow")
                left.append(stage.name)
                continue
            if late is not None:
                run.talk.error(late)
                return FAILED
            does = "taken from the cache" if from_cache else "runs"
            run.talk.say(f"[{number}/{len(run.stages)}] {stage.name}: {does}: {why}", style="bold")
            run.talk.event("stage_started", stage=stage.name, why=list(now.why) or ["forced"])
            tell(stage=stage.name)
            code = _run_stage(run, workspace, now, from_cache, budget)
            tell(stage=None)
            if code is not None:
                return code
            now = run.standing(stage)
            stamp = read_stamp(run.run_dir / stage.name) or {}
            run.talk.event(
                "stage_finished",
                stage=stage.name,
                from_cache=stage.name in run.taken,
                id=stamp.get("id"),
                seconds=now.seconds,
                peak_rss_gb=stamp.get("peak_rss_gb"),
            )
            if stage.name in run.executed:
                run.talk.say(f"  {stage.name}: done in {duration(now.seconds or 0.0)}")
                _keep(run, stage)
        if now.state == "fresh":
            run.fresh.append(stage.name)
            for of_earlier_tries in (error_path, forced_path):
                of_earlier_tries(run.run_dir, stage.name).unlink(missing_ok=True)
        code = _judge(run, now)
        if code is not None:
            return code
    made = [(len(run.executed), "executed"), (len(run.taken), "taken from the cache")]
    counts = [f"{count} stage{'s' if count != 1 else ''} {how}" for count, how in made if count]
    what = ", ".join(counts) or "nothing changed, no stage executed"
    run.talk.say(f"{what} in {duration(time.monotonic() - start)}; output in {run.run_dir}")
    if left:
        run.talk.error(f"out of time: {', '.join(left)} is left; run again, or raise budget.time_minutes")
        return FAILED
    return DONE


def _to_come(run: Run, stage: Stage) -> list[str]:
    """Names of a stage and of those that follow it in this run."""
    rest = run.stages[list(run.stages).index(stage) :]
    return [
        s.name for s in rest if s.applies(run.config) is None and is_chosen(s.name, run.stages, run.choice)
    ]


def _judge(run: Run, now: Standing) -> int | None:
    """Say a stage's health; the exit code where it stops the run."""
    run.talk.health(now.stage.name, list(now.health))
    if now.verdict != "fail":
        return None
    if run.choice.allow_unhealthy:
        run.talk.say(f"  {now.stage.name}: unhealthy, going on (--allow-unhealthy)", style="yellow")
        return None
    failed = "\n".join(f"{row.check}: {row.remedy}" for row in now.health if row.verdict == "fail")
    run.talk.error(
        f"{now.stage.name}: its own check refused the result:\n{failed}\n"
        "The result is kept; mend the cause, or go on with --allow-unhealthy"
    )
    return UNHEALTHY


def _run_stage(run: Run, workspace: Workspace, now: Standing, from_cache: bool, budget: Budget) -> int | None:
    """Make one stage, or take it from the cache. None where it is finished, else the exit code."""
    stage, made_from = now.stage, now.made_from
    assert made_from is not None  # all that it reads has been made
    folder: Path | None = None
    context: StageContext | None = None
    try:
        if is_forced(stage.name, run.choice):
            remember_forced(run.run_dir, stage.name)
        folder = workspace.fresh_folder(stage.name)
        if from_cache and run.cache is not None:
            if run.cache.take(stage, made_from, folder):
                workspace.commit(stage.name, folder)
                run.taken.append(stage.name)
                return None
            run.talk.say(f"  {stage.name}: runs: what the cache had is damaged or gone")
        say = partial(run.talk.decision, stage.name)
        allowance = budget.allowance(stage.name, say)
        start = time.monotonic()
        with run.talk.progress(stage.name) as progress:
            context = StageContext(
                config=run.config,
                scene_dir=run.scene_dir,
                run_dir=run.run_dir,
                out=folder,
                progress=_sane(progress),
                device=run.device,
                say=say,
                made_from=made_from,
                allowance=allowance,
            )
            with budget.watched():
                stage.run(context)
        _finish(run, folder, stage, context.health, made_from, time.monotonic() - start)
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
        code, message = _explain(run, stage, error, written, free)
        if logs:
            message += f"\nlog: {', '.join(map(str, logs))}"
        run.talk.health(stage.name, rows)
        run.talk.event("stage_failed", stage=stage.name, code=code, logs=[str(log) for log in logs])
        run.talk.error(message)
        remember_error(run.run_dir, stage.name, message, code)
        return code


def _explain(run: Run, stage: Stage, error: BaseException, written: int, free: int | None) -> tuple[int, str]:
    """Exit code and message of a stage's failure; the trace goes to the log."""
    trace = "".join(traceback.format_exception(error))
    logger.debug("%s", trace)
    name = stage.name
    if is_disk_full(error) or (free is not None and free < NO_ROOM and not isinstance(error, HealthError)):
        return FAILED, f"{name}: {disk_full_message(run.run_dir, name, written)}"
    if isinstance(error, HealthError):
        return UNHEALTHY, f"{name}: {error}"
    if isinstance(error, DevrfError):
        return FAILED, f"{name}: {error}"
    if _is_no_memory(error):
        budget, on_gpu = run.config.budget.gpu_memory_gb, not isinstance(error, MemoryError)
        bounded = budget is not None and run.device == "cuda" and on_gpu
        remedy = f"raise budget.gpu_memory_gb ({budget:g})" if bounded else "close other programs"
        return FAILED, (
            f"{name}: not enough memory ({_first_line(error)}); {remedy}, or use "
            "--preset tiny, or lower reconstruct.image_scale, reconstruct.rays or reconstruct.resolution"
        )
    if isinstance(error, SystemExit):
        return (
            FAILED,
            f"{name}: a library ended the program (exit {error.code}); see devrf.log in {run.run_dir}",
        )
    if run.talk.loudness == "verbose":
        run.talk.err.print(trace, markup=False)
    return FAILED, f"{name}: {_unexpected(run, error)}"


def _unexpected(run: Run, error: BaseException) -> str:
    return (
        f"unexpected {type(error).__name__}: {error}. This is a fault of the program, not of your files; the whole "
        f"trace is in {run.run_dir / LOG_FILE}"
    )


def _is_no_memory(error: BaseException) -> bool:
    """Whether an error says that memory has run out, in Python's words or a library's."""
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in NO_MEMORY)


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _finish(
    run: Run, folder: Path, stage: Stage, health: list[HealthRow], made_from: dict, seconds: float
) -> None:
    """Write health and, last of all, the stamp that makes the folder complete."""
    rows = [_finite(row.as_dict()) for row in health]
    write_json(folder / HEALTH, {"stage": stage.name, "rows": rows})
    files = files_of(folder, run.digests)
    stamp = {
        "id": secrets.token_hex(8),
        "stage": stage.name,
        "content": content_of(stage, folder, files, made_from),
        "identity": json.loads(json.dumps(made_from)),
        "version": devrf.__version__,
        "made_with": {
            "python": platform.python_version(),
            "device": run.device,
            **code_of_stage(stage, run.config).libraries,
        },
        "run": run.name,
        "finished": time.strftime("%Y-%m-%d %H:%M:%S"),
        "seconds": round(seconds, 3),
        "peak_rss_gb": round(_peak_rss_gb(), 3),
        "files": files,
    }
    write_json(folder / STAMP, stamp)


def _keep(run: Run, stage: Stage) -> None:
    """Keep a finished stage in the cache, if there is one; without room there the run goes on."""
    if run.cache is not None:
        try:
            run.cache.keep(stage, run.run_dir / stage.name)
        except OSError as error:
            run.talk.say(f"  {stage.name}: not kept in the cache {run.cache.folder}: {error}", style="yellow")


def _finite(row: dict) -> dict:
    """JSON knows no infinity: say it in words."""
    return {
        key: str(value) if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def _peak_rss_gb() -> float:
    """Largest resident memory of this process or of one of its children so far, GB."""
    kilobytes = max(
        resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return kilobytes * (1024 if sys.platform != "darwin" else 1) / 1e9


def _skip_line(now: Standing) -> str:
    if now.state == "not applicable":
        return f"{now.stage.name}: does not apply: {now.why[0]}"
    return f"{now.stage.name}: skipped: nothing it depends on has changed"


def _sane(progress: Progress) -> Progress:
    """Keep fractions in [0, 1]: a bar must not be what breaks a stage."""

    def clamped(fraction: float, message: str) -> None:
        progress(min(max(float(fraction), 0.0), 1.0) if math.isfinite(fraction) else 0.0, message)

    return clamped


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does, wherever either comes; without effect but in the main thread."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def again(unraisable: Any) -> None:
        """Where nothing can be raised (a callback of the garbage collector) Python would only print it."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            return hook(unraisable)
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook, sys.unraisablehook = sys.unraisablehook, again
    previous = {sign: signal.signal(sign, stop) for sign in (signal.SIGTERM, signal.SIGALRM)}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for sign, handler in previous.items():
            signal.signal(sign, handler)
        sys.unraisablehook = hook
