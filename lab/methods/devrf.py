"""DeVRF itself: the scene at rest from the sweep, then its motion, by one of the presets."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from devrf.capture.camera import Camera
from devrf.lab.methods.clock import LOOKS, timed
from devrf.lab.methods.method_table import Regime
from devrf.lab.methods.protocol import MethodTask, TimeBudget
from devrf.reconstruct import recipe
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.rendering.model import DynamicModel, render_layers
from devrf.reconstruct.storage.model_io import save_deformation, save_rest
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.loop import TrainingRun


@dataclass(frozen=True)
class TrainedDevrf:
    """A model that renders."""

    model: DynamicModel

    @property
    def megabytes(self) -> float:
        """Of its files."""
        with tempfile.TemporaryDirectory() as folder:
            rest = Path(folder) / "rest.safetensors"
            save_rest(rest, self.model.rest)
            files = [rest, *save_deformation(Path(folder), self.model)]
            return sum(file.stat().st_size for file in files) / 1e6

    def render(
        self, camera: Camera, time: float | None
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Colours, and distances along rays."""
        colour, depth, _ = render_layers(self.model, camera, time)
        return colour, depth


@dataclass(frozen=True)
class DevrfMethod:
    """One of the presets; it ends when it is done and is cut short by nothing.

    Attributes:
        preset: Its name.
    """

    preset: str
    regimes: tuple[Regime, ...] = ("joint", "two-stage")

    def why_not(self, task: MethodTask) -> str | None:
        """It can do every task that has a sweep."""
        return None

    def train(self, task: MethodTask, budget: TimeBudget) -> TrainedDevrf:
        """Train it."""
        options, log = task.options(self.preset), timed(task.device)

        def look(model: DynamicModel) -> None:
            with log.paused():
                budget.look(TrainedDevrf(model), log.seconds)

        every = budget.seconds / LOOKS
        at_rest = Watch(every, lambda rest, _: look(DynamicModel(rest)))
        rest: RestModel = recipe.canonical(
            task.scene, options.canonical, TrainingRun(task.device, budget.progress, watch=at_rest)
        )

        def in_motion(motion: MotionField, _: float) -> None:
            look(DynamicModel(rest, motion))

        training = TrainingRun(task.device, budget.progress, watch=Watch(every, in_motion))
        model, _ = recipe.motion(task.scene, rest, task.flows, options.motion, training, task.estimator)
        look(model)
        return TrainedDevrf(model)


TINY, FAST, REFERENCE = (DevrfMethod(preset) for preset in ("tiny", "fast", "reference"))
