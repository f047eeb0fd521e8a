"""What a run will need, said before it starts; refused where it cannot be had."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.errors import DevrfError
from devrf.pipelines.budget.disk import Room, no_room, room_for
from devrf.pipelines.budget.estimate import UNSURE, stage_needs
from devrf.pipelines.budget.fit import Fit, fit
from devrf.pipelines.budget.material import find_material
from devrf.pipelines.budget.memory import allowed_bytes, bound_by_budget
from devrf.pipelines.budget.need import BudgetError, Need, most_on_disk, size_text
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import duration
from devrf.pipelines.stamps.cache import cache_of


@dataclass(frozen=True)
class Forecast:
    """Of the stages that are going to run.

    Attributes:
        fits: How each is done, in their order.
        refused: What cannot be done within the budget, one message each.
        doubtful: Later stages that could not be done if they began now; other programs may have ended by then.
        allowed: Main memory that may be used, bytes.
        room: On the disk.
        time_minutes: `budget.time_minutes`.
    """

    fits: tuple[Fit, ...]
    refused: tuple[str, ...]
    doubtful: tuple[str, ...]
    allowed: int
    room: Room
    time_minutes: float | None

    @property
    def needs(self) -> list[Need]:
        """Of the stages that can be done."""
        return [fit.need for fit in self.fits]

    @property
    def seconds(self) -> float | None:
        """Of all stages on two CPU cores; None where one of them was never measured."""
        known = [need.seconds for need in self.needs if need.seconds is not None]
        return sum(known) if len(known) == len(self.fits) else None

    def lines(self) -> list[str]:
        """In two lines, and one for each doubt."""
        if not self.fits:
            return []
        largest = max(self.fits, key=lambda fit: fit.memory)
        seconds = self.seconds
        time = "time not known" if seconds is None else f"{duration(seconds)} on two CPU cores"
        lines = [
            f"estimate (to a factor of {UNSURE} in time): {size_text(largest.memory)} of main memory "
            f"({largest.need.stage}; {size_text(self.allowed)} allowed), {size_text(most_on_disk(self.needs))} on the "
            f"disk ({self.room.bound}), {time}"
        ]
        if self.time_minutes is not None and seconds is not None and seconds > 60 * self.time_minutes:
            lines.append(
                f"that may be more than budget.time_minutes ({self.time_minutes:g}): use a faster preset, or give it "
                "more; what is not done in time is left for the next run"
            )
        return [*lines, *(f"as it is now: {text}" for text in self.doubtful)]

    def details(self) -> list[str]:
        """A line for each stage."""
        return [
            f"  {fit.need.stage}: memory {size_text(fit.memory)}"
            + (f", GPU {size_text(fit.need.gpu)}" if fit.need.gpu else "")
            + f", disk {size_text(fit.need.left)}"
            + (f" ({size_text(fit.need.disk)} meanwhile)" if fit.need.passing else "")
            + ("" if fit.need.seconds is None else f", {duration(fit.need.seconds)}")
            + ("" if fit.said is None else f"; {fit.said}")
            for fit in self.fits
        ]


def forecast(
    config: SceneConfig, scene_dir: Path, run_dir: Path, device: str, stages: Collection[str]
) -> Forecast | None:
    """What the named stages will need; None where their raw files cannot be read, which others report."""
    try:
        material = find_material(config, scene_dir, run_dir)
    except DevrfError:
        return None
    cache, allowed = cache_of(config, scene_dir), allowed_bytes(config)
    room = room_for(run_dir, config.budget.disk_gb, None if cache is None else cache.folder)
    fits, refused, doubtful = [], [], []
    for need in (n for n in stage_needs(config, material, device).values() if n.stage in stages):
        try:
            fits.append(fit(need, config, material, allowed, device))
        except BudgetError as error:
            later = bool(fits) and not bound_by_budget(config, allowed)
            (doubtful if later else refused).append(str(error))
    disk = most_on_disk(fit.need for fit in fits)
    if disk > room.count:
        refused.append(no_room(disk, "the run", room))
    return Forecast(tuple(fits), tuple(refused), tuple(doubtful), allowed, room, config.budget.time_minutes)
