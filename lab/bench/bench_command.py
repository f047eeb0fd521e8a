"""`devrf-pipeline bench …`: words of the command line into benchmarks."""

import math
from typing import Annotated, get_args

import typer

from devrf.capture.system.errors import InputError
from devrf.lab.bench.accuracy.accuracy_commands import add_accuracy
from devrf.lab.bench.arguments import (
    BenchRequest,
    SeedsOption,
    SmallSceneArgument,
    names_of,
    numbers_of,
    of_a_scene,
)
from devrf.lab.bench.training.ablation_variants import VARIANTS
from devrf.lab.methods.method_table import METHODS, OURS, Regime, Size
from devrf.pipelines.terminal.shared_options import configured
from devrf.reconstruct.options import PresetName

bench = typer.Typer(help="Measured tables and charts.", no_args_is_help=True, rich_markup_mode=None)


@of_a_scene(bench)
def ablation(
    asked: BenchRequest,
    seeds: SeedsOption = 1,
    only: Annotated[str | None, typer.Option(help="Some of the variants: base,c2f")] = None,
) -> None:
    """What each part of the motion's training is worth: base, c2f, +tv, +cycle, +flow."""
    from devrf.lab.bench.training.ablation import run_ablation

    chosen = VARIANTS if only is None else names_of("--only", only.replace("+", ""), VARIANTS)
    run_ablation(asked.bench, range(seeds), asked.rows, chosen)


@of_a_scene(bench)
def views(asked: BenchRequest, seeds: SeedsOption = 1) -> None:
    """How quality depends on the number of moving cameras, from one to all there are."""
    from devrf.lab.bench.training.views import run_views

    run_views(asked.bench, range(seeds), asked.rows)


@of_a_scene(bench)
def speed(
    asked: BenchRequest,
    presets: Annotated[str, typer.Option(help="What is compared")] = ",".join(get_args(PresetName)),
    efforts: Annotated[
        str, typer.Option(help="Shares of each preset's iterations, each a training of its own: 0.25,0.5,1")
    ] = "1",
    every: Annotated[
        float, typer.Option(min=0.1, help="Seconds of training between two evaluations, initially")
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
def methods(
    asked: BenchRequest,
    names: Annotated[
        str, typer.Option("--methods", help=f"What is compared, out of {', '.join(METHODS)}")
    ] = f"d-nerf,k-planes,gaussians,{OURS}",
    regime: Annotated[Regime, typer.Option(help="What is trained on")] = "joint",
    size: Annotated[Size, typer.Option(help="Widths of the networks: for a CPU, or as published")] = "small",
    seconds: Annotated[float, typer.Option(min=1, help="Of training, of each")] = 300.0,
    steps: Annotated[int | None, typer.Option(min=1, help="At most so many iterations of each")] = None,
    seeds: SeedsOption = 1,
) -> None:
    """Methods for moving scenes, on the same data, split and clock.

    regime: joint trains on sweep and moving cameras together; two-stage first on the sweep, then on the moving
    cameras; dynamic on these alone. A benchmark that was stopped goes on where it was, with the same --out.
    """
    from devrf.lab.bench.training.methods import Contest, run_methods

    chosen = names_of("--methods", names, list(METHODS))
    run_methods(asked.bench, Contest(chosen, regime, size, seconds, steps, range(seeds)), asked.rows)


@of_a_scene(bench, SmallSceneArgument, preset="")
def stability(
    asked: BenchRequest,
    axes: Annotated[
        str | None, typer.Option(help="Some of the axes or groups of them, by name; default: all")
    ] = None,
    severities: Annotated[
        int | None, typer.Option(min=1, help="How many of each axis, the worst among them; default: all")
    ] = None,
    seeds: SeedsOption = 1,
    minutes: Annotated[float, typer.Option(min=0, help="No case begins later")] = math.inf,
    methods: Annotated[
        str | None,
        typer.Option(
            help=f"Methods side by side, out of {', '.join(METHODS)}; default: the pipeline as it is"
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=1, help="With --methods: of training, of each")] = 60.0,
) -> None:
    """Where the pipeline breaks: the scene along one axis of damage at a time, and what the pipeline says there.

    With --methods: where which method fails, on what the pipeline calibrates (joint, small networks). A suite that was
    stopped goes on where it was, with the same --out.
    """
    from devrf.lab.bench.stability.axes import AXES, GROUPS, axes_of
    from devrf.lab.bench.stability.suite import Extent, run_stability

    chosen = list(AXES) if axes is None else axes_of(names_of("--axes", axes, [*GROUPS, *AXES]))
    extent = Extent(severities, range(seeds), minutes)
    if methods is None:
        run_stability(asked.run, asked.folder, chosen, extent, asked.rows)
        return
    from devrf.lab.bench.stability.methods_suite import run_stability_of_methods
    from devrf.lab.bench.training.methods import Contest

    names = names_of("--methods", methods, list(METHODS))
    contest = Contest(names, "joint", "small", seconds, None, extent.seeds)
    run_stability_of_methods(asked.run, asked.folder, chosen, extent, contest, asked.rows)


add_accuracy(bench)
