"""From scene.yaml to a checked `SceneConfig`, or to the list of everything that is wrong with it.

Mistakes are collected, never raised one by one: YAML syntax and duplicate keys first (nothing can be
read beyond them), then types, ranges and unknown keys, then what keys mean together, then missing files.
"""

from collections.abc import Sequence
from pathlib import Path

from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.files import check_files_exist, check_output
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.config.text import override, read_yaml
from devrf.pipelines.config.together import apart
from devrf.pipelines.config.types import validated


def load_scene(
    path: Path, overrides: Sequence[str] = (), *, preset: str | None = None, check_files: bool = True
) -> SceneConfig:
    """Read scene.yaml, apply `a.b=value` overrides, check everything, and look whether a data set moves.

    Args:
        path: The file.
        overrides: Texts `dotted.key=value`; the value is read as YAML.
        preset: In place of the file's.
        check_files: Whether the files it names must exist.
    Raises:
        ConfigError: With every mistake, in the form `scene.yaml: key: what is wrong`.
    """
    raw = read_yaml(path)
    if preset is not None:
        raw["preset"] = preset
    mistakes: list[str] = []
    overridden = [key for text in overrides if (key := override(raw, text, mistakes))]

    def say(key: str, text: str) -> None:
        from_command_line = any(key == k or key.startswith(k + ".") for k in overridden)
        where = f"--set {key}" if from_command_line else f"{path.name}: {key}" if key else path.name
        if key == "preset" and preset is not None and not from_command_line:
            where = "--preset"
        mistakes.append(f"{where}: {text}")

    config = validated(raw, say)
    if config is not None:
        for key, text in apart(config, raw):
            say(key, text)
        check_output(config, path.parent.resolve(), say)
        if check_files:
            check_files_exist(config, path.parent.resolve(), say)
    if mistakes or config is None:
        raise ConfigError(mistakes)
    if config.dataset is not None:
        config.dataset.look(config.path(path.parent.resolve(), config.dataset.path))
    return config
