"""What is to be damaged, and what a damage is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from devrf.capture.formats.parts.scene_files import read_scene, write_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.config.scene import CaptureConfig, SceneConfig
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.options import TrainingOptions


class DoesNotApply(DevrfError):
    """A damage that means nothing for a scene."""


@dataclass(frozen=True)
class Intact:
    """What is to be damaged.

    Attributes:
        config: Of the undisturbed case, with the case's seed.
        scene_dir: Folder of scene.yaml.
        scene: What the undisturbed case made of it.
        folder: Of the case, for files that are written anew.
        severity: How much, in the axis' unit.
        seed: Of what is drawn at random.
    """

    config: SceneConfig
    scene_dir: Path
    scene: Scene
    folder: Path
    severity: float
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        """A generator at its beginning."""
        return np.random.default_rng(self.seed)

    @property
    def share(self) -> float:
        """The severity, where it counts percents."""
        return self.severity / 100

    @property
    def capture(self) -> CaptureConfig | None:
        """The raw files; None of a data set."""
        return self.config.capture

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the training cameras."""
        return tuple(dict.fromkeys(f.camera_name for f in self.scene.dynamic if f.split == "train"))


@dataclass(frozen=True)
class Damage:
    """What is different in a case.

    Attributes:
        config: Its configuration.
        stage: The stage behind which damage is done; None: nowhere.
        behind: Does it, given what the stage was given.
        options: Changes the options of both trainings; None: nothing does.
    """

    config: SceneConfig
    stage: str | None = None
    behind: Callable[[StageContext], None] = lambda context: None
    options: Callable[[TrainingOptions], TrainingOptions] | None = None

    @contextmanager
    def trained_otherwise(self, stage: str) -> Iterator[None]:
        """While this holds, a stage trains with other options than its configuration says."""
        if self.options is None:
            yield
            return
        change, names = self.options, vars(import_module(f"devrf.pipelines.stages.{stage}"))
        usual = names["training_options"]
        names["training_options"] = lambda config, scene: change(usual(config, scene))
        try:
            yield
        finally:
            names["training_options"] = usual


Damaging = Callable[[Intact], Damage]


def with_capture(config: SceneConfig, **changes: object) -> SceneConfig:
    """Another configuration of a capture."""
    assert config.capture is not None  # checked by the callers
    return config.model_copy(update={"capture": config.capture.model_copy(update=changes)})


def behind_scene(intact: Intact, change: Callable[[Scene], Scene]) -> Damage:
    """Damage behind stage `scene`, which a data set has too."""
    return Damage(
        intact.config, "scene", lambda context: write_scene(context.out, change(read_scene(context.out)))
    )
