"""The finished data set that a scene.yaml names, read as its keys say."""

from pathlib import Path

from devrf.capture.formats import read_dataset
from devrf.capture.photos.picture_files import damaged_pictures
from devrf.capture.scene import Scene, background_of
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.config.scene import SceneConfig


def check_dataset(config: SceneConfig, scene_dir: Path) -> list[str]:
    """What is wrong with the data set, found by reading it, every picture included; empty when all is well."""
    try:
        scene = configured_dataset(config, scene_dir)
    except DevrfError as error:
        return [f"dataset: {error}"]
    files = [path for f in scene.frames for path in (f.path, f.matte) if path is not None]
    return [f"dataset: {text}" for text in damaged_pictures(files)]


def configured_dataset(config: SceneConfig, scene_dir: Path, notes: list[str] | None = None) -> Scene:
    """The data set that a configuration names.

    Args:
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        notes: What was repaired or left out is added here, in words.
    Raises:
        ValueError: The configuration has no `dataset`.
        CaptureError: The data set cannot be used.
    """
    data = config.dataset
    if data is None:
        raise ValueError("a capture is no data set; expected a configuration with dataset")
    background = data.background
    if background == "auto":
        background = None
    elif not isinstance(background, str):
        background = background_of(background)
    folder, every = config.path(scene_dir, data.path), config.evaluate.holdout_every
    return read_dataset(data.format, folder, data.frame_stride, every, background, notes)
