"""Which model of a sweep is kept: mappers tried one after the other within a time budget.

Part of the worker's process; models are pycolmap's, which only `sfm_worker` imports.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from devrf.calibration.sweep.sfm_budget import Deadline
from devrf.capture.system.progress import Progress

MIN_POINTS = 30  # COLMAP's minimum for one pose; global mapping of a camera that only turned leaves fewer
GLOBAL_COST = 2.0  # global mapping takes one to two times as long as incremental mapping of the same pairs

Reconstruction = Any  # pycolmap's
# folder, rung of the ladder, seconds left -> models
Attempt = Callable[[Path, dict[str, Any], float], list[Reconstruction]]
Torn = Callable[[Reconstruction], int]  # neighbours of a film that a model contradicts


class Mapping:
    """Models of the sweep by several mappers; the best so far is the one with the most pictures, then the one that
    is torn least, then the one with the lowest error."""

    def __init__(
        self, attempt: Attempt, torn: Torn, work: Path, pictures: int, deadline: Deadline, progress: Progress
    ) -> None:
        """`attempt` maps once, into a folder below `work`; `pictures` are all there are."""
        self.attempt, self.torn, self.work = attempt, torn, work
        self.pictures, self.deadline, self.progress = pictures, deadline, progress
        self.best: Reconstruction | None = None
        self.best_torn = 0
        self.models: list[Reconstruction] = []  # of the best attempt, largest first
        self.name: str | None = None
        self.attempts: list[dict[str, Any]] = []

    @property
    def registered(self) -> int:
        """Pictures of the best model."""
        return 0 if self.best is None else self.best.num_reg_images()

    @property
    def seconds(self) -> float:
        """What the slowest attempt took."""
        return max((attempt["seconds"] for attempt in self.attempts), default=0.0)

    def climb(self, ladder: list[dict[str, Any]]) -> None:
        """Try one rung after the other until one registers its share of the pictures, or time is up."""
        for rung in ladder:
            if self.best is not None and self.deadline.left_s() <= 0:
                break
            self._try(rung)
            if self.registered >= rung["accept"] * self.pictures:
                break

    def other_mapper(self, both: bool, ladder: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The rung of the mapper that was not tried, where it should be and there is time for it, else none.

        Args:
            both: It should be; else only where the first try was not enough, where pictures are missing from the best
                model, or it is torn. (On a flat sweep a second try with laxer bounds kept all pictures and no depth.)
            ladder: All rungs.
        """
        tried = {attempt["mapper"] for attempt in self.attempts}
        weak = len(self.attempts) > 1 or self.registered < self.pictures or self.best_torn > 0
        if not (weak or both) or GLOBAL_COST * self.seconds >= self.deadline.left_s():
            return []
        return [rung for rung in ladder if rung["mapper"] not in tried][:1]

    def report(self) -> dict[str, Any]:
        """For `static_poses.json`."""
        return {"mapper": self.name, "attempts": self.attempts}

    def _try(self, rung: dict[str, Any]) -> None:
        name = rung["name"]
        self.progress(0.7, f"mapping ({name})")
        start, left = time.monotonic(), self.deadline.left_s()
        folder = self.work / f"attempt{len(self.attempts)}"
        folder.mkdir()
        models = self.attempt(folder, rung, left)
        models = [m for m in models if m.num_points3D() >= MIN_POINTS]
        models.sort(key=_worth, reverse=True)
        torn = self.torn(models[0]) if models else None
        self.attempts.append(
            {
                "name": name,
                "mapper": rung["mapper"],
                "registered": [m.num_reg_images() for m in models],
                "mean_reprojection_px": models[0].compute_mean_reprojection_error() if models else None,
                "torn": torn,
                "seconds": time.monotonic() - start,
                "out_of_time": time.monotonic() - start >= left,
            }
        )
        if torn is None:
            return
        if self.best is None or _worth(models[0], torn) > _worth(self.best, self.best_torn):
            self.best, self.best_torn, self.models, self.name = models[0], torn, models, name


def _worth(model: Reconstruction, torn: int = 0) -> tuple[int, int, float]:
    """A small model can look perfect: pictures count first, the error only among equals."""
    return model.num_reg_images(), -torn, -model.compute_mean_reprojection_error()
