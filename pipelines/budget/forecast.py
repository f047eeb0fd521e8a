"""What a run will need, said before it starts; refused where it cannot be had."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.amounts import size_text
from devrf.capture.errors import DevrfError
from devrf.pipelines.budget.disk import Room, no_room, rooms_of
from devrf.pipelines.budget.estimate import UNSURE, stage_needs
from devrf.pipelines.budget.fit import Fit, fit
from devrf.pipelines.budget.material import Material, find_material
from devrf.pipelines.budget.memory import allowed_bytes, bound_by_budget
from devrf.pipelines.budget.need import BudgetError, Need, most_on_disk
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import duration
from devrf.pipelines.runner.workspace import size_of


@dataclass(frozen=True)
class Forecast:
    """Of the stages that are going to run.

    Attributes:
        needs: What they need, in their order.
        fits: How each that can be done is done.
        too_large: What cannot be done within the memory that is allowed, one message each.
        doubtful: Later stages that could not be done if they began now; other programs may have ended by then.
        allowed: Main memory that may be used, bytes.
        disk: Most that they add to the disk, bytes.
        room: For that, of which least would be left.
        time_minutes: `budget.time_minutes`.
    """

    needs: tuple[Need, ...]
    fits: tuple[Fit, ...]
    too_large: tuple[str, ...]
    doubtful: tuple[str, ...]
    allowed: int
    disk: int
    room: Room
    time_minutes: float | None

    @property
    def refused(self) -> list[str]:
        """What cannot be done within the budget, one message each."""
        full = [no_room(self.disk, "the run", self.room)] if self.disk > self.room.count else []
        return [*self.too_large, *full]

    @property
    def seconds(self) -> float | None:
        """Of all stages on two CPU cores; None where one of them was never measured."""
        known = [need.seconds for need in self.needs if need.seconds is not None]
        return sum(known) if len(known) == len(self.needs) else None

    def lines(self) -> list[str]:
        """In two lines, and one for each doubt."""
        if not self.fits:
            return []
        largest = max(self.fits, key=lambda fit: fit.memory)
        seconds = self.seconds
        time = "time not known" if seconds is None else f"{duration(seconds)} on two CPU cores"
        lines = [
            f"estimate (to a factor of {UNSURE} in time): {size_text(largest.memory)} of main memory "
            f"({largest.need.stage}; {size_text(self.allowed)} allowed), {size_text(self.disk)} on the "
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
        material = find_material(config, scene_dir, run_dir, stages)
    except DevrfError:
        return None
    needs = stage_needs(config, material, device, stages)
    rooms = rooms_of(config, scene_dir, run_dir, stages)
    return forecast_of(needs, config, material, device, allowed_bytes(config), rooms, run_dir)


def forecast_of(
    needs: Mapping[str, Need],
    config: SceneConfig,
    material: Material,
    device: str,
    allowed: int,
    rooms: Iterable[Room],
    run_dir: Path,
) -> Forecast:
    """How stages can be done.

    Args:
        needs: Of the stages that are going to run, in their order.
        config: The configuration.
        material: What they work on.
        device: cpu or cuda.
        allowed: Main memory, bytes.
        rooms: All of which they have to keep within.
        run_dir: The run folder, whose finished folders of these stages go once they have been made again.
    """
    fits, too_large, doubtful = [], [], []
    for stage, need in needs.items():
        try:
            fits.append(fit(need, config, material, allowed, device))
        except BudgetError as error:
            later = bool(fits) and not bound_by_budget(config, allowed)
            (doubtful if later else too_large).append(f"{stage}: {error}")
    replaced = {stage: size_of(run_dir / stage) for stage in needs}

    def on_disk(room: Room) -> int:
        return most_on_disk(needs.values(), {} if room.kept else replaced)

    room = min(rooms, key=lambda room: room.count - on_disk(room))
    return Forecast(
        tuple(needs.values()),
        tuple(fits),
        tuple(too_large),
        tuple(doubtful),
        allowed,
        on_disk(room),
        room,
        config.budget.time_minutes,
    )
