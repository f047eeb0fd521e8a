"""What a training run measured of itself: the loss curve, speed, memory; and the check that it has not diverged."""

import math
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from devrf.capture.system.amounts import GB
from devrf.capture.system.errors import ReconstructError


class Diverged(ReconstructError):
    """A loss that is not a finite number."""


class TrainingLog:
    """Gathers numbers during training; `rows` are means over the iterations since the row before.

    Args:
        device: cpu or cuda.
        every: Iterations of a row.
        clock: Tells seconds: of a wall's clock, or of the processor, where other programs must not count.
    """

    def __init__(self, device: str, every: int, clock: Callable[[], float] = time.perf_counter) -> None:
        self.device, self.every, self._clock = device, every, clock
        self.rows: list[dict[str, float]] = []
        self.iteration, self.rays = 0, 0
        self.began = self._clock()
        self._stopped: float | None = None
        self._sums: dict[str, list[torch.Tensor]] = defaultdict(list)
        if device != "cpu":
            torch.cuda.reset_peak_memory_stats()

    def add(self, rays: int, parts: dict[str, torch.Tensor], **labels: float) -> None:
        """Count one iteration and its (unweighted) losses; `mse` becomes the row's PSNR.

        Raises:
            Diverged: A loss is not a finite number.
        """
        self.iteration += 1
        self.rays += rays
        for name, value in parts.items():
            self._sums[name].append(value.detach())
        if self.iteration % self.every == 0:
            self.close_row(**labels)

    def close_row(self, **labels: float) -> None:
        """Turn what has gathered into a row."""
        if not self._sums:
            return
        means = {name: float(torch.stack(values).mean()) for name, values in self._sums.items()}
        self._sums.clear()
        for name, value in means.items():
            if not math.isfinite(value):
                text = f"training diverged: loss '{name}' is {value} at iteration {self.iteration}"
                remedy = (
                    "check poses and times (report), then lower reconstruct.resolution or change the seed"
                )
                raise Diverged("training-diverged", f"{text}; {remedy}")
        row = {"iteration": float(self.iteration), "seconds": round(self.seconds, 2), **labels}
        if "mse" in means:
            row["psnr"] = round(psnr(means["mse"]), 3)
        self.rows.append(row | {name: float(f"{value:.4g}") for name, value in means.items()})

    def forget(self) -> None:
        """Leave out what has gathered since the last row."""
        self._sums.clear()

    def state(self) -> dict[str, Any]:
        """All of it as plain numbers, for a checkpoint."""
        sums = {name: [float(v) for v in values] for name, values in self._sums.items()}
        return {
            "iteration": self.iteration,
            "rays": self.rays,
            "seconds": self.seconds,
            "rows": self.rows,
            "sums": sums,
        }

    def take_up(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.iteration, self.rays, self.rows = state["iteration"], state["rays"], list(state["rows"])
        self.began = self._clock() - state["seconds"]
        self._sums = defaultdict(list)
        for name, values in state["sums"].items():
            self._sums[name] = [torch.tensor(v, device=self.device) for v in values]

    @property
    def seconds(self) -> float:
        """Since the log was begun, pauses left out."""
        return (self._stopped or self._clock()) - self.began

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What is done meanwhile does not count as training."""
        self._finish_queued()
        self._stopped = self._clock()
        try:
            yield
        finally:
            self._finish_queued()
            self.began += self._clock() - self._stopped
            self._stopped = None

    def _finish_queued(self) -> None:
        if self.device != "cpu":
            torch.cuda.synchronize()  # a GPU works behind; what it still has to do is on this side of the line

    def summary(self) -> dict[str, Any]:
        """As written to metrics.json."""
        self._finish_queued()
        seconds = self.seconds
        on_gpu = self.device != "cpu"
        return {
            "seconds": round(seconds, 2),
            "iterations": self.iteration,
            "rays": self.rays,
            "rays_per_s": round(self.rays / max(seconds, 1e-9)),
            "device": self.device,
            "peak_rss_gb": round(peak_rss_gb(), 3),
            "peak_gpu_gb": round(torch.cuda.max_memory_allocated() / GB, 3) if on_gpu else None,
            "train_psnr": self.rows[-1].get("psnr") if self.rows else None,
            "curve": self.rows,
        }


def psnr(mse: float) -> float:
    """Peak signal to noise ratio of a mean squared error of values in [0, 1], decibels."""
    return -10 * math.log10(max(mse, 1e-10))


def peak_rss_gb() -> float:
    """Most memory this process has held, in units of 1e9 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / GB
