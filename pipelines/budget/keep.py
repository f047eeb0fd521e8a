"""One run kept within `budget.*`: asked before each stage, and watching while it writes.

What reads clips is imported only where a stage runs, so that a run in which nothing is stale loads no library for it.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.amounts import GB
from devrf.capture.errors import DevrfError
from devrf.pipelines.budget.allowance import Allowance
from devrf.pipelines.budget.disk import no_room, room_of, watched
from devrf.pipelines.budget.memory import allowed_bytes
from devrf.pipelines.budget.need import BudgetError, Need
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import duration
from devrf.pipelines.stages import stage_names

if TYPE_CHECKING:
    from devrf.pipelines.budget.material import Material

OPTIONAL = "render"  # nothing but the report reads it
LAST = "report"  # takes seconds, and is wanted most where a run ends early


class Budget:
    """What one call of `run` may still use. Its time begins now."""

    def __init__(self, config: SceneConfig, scene_dir: Path, run_dir: Path, device: str) -> None:
        self.config, self.scene_dir, self.run_dir, self.device = config, scene_dir, run_dir, device
        minutes = config.budget.time_minutes
        self._until = None if minutes is None else time.monotonic() + 60 * minutes

    def allowance(self, stage: str, say: Callable[[str], None]) -> Allowance:
        """What a stage may use, now that what it reads is made. What had to be decided is said.

        Raises:
            BudgetError: It cannot be done within the budget.
        """
        allowed = allowed_bytes(self.config)
        gpu_gb = self.config.budget.gpu_memory_gb
        gpu = None if gpu_gb is None else int(gpu_gb * GB)
        material, needs = self._known([stage])
        need = needs.get(stage)
        if material is None or need is None:
            return Allowance(memory=allowed, gpu=gpu, until=self._until)
        room = room_of(self.config, self.scene_dir, self.run_dir, [stage])
        if need.disk > room.count:
            raise BudgetError(no_room(need.disk, "it", room))
        from devrf.pipelines.budget.fit import fit
        from devrf.pipelines.budget.material import TRAINED

        if stage in TRAINED:  # fits itself to the scene as it is then
            return Allowance(memory=allowed, gpu=gpu, until=self._until)
        found = fit(need, self.config, material, allowed)
        if found.said is not None:
            say(f"  {found.said}")
        return Allowance(at_once=found.at_once, side_px=found.side_px, until=self._until)

    def watched(self) -> AbstractContextManager[None]:
        """Stops what is done in this block before the disk is full."""
        return watched(self.config, self.scene_dir, self.run_dir)

    def late(self, stage: str, rest: Sequence[str]) -> str | None:
        """Why there is no time to begin a stage, and what is left; None where there is.

        Args:
            stage: Its name.
            rest: It and the stages that follow.
        """
        if self._until is None or stage == LAST:
            return None
        left_s = self._until - time.monotonic()
        if left_s > 0 and stage != OPTIONAL:
            return None
        _, needs = self._known(rest)
        if left_s > 0 and (stage not in needs or left_s > (needs[stage].seconds or 0.0)):
            return None
        known = [needs[name].seconds for name in rest if name in needs]
        total_s = sum(seconds for seconds in known if seconds is not None)
        more = f", which would take about {duration(total_s)}" if known and None not in known else ""
        return (
            f"no time left for {', '.join(rest)} (budget.time_minutes: {self.config.budget.time_minutes:g}){more}; "
            "what is done is kept: run again to go on, or give it more time"
        )

    def _known(self, stages: Sequence[str]) -> "tuple[Material | None, dict[str, Need]]":
        """What the run works on, and what stages that have not begun need of it.

        Nothing of stages that are not the pipeline's; nothing where raw files cannot be read, which the stages report,
        or where only the libraries are installed that training a data set needs.
        """
        if set(stages).isdisjoint(stage_names()):
            return None, {}
        try:
            from devrf.pipelines.budget.estimate import stage_needs
            from devrf.pipelines.budget.material import find_material

            material = find_material(self.config, self.scene_dir, self.run_dir, stages)
        except (DevrfError, ModuleNotFoundError):
            return None, {}
        return material, stage_needs(self.config, material, self.device, stages)
