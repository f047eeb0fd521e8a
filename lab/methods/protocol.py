"""What a method is to a benchmark: it trains within a budget, renders colour and depth, and says how large it is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.system.progress import Progress, no_progress
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import CameraFlow
from devrf.lab.methods.method_table import Regime, Size
from devrf.reconstruct.options import TrainingOptions


@dataclass(frozen=True)
class MethodTask:
    """What a method is given, the same for all of them.

    Attributes:
        scene: Calibrated.
        flows: Backward optical flow by camera.
        regime: What it may train on.
        size: How large its networks are.
        device: `cpu` or `cuda`.
        seed: Of everything random.
        options: Of DeVRF's presets for this scene, by name.
        estimator: Makes one of optical flow, for DeVRF's tracking.
    """

    scene: Scene
    flows: dict[str, CameraFlow]
    regime: Regime
    size: Size
    device: str
    seed: int
    options: Callable[[str], TrainingOptions]
    estimator: Callable[[], FlowEstimator]

    @cached_property
    def boxed(self) -> Scene:
        """The scene in its box frame."""
        return self.scene.in_box_frame()


@dataclass(frozen=True)
class TimeBudget:
    """How long a method may train.

    Attributes:
        seconds: Of training, without looks at the model.
        look: Called now and then with a renderer and the seconds trained so far; its time does not count.
        progress: Told how far it is.
        steps: At most so many iterations; None: as many as the time allows.
    """

    seconds: float
    look: Callable[["TrainedModel", float], None] = lambda model, seconds: None
    progress: Progress = no_progress
    steps: int | None = None


@runtime_checkable
class TrainedModel(Protocol):
    """A model that renders."""

    @property
    def megabytes(self) -> float:
        """Of what has to be stored to render it."""
        ...

    def render(
        self, camera: Camera, time: float | None
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Colours in [0, 1], and distances along rays, of a camera in the box frame; `time` None: at rest."""
        ...


@runtime_checkable
class Method(Protocol):
    """A method.

    Attributes:
        regimes: Those that its paper, or its nature, has.
    """

    regimes: Sequence[Regime]

    def why_not(self, task: MethodTask) -> str | None:
        """Why it cannot do a task; None: it can. Asked before anything is trained."""
        ...

    def train(self, task: MethodTask, budget: TimeBudget) -> TrainedModel:
        """Train.

        Raises:
            ReconstructError: It diverged.
        """
        ...
