"""Which stages run, and why: the one place that compares stamps, for `run`, `--dry-run` and `status`."""

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from devrf.capture.durable import read_json, sync, write_json
from devrf.pipelines.health.rows import HealthRow, Verdict, worst
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.digests import Digests
from devrf.pipelines.stamps.reasons import why_stale
from devrf.pipelines.stamps.stamp import HEALTH, identity, read_stamp, stamp_id

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

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


def standing(
    stage: Stage,
    stages: Sequence[Stage],
    config: "SceneConfig",
    scene_dir: Path,
    run_dir: Path,
    digests: Digests,
    will_run: Collection[str] = (),
    *,
    whole: bool = False,
) -> Standing:
    """Compare one stage with what would make it now.

    Args:
        stage: The stage.
        stages: All stages.
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        run_dir: The run folder.
        digests: Source of content digests.
        will_run: Stages known to run before it; what reads them is stale, unless they come out the same.
        whole: Whether its files are known to be as they were left: it has only just been made.
    """
    reason = stage.applies(config)
    if reason is not None:
        return Standing(stage, "not applicable", (reason,))
    reads = reads_of(stage, stages, config)
    made_from = identity(stage, config, scene_dir, run_dir, reads, digests)
    folder = run_dir / stage.name
    stamp = read_stamp(folder)
    unknown = [name for name in reads if name in will_run]
    if stamp is None:
        state, why = "missing", ["not made yet"]
    else:
        then = stamp["identity"].get("reads")
        then = then if isinstance(then, dict) else {}
        known = {
            name: then.get(name) if name in unknown else made for name, made in made_from["reads"].items()
        }
        now = made_from | {"reads": known}
        why = why_stale(stage, folder, stamp, now, None if whole else digests)
        why += [f"{name} runs" for name in unknown]
        why += ["forced before, and not finished"] if _is_to_be_forced(run_dir, stage.name, stamp) else []
        state = "stale" if why else "fresh"
    return Standing(
        stage,
        state,
        tuple(why),
        None if stamp is None else stamp.get("seconds"),
        read_health(folder),
        last_error(run_dir, stage.name),
        None if unknown else made_from,
    )


def standings(
    stages: Sequence[Stage],
    config: "SceneConfig",
    scene_dir: Path,
    run_dir: Path,
    choice: Choice | None = None,
    digests: Digests | None = None,
) -> list[Standing]:
    """Where every stage stands, what must run before it considered.

    A stage that `choice` forces is stale; one that it leaves out does not make others stale.
    """
    choice = choice or Choice()
    digests = digests or Digests(run_dir)
    will_run: set[str] = set()
    found = []
    for stage in stages:
        now = standing(stage, stages, config, scene_dir, run_dir, digests, will_run)
        if now.state == "fresh" and is_forced(stage.name, choice):
            now = replace(now, state="stale", why=("forced",))
        if now.to_make and is_chosen(stage.name, stages, choice):
            will_run.add(stage.name)
        found.append(now)
    return found


def reads_of(stage: Stage, stages: Sequence[Stage], config: "SceneConfig") -> list[str]:
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


def _is_to_be_forced(run_dir: Path, stage: str, stamp: dict) -> bool:
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
