"""What a user asked for, where a stage stands, and what a run folder remembers of tries that did not succeed."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devrf.capture.durable import read_json, sync, write_json
from devrf.capture.measure import Verdict
from devrf.pipelines.health.judge import HealthRow, worst
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.stamp import HEALTH, stamp_id

State = Literal["fresh", "stale", "missing", "not applicable"]


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
        made_from: What it would be made from now (`identity`); None where that depends on stages that run before it,
            or where the stage does not apply.
    """

    stage: Stage
    state: State
    why: tuple[str, ...]
    seconds: float | None = None
    health: tuple[HealthRow, ...] = ()
    error: str | None = None
    made_from: dict | None = None

    @property
    def to_make(self) -> bool:
        """Whether it has to run."""
        return self.state in ("stale", "missing")

    @property
    def verdict(self) -> Verdict | None:
        """The worst of the health rows; None where there are none."""
        return worst(row.verdict for row in self.health)


def read_health(folder: Path) -> tuple[HealthRow, ...]:
    """The health rows of a finished stage."""
    try:
        rows = read_json(folder / HEALTH)["rows"]
        return tuple(HealthRow(**row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def forced_path(run_dir: Path, stage: str) -> Path:
    """There from when a stage is forced to run until it has; holds the identity of what is to be replaced."""
    return run_dir / f".forced-{stage}"


def remember_forced(run_dir: Path, stage: str) -> None:
    """Let a run that comes after one that was stopped go on with a stage that was forced."""
    made = stamp_id(run_dir / stage)
    if made is not None:
        forced_path(run_dir, stage).write_text(made)
        sync(forced_path(run_dir, stage))


def is_to_be_forced(run_dir: Path, stage: str, stamp: dict) -> bool:
    """Whether a stage was forced to run, and is still what was to be replaced."""
    try:
        return forced_path(run_dir, stage).read_text() == stamp.get("id")
    except (OSError, ValueError):
        return False


def error_path(run_dir: Path, stage: str) -> Path:
    """Where the reason of a stage's last failure lies until it succeeds."""
    return run_dir / f".failed-{stage}.json"


def last_error(run_dir: Path, stage: str) -> str | None:
    """Why a stage failed when it was last tried."""
    try:
        return str(read_json(error_path(run_dir, stage))["message"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def remember_error(run_dir: Path, stage: str, message: str, code: int, error: str) -> None:
    """Leave the reason of a failure for `status` and the report."""
    with suppress(OSError):  # no room to remember it; it has been said
        write_json(error_path(run_dir, stage), {"message": message, "code": code, "error": error})
