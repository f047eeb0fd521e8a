"""What a run folder remembers of stages that ran: health rows, why one failed, and which one is forced to run."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from devrf.capture.system.durable import read_json, sync, write_json
from devrf.capture.system.errors import InputError
from devrf.pipelines.health.judge import HealthRow
from devrf.pipelines.stamps.stamp import HEALTH, STAMP, stamp_id


def read_health(folder: Path) -> tuple[HealthRow, ...]:
    """The health rows of a finished stage."""
    try:
        rows = read_json(folder / HEALTH)["rows"]
        return tuple(HealthRow(**row) for row in rows)
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def refusals(run_dir: Path, stages: Iterable[str]) -> list[str]:
    """What the own checks of these stages refused, in words."""
    rows = ((stage, row) for stage in stages for row in read_health(run_dir / stage))
    return [
        f"{stage} is unhealthy: {row.title}; {row.remedy}" for stage, row in rows if row.verdict == "fail"
    ]


def check_made(run_dir: Path, stages: Sequence[str]) -> None:
    """Refuse to take something out of a run that is not that far.

    Args:
        run_dir: The run folder.
        stages: Names of the stages that are read, in their order.
    Raises:
        InputError: One of them is not made.
    """
    missing = [stage for stage in stages if not (run_dir / stage / STAMP).is_file()]
    if missing:
        what = "the model" if missing[0] == "canonical" else f"stage {missing[0]}"
        text = f"{run_dir}: {what} is not made yet; run the scene with --until {stages[-1]} first"
        raise InputError("stage-not-made", text)


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
