"""How a stage is done within the memory that is allowed: fewer pictures at once, then smaller ones, else not at all."""

from dataclasses import dataclass

from devrf.calibration.sweep.static_poses import MAX_IMAGE_SIZE
from devrf.capture.amounts import size_text
from devrf.pipelines.budget.estimate import finds_by_raft, static_poses_need
from devrf.pipelines.budget.material import TRAINED, Material
from devrf.pipelines.budget.memory import memory_bound
from devrf.pipelines.budget.need import BudgetError, Need
from devrf.pipelines.budget.training import BASE, fitted_training
from devrf.pipelines.config.scene import SceneConfig

SIDES_PX = (
    MAX_IMAGE_SIZE,
    960,
    720,
    540,
)  # of the sweep's pictures; features below that are too few to match


@dataclass(frozen=True)
class Fit:
    """A way to do a stage.

    Attributes:
        need: What it needs then.
        at_once: Pictures, pairs or threads at once.
        side_px: Of the sweep's pictures; None: as it is without a budget.
        decided: What training does otherwise, one line each.
    """

    need: Need
    at_once: int
    side_px: int | None = None
    decided: tuple[str, ...] = ()

    @property
    def memory(self) -> int:
        """Main memory, bytes."""
        return self.need.base + self.need.each * self.at_once

    @property
    def said(self) -> str | None:
        """What was decided; None where nothing had to be."""
        changes = []
        if self.at_once < self.need.at_once:
            changes.append(f"{self.at_once} instead of {self.need.at_once} at once")
        if self.side_px is not None:
            changes.append(f"features at {self.side_px} instead of {MAX_IMAGE_SIZE} pixels")
        reason = [f"{', '.join(changes)}, to keep within the memory that is allowed"] if changes else []
        return "; ".join([*self.decided, *reason]) or None


def fit(need: Need, config: SceneConfig, material: Material, allowed: int, device: str = "cpu") -> Fit:
    """The quickest way to do a stage within `allowed` bytes that changes its result least.

    Raises:
        BudgetError: There is none.
    """
    if need.stage in TRAINED:
        smaller, decided = fitted_training(need, config, material, device, allowed)
        return Fit(smaller, 1, decided=decided)
    at_once = need.fitted(allowed)
    if at_once:
        return Fit(need, at_once)
    if need.stage == "static_poses":
        for side_px in SIDES_PX[1:]:
            smaller = static_poses_need(config, material, side_px)
            if smaller.each < need.each and (at_once := smaller.fitted(allowed)):
                return Fit(smaller, at_once, side_px)
        need = static_poses_need(config, material, SIDES_PX[-1])
    raise BudgetError(_no_memory(need, config, material, allowed))


def _no_memory(need: Need, config: SceneConfig, material: Material, allowed: int) -> str:
    """What is said of a stage that does not fit."""
    remedy = _remedy(need.stage, config, material) if allowed > BASE else None  # libraries stay what they are
    return (
        f"needs about {size_text(need.least)} of main memory at the least, and {memory_bound(config, allowed)}"
        + (f", or use {remedy}" if remedy else "")
    )


def _remedy(stage: str, config: SceneConfig, material: Material) -> str | None:
    """What can be asked for, so that a stage takes less; None where nothing would."""
    if stage in ("evaluate", "render"):
        model = "a lower reconstruct.resolution or reconstruct.image_scale"
        return model if config.preset == "tiny" else f"--preset tiny, or {model}"
    if stage == "flow" and finds_by_raft(config, material):
        return "flow.method: dis, or smaller pictures"
    return REMEDIES.get(stage, "smaller pictures")


REMEDIES = {
    "ingest": "smaller pictures or shorter clips (capture.range_s)",
    "static_poses": "fewer pictures in the sweep",
    "sync": "shorter clips, or calibration.sync.method: timestamps",
    "scene": "shorter clips (capture.range_s)",
    "report": None,
}
