"""What a user asked for, and where a stage stands."""

from dataclasses import dataclass
from typing import Literal

from devrf.capture.measure import Verdict
from devrf.pipelines.health.judge import HealthRow, worst
from devrf.pipelines.stage import Stage

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
