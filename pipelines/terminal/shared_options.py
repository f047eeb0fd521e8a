"""Arguments and options that several commands share, and the configuration they name."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from devrf.capture.system.errors import DevrfError, InputError
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.terminal.console import Loudness, Talk
from devrf.pipelines.terminal.exit_codes import code_of

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

SceneArgument = Annotated[Path, typer.Argument(help="scene.yaml, or the folder that holds it")]
PresetOption = Annotated[str | None, typer.Option(help="tiny, fast or reference; overrides the file")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Override a key: reconstruct.rays=4096 (repeatable)")
]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda")]
UntilOption = Annotated[str | None, typer.Option(help="Stop after this stage")]
AllowUnhealthyOption = Annotated[
    bool, typer.Option("--allow-unhealthy", help="Continue when a stage's check refuses its result")
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Only errors")]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", help="Show every health row, and why stages are skipped")
]


def configured(
    scene: Path, preset: str | None, overrides: Sequence[str] | None, *, check_files: bool = True
) -> "tuple[SceneConfig, Path]":
    """The configuration that a command names, and the folder its paths are relative to.

    Raises:
        InputError: With every mistake in it.
    """
    from devrf.pipelines.config.load import load_scene

    path = scene / "scene.yaml" if scene.is_dir() else scene
    config = load_scene(path, overrides or (), preset=preset, check_files=check_files)
    return config, path.resolve().parent


class Command(TyperCommand):
    """A command that knows the options which earlier versions had."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take the command line apart; an option that is gone ends the program with exit code 2."""
        with errors_told(Talk()):
            for option in (word.partition("=")[0] for word in args):
                if (gone := GONE.get(f"{self.name} {option}")) is not None:
                    raise InputError("option-gone", f"{option}: is no longer an option: {gone}")
        return super().parse_args(ctx, args)


def talk_of(quiet: bool, verbose: bool = False) -> Talk:
    """Where a command speaks."""
    loudness: Loudness = "quiet" if quiet else "verbose" if verbose else "normal"
    return Talk(loudness)


@contextmanager
def errors_told(talk: Talk) -> Iterator[None]:
    """An error that is the data's or the configuration's is said and ends the command with its exit code."""
    try:
        yield
    except DevrfError as error:
        talk.error(str(error), error.code)
        raise typer.Exit(code_of(error)) from None
