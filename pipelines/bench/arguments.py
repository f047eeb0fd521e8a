"""What the commands of `bench` share: options, words into names and numbers, and the scene that is measured."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from devrf.capture.errors import InputError
from devrf.capture.writable import check_file, check_folder
from devrf.pipelines.cli_options import configured, errors_told, talk_of
from devrf.pipelines.console import Talk
from devrf.pipelines.device import resolve_device
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stages import STAGES

SeedsOption = Annotated[int, typer.Option(min=1, max=100, help="Trainings per case; they give the spread")]
OutOption = Annotated[
    Path | None, typer.Option(help="Folder for models and pictures; default: beside the run folder")
]
SmallSceneArgument = Annotated[
    Path | None,
    typer.Argument(help="scene.yaml with test cameras; default: a small simulated session, rendered first"),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Rows as JSON; a chart is drawn beside it")]


def names_of(option: str, text: str, known: Sequence[str]) -> list[str]:
    """Names out of those that are known, as `base,c2f` lists them."""
    names = [name.strip() for name in text.split(",")]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"{option} {', '.join(unknown)}: unknown, expected {', '.join(known)}")
    return names


def numbers_of(option: str, text: str, least: float, most: float) -> list[float]:
    """Numbers within bounds, as `0.25,1` names them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(least <= number <= most for number in numbers):
        raise InputError(f"{option} {text}: expected numbers from {least:g} to {most:g}, such as {least:g},1")
    return numbers


def run_benchmark(
    name: str,
    measure: Callable[[Run, Path], None],
    scene: Path,
    preset: str | None,
    overrides: Sequence[str] | None,
    out: Path | None,
    json: Path | None,
    device: str,
    quiet: bool,
) -> None:
    """Read the configuration and run a benchmark of one scene."""
    talk = talk_of(quiet)
    with errors_told(talk):
        run = run_of(name, scene, preset, overrides, device, talk)
        folder = out or run.run_dir.with_name(f"{run.run_dir.name}-bench")
        check_places(folder, json)
        measure(run, folder)


def small_session(
    out: Path, json: Path | None, overrides: Sequence[str] | None, device: str, quiet: bool
) -> tuple[Path, list[str]]:
    """The small session in `out`, and its settings before those that were given.

    Nothing is rendered where the device is not there, or a place cannot be written.
    """
    from devrf.pipelines.bench.stability.session import SETTINGS, session

    talk = talk_of(quiet)
    with errors_told(talk):
        resolve_device(device)
        check_places(out, json)
        return session(out, talk), [*SETTINGS, *(overrides or [])]


def check_places(out: Path, json: Path | None) -> None:
    """Refuse places that cannot be written; nothing is made yet."""
    check_folder(out, "--out")
    if json is not None:
        check_file(json, "--json")


def run_of(
    name: str, scene: Path, preset: str | None, overrides: Sequence[str] | None, device: str, talk: Talk
) -> Run:
    """A scene in motion as a benchmark takes it."""
    config, scene_dir = configured(scene, preset, overrides)
    if config.kind not in ("dynamic", "dataset"):
        raise InputError(f"{scene}: bench {name} needs a scene in motion, with a sweep and moving cameras")
    on = resolve_device(device, config.budget.gpu_memory_gb)
    return Run(config, scene_dir, STAGES, Choice(), talk, on)
