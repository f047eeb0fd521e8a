"""What tests of budgets share: captures that are planned, and files of a size."""

from dataclasses import replace
from pathlib import Path

from devrf.pipelines.budget.material import Material, Source, planned_material
from devrf.pipelines.config.scene import SceneConfig


def configured(**sections: object) -> SceneConfig:
    """A capture of a sweep and one camera."""
    capture = {"static": "s.mp4", "cameras": {"cam0": "c.mp4"}}
    return SceneConfig.model_validate({"name": "x", "capture": capture, **sections})


def source(**changes: object) -> Source:
    """A camera's clip, but for the changes."""
    made = Source("camera", "clip", 3840, 2160, 300, 300, 3e6)
    return replace(made, **changes)  # type: ignore[arg-type]


def planned(config: SceneConfig, **sources: Source) -> Material:
    """What a run of it works on."""
    return planned_material(config, sources)


def leave(path: Path, size: int) -> None:
    """A file of a size, without writing it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.truncate(size)
