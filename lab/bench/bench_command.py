"""`devrf-pipeline bench …`: words of the command line into benchmarks."""

import math
from pathlib import Path
from typing import Annotated, get_args

import typer

from devrf.capture.errors import InputError
from devrf.lab.bench.accuracy.accuracy_commands import add_accuracy
from devrf.lab.bench.arguments import (
    Asked,
    SeedsOption,
    SmallSceneArgument,
    names_of,
    numbers_of,
    of_a_scene,
)
from devrf.pipelines.cli_options import configured
from devrf.reconstruct.ablation import VARIANTS
from devrf.reconstruct.options import PresetName

bench = typer.Typer(help="Measured tables and charts.", no_args_is_help=True, rich_markup_mode=None)


@of_a_scene(bench)
def ablation(
    asked: Asked,
    seeds: SeedsOption = 1,
    only: Annotated[str | None, typer.Option(help="Some of the variants: base,c2f")] = None,
) -> None:
    """What each part of the motion's training is worth: base, c2f, +tv, +cycle, +flow."""
    from devrf.lab.bench.training.ablation import run_ablation

    chosen = VARIANTS if only is None else names_of("--only", only.replace("+", ""), VARIANTS)
    run_ablation(asked.bench, range(seeds), asked.rows, chosen)


@of_a_scene(bench)
def views(asked: Asked, seeds: SeedsOption = 1) -> None:
    """How quality depends on the number of moving cameras, from one to all there are."""
    from devrf.lab.bench.training.views import run_views

    run_views(asked.bench, range(seeds), asked.rows)


@of_a_scene(bench)
def speed(
    asked: Asked,
    presets: Annotated[str, typer.Option(help="What is compared")] = ",".join(get_args(PresetName)),
    efforts: Annotated[
        str, typer.Option(help="Shares of each preset's iterations, each a training of its own: 0.25,0.5,1")
    ] = "1",
    every: Annotated[
        float, typer.Option(min=0.1, help="Seconds of training between two looks, at first")
    ] = 5.0,
    set_for: Annotated[
        list[str] | None,
        typer.Option(
            "--set-for", help="As --set, for one preset: reference:reconstruct.rays=2048 (repeatable)"
        ),
    ] = None,
) -> None:
    """Accuracy against seconds of training, megabytes and pictures per second, of several presets.

    --preset says at which size the pictures are taken, where reconstruct.image_scale does not.
    """
    from devrf.lab.bench.training.speed import run_speed

    own = {name: list(asked.overrides) for name in names_of("--presets", presets, get_args(PresetName))}
    shares = numbers_of("--efforts", efforts, 0.001, 100.0)
    for setting in set_for or []:
        name, _, text = setting.partition(":")
        if name not in own or not text.startswith("reconstruct."):
            wrong = (
                f"--set-for {setting}: expected PRESET:reconstruct.KEY=VALUE, with one of {', '.join(own)}"
            )
            raise InputError("option-malformed", wrong)
        own[name].append(text)
    assert asked.scene is not None
    chosen = {name: configured(asked.scene, name, of)[0].reconstruct for name, of in own.items()}
    run_speed(asked.bench, chosen, shares, every, asked.rows)


@of_a_scene(bench)
def growth(
    asked: Asked,
    strides: Annotated[str, typer.Option(help="Every n-th time of a data set")] = "4,2,1",
    shares: Annotated[str, typer.Option(help="Of the resolution at rest")] = "0.5,0.7,1",
    other: Annotated[
        list[Path] | None, typer.Option(help="Another scene, in which more or less moves (repeatable)")
    ] = None,
) -> None:
    """How seconds and bytes grow with the number of pictures, with the resolution, and with what moves."""
    from devrf.lab.bench.training.growth import run_growth

    every = numbers_of("--strides", strides, 1.0, 1000.0)
    if any(n % 1 for n in every):
        raise InputError("option-malformed", f"--strides {strides}: expected whole numbers, such as 4,2,1")
    sizes = numbers_of("--shares", shares, 0.01, 1.0)
    others = [asked.of(path) for path in other or []]
    run_growth(asked.run, asked.folder, [int(n) for n in every], sizes, others, asked.rows)


@of_a_scene(bench, preset="reference")
def reference(
    asked: Asked,
    minutes: Annotated[float, typer.Option(min=0, help="No part of the ablation begins later")] = 9.0,
) -> None:
    """The published recipe in full, and the ablation at half size: quality, seconds, memory."""
    from devrf.lab.bench.training.reference import run_reference

    run_reference(asked.run, asked.folder, asked.rows, minutes)


@of_a_scene(bench, SmallSceneArgument, preset="")
def stability(
    asked: Asked,
    axes: Annotated[
        str | None, typer.Option(help="Some of the axes or groups of them, by name; default: all")
    ] = None,
    severities: Annotated[
        int | None, typer.Option(min=1, help="How many of each axis, the worst among them; default: all")
    ] = None,
    seeds: SeedsOption = 1,
    minutes: Annotated[float, typer.Option(min=0, help="No case begins later")] = math.inf,
) -> None:
    """Where the pipeline breaks: the scene along one axis of damage at a time, and what the pipeline says there.

    A suite that was stopped goes on where it was, with the same --out.
    """
    from devrf.lab.bench.stability.axes import AXES, GROUPS, axes_of
    from devrf.lab.bench.stability.suite import run_stability

    chosen = list(AXES) if axes is None else axes_of(names_of("--axes", axes, [*GROUPS, *AXES]))
    run_stability(asked.run, asked.folder, chosen, severities, range(seeds), asked.rows, minutes)


@of_a_scene(bench, SmallSceneArgument)
def parts(
    asked: Asked,
    parts: Annotated[
        str | None, typer.Option(help="Some of the parts, by name; default: all that are in use")
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=2, max=100, help="Pairs of trainings per part; they give the interval")
    ] = 3,
) -> None:
    """What each part of the model earns: trainings with and without it, paired by seed, 95 % intervals.

    A benchmark that was stopped goes on where it was, with the same --out.
    """
    from devrf.lab.bench.training.parts import run_parts
    from devrf.reconstruct.parts import PARTS

    known = [part.name for part in PARTS]
    chosen = known if parts is None else names_of("--parts", parts, known)
    run_parts(asked.bench, chosen, range(seeds), asked.rows)


add_accuracy(bench)
