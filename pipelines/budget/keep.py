"""One run kept within `budget.*`: what a stage may use, and whether there is time for it, before it begins."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.system.amounts import GB
from devrf.pipelines.budget.disk import check_room
from devrf.pipelines.budget.memory import allowed_bytes
from devrf.pipelines.stage import Allowance

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

OPTIONAL = "render"  # nothing but the report reads it
LAST = "report"  # takes seconds, and is wanted most where a run ends early


class Budget:
    """What one call of `run` may still use. Its time begins now."""

    def __init__(self, config: "SceneConfig", run_dir: Path) -> None:
        self.config, self.run_dir = config, run_dir
        minutes = config.budget.time_minutes
        self._until = None if minutes is None else time.monotonic() + 60 * minutes

    def allowance(self) -> Allowance:
        """What the next stage may use.

        Raises:
            BudgetError: There is no room on the disk.
        """
        check_room(self.config, self.run_dir)
        gpu_gb = self.config.budget.gpu_memory_gb
        gpu = None if gpu_gb is None else int(gpu_gb * GB)
        return Allowance(allowed_bytes(self.config), gpu, self._until)

    def late(self, stage: str, rest: Sequence[str]) -> str | None:
        """Why there is no time to begin a stage, and what is left; None where there is.

        Args:
            stage: Its name.
            rest: It and the stages that follow.
        """
        if self._until is None or stage == LAST or time.monotonic() < self._until:
            return None
        return (
            f"no time left for {', '.join(rest)} (budget.time_minutes: {self.config.budget.time_minutes:g}); what is "
            "done is kept: run again to go on, or give it more time"
        )
