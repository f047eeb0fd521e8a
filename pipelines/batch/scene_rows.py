"""What a batch knows of each of its scenes: a row of the summary, filled from what the stages left."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from devrf.capture.system.durable import read_json
from devrf.pipelines.health.judge import worst
from devrf.pipelines.run_folder.outcomes import read_health
from devrf.pipelines.stamps.stamp import read_stamp
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED, UNHEALTHY

State = Literal["waiting", "running", "done", "failed", "unhealthy", "refused", "stopped"]
STATE_OF: dict[int, State] = {
    DONE: "done",
    FAILED: "failed",
    UNHEALTHY: "unhealthy",
    BAD_INPUT: "refused",
    STOPPED: "stopped",
}
WORST_FIRST = (STOPPED, FAILED, UNHEALTHY, BAD_INPUT)  # which code speaks for a batch (docs/batch.md)
STOPPED_MESSAGE = "finished stages are kept; the next batch goes on from there"
MEASURES = ("psnr", "ssim", "lpips_vgg", "lpips_alex")


@dataclass
class SceneRow:
    """One scene.

    Attributes:
        scene: Its scene.yaml.
        name: What it is called.
        output: Its run folder, where its configuration could be read.
        state: Where it stands.
        code: Exit code, where it has come to an end.
        message: What went wrong.
        stages: Stage -> seconds it took when it was made, and the verdict of its health rows.
        made: Stages that this batch made.
        nodes: Machines that worked on it, in order.
        lost: How often a machine was lost on the way.
        seconds: Time that tasks of this batch took.
        verdict: The worst of its health rows.
        numbers: Image measures of its test views (evaluate/metrics.json).
        report: Its report, where there is one.
        before: Stage -> identity of its making before the batch (not in the summary).
    """

    scene: str
    name: str
    output: str | None
    state: State = "waiting"
    code: int | None = None
    message: str | None = None
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    made: list[str] = field(default_factory=list)
    nodes: list[str] = field(default_factory=list)
    lost: int = 0
    seconds: float = 0.0
    verdict: str | None = None
    numbers: dict[str, float] = field(default_factory=dict)
    report: str | None = None
    before: dict[str, str | None] | None = None

    def end(self, code: int, message: str | None = None) -> None:
        """It will not be gone on with; a code that none of ours is (a library's, a signal's) counts as a failure."""
        if code == STOPPED:
            message = STOPPED_MESSAGE
        self.code, self.message = (
            (code, message) if code in STATE_OF else (FAILED, message or f"exit code {code}")
        )
        self.state = STATE_OF[self.code]

    def look(self, folder: Path, stages: list[str]) -> None:
        """Take what the stages left: times, health, measures, the report.

        Args:
            folder: Where their folders lie.
            stages: Those that belong to the batch.
        """
        found, ids = {}, {}
        for stage in stages:
            stamp = read_stamp(folder / stage)
            if stamp is not None:
                ids[stage] = stamp.get("id")
                verdict = worst(row.verdict for row in read_health(folder / stage))
                found[stage] = {"seconds": stamp.get("seconds"), "verdict": verdict}
        self.stages = found  # whole: others read it meanwhile
        self.before = ids if self.before is None else self.before
        self.made = [stage for stage in ids if ids[stage] != self.before.get(stage)]
        self.verdict = worst(made["verdict"] for made in self.stages.values())
        self.numbers = _numbers(folder / "evaluate" / "metrics.json") if "evaluate" in self.stages else {}
        page = folder / "report" / "index.html"
        self.report = str(page) if "report" in self.stages and page.is_file() else None


def exit_code(rows: list[SceneRow]) -> int:
    """The code of a batch: 0 where every scene is done, else the worst."""
    codes = {row.code for row in rows}
    return next((code for code in WORST_FIRST if code in codes), DONE)


def summary(rows: list[SceneRow], engine: str, started: str, seconds: float) -> dict[str, Any]:
    """What batch.json holds."""
    states = [row.state for row in rows]
    return {
        "engine": engine,
        "started": started,
        "seconds": round(seconds, 3),
        "finished": not {"waiting", "running"} & set(states),
        "code": exit_code(rows),
        "states": {state: states.count(state) for state in dict.fromkeys(states)},
        "task_seconds": round(sum(row.seconds for row in rows), 3),
        "scenes": [{k: v for k, v in asdict(row).items() if k != "before"} for row in rows],
    }


def _numbers(path: Path) -> dict[str, float]:
    try:
        found = read_json(path)["test"]
    except (OSError, ValueError, KeyError):
        return {}
    return {name: found[name] for name in MEASURES if isinstance(found.get(name), int | float)}
