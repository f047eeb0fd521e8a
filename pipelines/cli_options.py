"""Arguments and options that several commands share, and the configuration they name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, get_args

import typer

from devrf.capture.errors import InputError
from devrf.pipelines.console import Loudness, Talk
from devrf.pipelines.scene_config import SceneConfig
from devrf.pipelines.scene_file import load_scene, near_file
from devrf.reconstruct.options import PresetName

SceneArgument = Annotated[Path, typer.Argument(help="scene.yaml, or the folder that holds it")]
PresetOption = Annotated[str | None, typer.Option(help="tiny, fast or reference; overrides the file")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Override a key: reconstruct.rays=4096 (repeatable)")
]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda")]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Only errors")]
VerboseOption = Annotated[bool, typer.Option("--verbose", help="Every health row, and why nothing runs")]


def configured(
    scene: Path, preset: str | None, overrides: Sequence[str] | None, *, check_files: bool = True
) -> tuple[SceneConfig, Path]:
    """The configuration that a command names, and the folder its paths are relative to.

    Raises:
        InputError: With every mistake in it.
    """
    path = scene / "scene.yaml" if scene.is_dir() else scene
    if not path.exists():
        raise InputError(_no_scene(path))
    if preset is not None and preset not in get_args(PresetName):
        raise InputError(f"--preset {preset}: unknown; expected {', '.join(get_args(PresetName))}")
    settings = [*([f"preset={preset}"] if preset else []), *(overrides or [])]
    return load_scene(path, settings, check_files=check_files), path.resolve().parent


def _no_scene(path: Path) -> str:
    """What to say where there is no scene.yaml: what the folder holds instead, and what to write."""
    from devrf.capture.formats.datasets import guess_format

    folder = path.parent
    if not folder.is_dir():
        return f"{path}: no such file, and no such folder; expected a scene.yaml or the folder that holds one"
    found = guess_format(folder)
    if found is None:
        return f"{path}: no such file{near_file(path)}; expected a scene.yaml, see docs/formats.md"
    return (
        f"{path}: no such file; the folder looks like a data set ({found}): write a scene.yaml with "
        f"name: NAME and dataset: {{format: {found}, path: {folder}}}"
    )


def talk_of(quiet: bool, verbose: bool = False) -> Talk:
    """Where a command speaks."""
    loudness: Loudness = "quiet" if quiet else "verbose" if verbose else "normal"
    return Talk(loudness)
