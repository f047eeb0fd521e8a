"""Which stages run, and why: the one place that compares stamps, for `run`, `--dry-run` and `status`."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.rows import HealthRow
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamp import HEALTH, Digests, identity, read_stamp, why_stale, write_json

State = Literal["fresh", "stale", "missing", "not applicable"]
ALL = "all"  # --force all


@dataclass(frozen=True)
class Choice:
    """What a user asked for.

    Attributes:
        first: Stages before this one are taken as they are.
        last: Stages after this one are left alone.
        force: Stages that run even where nothing changed; "all" is every one.
        allow_unhealthy: Go on where a stage's own check refused its result.
    """

    first: str | None = None
    last: str | None = None
    force: tuple[str, ...] = ()
    allow_unhealthy: bool = False


@dataclass(frozen=True)
class Standing:
    """Where one stage stands.

    Attributes:
        stage: The stage.
        state: fresh, stale, missing or not applicable.
        why: Reasons for it.
        seconds: How long it took when it was made.
        health: What it found about its own result.
        error: Why it failed when it was last tried, if it did.
    """

    stage: Stage
    state: State
    why: tuple[str, ...]
    seconds: float | None = None
    health: tuple[HealthRow, ...] = ()
    error: str | None = None

    @property
    def verdict(self) -> Literal["ok", "warn", "fail"] | None:
        """The worst of the health rows; None where there are none."""
        verdicts = {row.verdict for row in self.health}
        return next((v for v in ("fail", "warn", "ok") if v in verdicts), None)


def standing(
    stage: Stage,
    stages: Sequence[Stage],
    config: SceneConfig,
    scene_dir: Path,
    run_dir: Path,
    digests: Digests,
    will_run: Collection[str] = (),
) -> Standing:
    """Compare one stage with what would make it now.

    Args:
        stage: The stage.
        stages: All stages.
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        run_dir: The run folder.
        digests: Source of content digests.
        will_run: Stages known to run before it; what reads them is stale.
    """
    reason = stage.applies(config)
    if reason is not None:
        return Standing(stage, "not applicable", (reason,))
    reads = reads_of(stage, stages, config)
    folder = run_dir / stage.name
    stamp = read_stamp(folder)
    error = last_error(run_dir, stage.name)
    if stamp is None:
        return Standing(stage, "missing", ("not made yet",), error=error)
    why = why_stale(folder, identity(stage, config, scene_dir, run_dir, reads, digests))
    why = [text for text in why if not any(text.startswith(f"{name} was made") for name in will_run)]
    why += [f"{name} runs" for name in reads if name in will_run]
    why += ["forced before, and not finished"] if forced_path(run_dir, stage.name).exists() else []
    seconds = stamp.get("seconds")
    state: State = "stale" if why else "fresh"
    return Standing(stage, state, tuple(why), seconds, read_health(folder), error)


def standings(
    stages: Sequence[Stage], config: SceneConfig, scene_dir: Path, run_dir: Path, choice: Choice | None = None
) -> list[Standing]:
    """Where every stage stands, what must run before it considered.

    A stage that `choice` forces is stale; one that it leaves out does not make others stale.
    """
    choice = choice or Choice()
    digests = Digests(run_dir)
    will_run: set[str] = set()
    found = []
    for stage in stages:
        now = standing(stage, stages, config, scene_dir, run_dir, digests, will_run)
        if now.state == "fresh" and is_forced(stage.name, choice):
            now = replace(now, state="stale", why=("forced",))
        if now.state in ("stale", "missing") and is_chosen(stage.name, stages, choice):
            will_run.add(stage.name)
        found.append(now)
    return found


def reads_of(stage: Stage, stages: Sequence[Stage], config: SceneConfig) -> list[str]:
    """The stages that one reads, without those that do not apply."""
    applying = {other.name for other in stages if other.applies(config) is None}
    return [name for name in stage.reads if name in applying]


def is_chosen(name: str, stages: Sequence[Stage], choice: Choice) -> bool:
    """Whether a stage lies between --from and --until."""
    names = [stage.name for stage in stages]
    first = names.index(choice.first) if choice.first else 0
    last = names.index(choice.last) if choice.last else len(names) - 1
    return first <= names.index(name) <= last


def is_forced(name: str, choice: Choice) -> bool:
    """Whether a stage runs even where nothing changed."""
    return name in choice.force or ALL in choice.force


def read_health(folder: Path) -> tuple[HealthRow, ...]:
    """The health rows of a finished stage."""
    try:
        rows = json.loads((folder / HEALTH).read_text())["rows"]
        return tuple(HealthRow(**row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def forced_path(run_dir: Path, stage: str) -> Path:
    """There from when a stage is forced to run until it has: a run that was stopped goes on with it."""
    return run_dir / f".forced-{stage}"


def error_path(run_dir: Path, stage: str) -> Path:
    """Where the reason of a stage's last failure lies until it succeeds."""
    return run_dir / f".failed-{stage}.json"


def last_error(run_dir: Path, stage: str) -> str | None:
    """Why a stage failed when it was last tried."""
    try:
        return str(json.loads(error_path(run_dir, stage).read_text())["message"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def remember_error(run_dir: Path, stage: str, message: str, code: int) -> None:
    """Leave the reason of a failure for `status` and the report."""
    try:
        write_json(error_path(run_dir, stage), {"message": message, "code": code})
    except OSError:
        pass  # no room to remember it; it has been said
