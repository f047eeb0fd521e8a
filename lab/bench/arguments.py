"""What the commands of `bench` share: options, words into names and numbers, and the scene that is measured."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_file, check_folder
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stages import STAGES
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.shared_options import (
    DeviceOption,
    PresetOption,
    QuietOption,
    SceneArgument,
    SetOption,
    configured,
    errors_told,
    talk_of,
)

if TYPE_CHECKING:
    from devrf.lab.bench.training.trainings import Bench

SeedsOption = Annotated[int, typer.Option(min=1, max=100, help="Trainings per case; they give the spread")]
OutOption = Annotated[
    Path | None, typer.Option(help="Folder for models and pictures; default: beside the run folder")
]
SmallSceneArgument = Annotated[
    Path | None,
    typer.Argument(help="scene.yaml with test cameras; default: a small simulated session, rendered first"),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Rows as JSON; a chart is drawn beside it")]
AROUND: dict[str, tuple[Any, Any]] = {
    "overrides": (SetOption, None),
    "out": (OutOption, None),
    "json": (JsonOption, None),
    "device": (DeviceOption, "auto"),
    "quiet": (QuietOption, False),
}
"""Options of every benchmark of a scene, behind its own, and their defaults."""


@dataclass
class BenchRequest:
    """A scene to be measured, as the command line names it; it is read, or rendered, when it is first needed.

    Attributes:
        name: Of the benchmark.
        scene: None: a small session, rendered into `out`.
        preset, overrides: Of the configuration.
        out, json: Where models and rows go, if it was said.
        device: In words.
    """

    name: str
    scene: Path | None
    preset: str | None
    overrides: Sequence[str]
    out: Path | None
    json: Path | None
    device: str
    talk: Talk

    @cached_property
    def run(self) -> Run:
        """The scene in motion; nothing is made where the device is not there, or a place cannot be written."""
        if self.scene is None:
            from devrf.lab.bench.stability.small_session import SETTINGS, session

            resolve_device(self.device)
            self.out = self.out or Path(f"bench-{self.name}")
            check_places(self.out, self.json)
            preset = [] if self.preset is None else [f"preset={self.preset}"]
            self.scene = session(self.out, self.talk)
            self.overrides = [*SETTINGS, *preset, *self.overrides]
        run = self.of(self.scene)
        self.out = self.out or run.run_dir.with_name(f"{run.run_dir.name}-bench")
        check_places(self.out, self.json)
        return run

    def of(self, scene: Path) -> Run:
        """A scene with the same preset and overrides."""
        config, scene_dir = configured(scene, self.preset, self.overrides)
        if config.kind not in ("dynamic", "dataset"):
            text = f"{scene}: bench {self.name} needs a scene in motion, with a sweep and moving cameras"
            raise InputError("scene-without-motion", text)
        on = resolve_device(self.device, config.budget.gpu_memory_gb)
        return Run(config, scene_dir, STAGES, Choice(), self.talk, on)

    @property
    def folder(self) -> Path:
        """Where models and pictures go."""
        assert self.run is not None and self.out is not None  # the run says where, if nobody else
        return self.out

    @property
    def rows(self) -> Path:
        """The file of the rows."""
        return self.json or self.folder / f"{self.name}.json"

    @property
    def bench(self) -> "Bench":
        """The scene made ready for trainings."""
        from devrf.lab.bench.training.trainings import Bench

        return Bench.prepare(self.run, self.folder)


def of_a_scene(
    group: typer.Typer, scene: Any = SceneArgument, preset: str | None = None
) -> Callable[[Callable[..., None]], None]:
    """A function of a `BenchRequest` and options of its own becomes a command that has the shared ones, too.

    Args:
        group: The commands.
        scene: The argument; where it may be missing, the small session is measured.
        preset: The only one there is, or "" for the file's; None: there is an option.
    """

    def add(measure: Callable[..., None]) -> None:
        own = list(inspect.signature(measure).parameters.values())[1:]
        before = {"scene": (scene, inspect.Parameter.empty if scene is SceneArgument else None)}
        before |= {"preset": (PresetOption, None)} if preset is None else {}
        options = before | {p.name: (p.annotation, p.default) for p in own} | AROUND

        def command(**given: Any) -> None:
            talk = talk_of(given["quiet"])
            shared = (given["scene"], given.get("preset", preset or None), given["overrides"] or [])
            places = (given["out"], given["json"], given["device"])
            with errors_told(talk):
                asked = BenchRequest(measure.__name__, *shared, *places, talk)
                measure(asked, **{p.name: given[p.name] for p in own})

        command.__doc__ = measure.__doc__
        command.__annotations__ = {name: annotation for name, (annotation, _) in options.items()}
        parameter = partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY)
        parameters = [parameter(name, annotation=of, default=value) for name, (of, value) in options.items()]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        group.command(measure.__name__)(command)

    return add


def names_of(option: str, text: str, known: Sequence[str]) -> list[str]:
    """Names out of those that are known, as `base,c2f` lists them."""
    names = [name.strip() for name in text.split(",")]
    unknown = [name for name in names if name not in known]
    if unknown:
        text = f"{option} {', '.join(unknown)}: unknown, expected {', '.join(known)}"
        raise InputError("option-unknown-value", text)
    return names


def numbers_of(option: str, text: str, least: float, most: float) -> list[float]:
    """Numbers within bounds, as `0.25,1` names them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(least <= number <= most for number in numbers):
        text = f"{option} {text}: expected numbers from {least:g} to {most:g}, such as {least:g},1"
        raise InputError("option-malformed", text)
    return numbers


def check_places(out: Path, json: Path | None) -> None:
    """Refuse places that cannot be written; nothing is made yet."""
    check_folder(out, "--out")
    if json is not None:
        check_file(json, "--json", ['"rows": ', '"benchmark": '])
