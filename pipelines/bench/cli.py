"""`devrf-pipeline bench …`: words of the command line into benchmarks."""

import math
from pathlib import Path
from typing import Annotated, get_args

import typer

from devrf.capture.errors import InputError
from devrf.pipelines.bench.accuracy.commands import calibration, flow, ingest, sync
from devrf.pipelines.bench.arguments import (
    JsonOption,
    OutOption,
    SeedsOption,
    SmallSceneArgument,
    names_of,
    numbers_of,
    run_benchmark,
    run_of,
    small_session,
)
from devrf.pipelines.cli_options import (
    DeviceOption,
    PresetOption,
    QuietOption,
    SceneArgument,
    SetOption,
    configured,
    errors_told,
    talk_of,
)
from devrf.pipelines.runner.run import Run
from devrf.reconstruct.ablation import VARIANTS
from devrf.reconstruct.options import PresetName

bench = typer.Typer(help="Measured tables and charts.", no_args_is_help=True, rich_markup_mode=None)


@bench.command()
def ablation(
    scene: SceneArgument,
    preset: PresetOption = None,
    seeds: SeedsOption = 1,
    only: Annotated[str | None, typer.Option(help="Some of the variants: base,c2f")] = None,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """What each part of the motion's training is worth: base, c2f, +tv, +cycle, +flow."""

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.ablation import run_ablation
        from devrf.pipelines.bench.trainings import Bench

        chosen = VARIANTS if only is None else names_of("--only", only.replace("+", ""), VARIANTS)
        run_ablation(Bench.prepare(run, folder), range(seeds), json or folder / "ablation.json", chosen)

    run_benchmark("ablation", measure, scene, preset, overrides, out, json, device, quiet)


@bench.command()
def views(
    scene: SceneArgument,
    preset: PresetOption = None,
    seeds: SeedsOption = 1,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """How quality depends on the number of moving cameras, from one to all there are."""

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.trainings import Bench
        from devrf.pipelines.bench.views import run_views

        run_views(Bench.prepare(run, folder), range(seeds), json or folder / "views.json")

    run_benchmark("views", measure, scene, preset, overrides, out, json, device, quiet)


@bench.command()
def speed(
    scene: SceneArgument,
    preset: PresetOption = None,
    presets: Annotated[str, typer.Option(help="What is compared")] = ",".join(get_args(PresetName)),
    efforts: Annotated[
        str, typer.Option(help="Shares of each preset's iterations, each a training of its own: 0.25,0.5,1")
    ] = "1",
    every: Annotated[
        float, typer.Option(min=0.1, help="Seconds of training between two looks, at first")
    ] = 5.0,
    overrides: SetOption = None,
    set_for: Annotated[
        list[str] | None,
        typer.Option(
            "--set-for", help="As --set, for one preset: reference:reconstruct.rays=2048 (repeatable)"
        ),
    ] = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """Accuracy against seconds of training, megabytes and pictures per second, of several presets.

    --preset says at which size the pictures are taken, where reconstruct.image_scale does not.
    """

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.speed import run_speed
        from devrf.pipelines.bench.trainings import Bench

        names, shares = (
            names_of("--presets", presets, get_args(PresetName)),
            numbers_of("--efforts", efforts, 0.001, 100),
        )
        own: dict[str, list[str]] = {name: [] for name in names}
        for setting in set_for or []:
            name, _, text = setting.partition(":")
            if name not in own or not text.startswith("reconstruct."):
                raise InputError(
                    f"--set-for {setting}: expected PRESET:reconstruct.KEY=VALUE, with one of {', '.join(own)}"
                )
            own[name].append(text)
        chosen = {
            name: configured(scene, name, [*(overrides or []), *settings])[0].reconstruct
            for name, settings in own.items()
        }
        run_speed(Bench.prepare(run, folder), chosen, shares, every, json or folder / "speed.json")

    run_benchmark("speed", measure, scene, preset, overrides, out, json, device, quiet)


@bench.command()
def growth(
    scene: SceneArgument,
    preset: PresetOption = None,
    strides: Annotated[str, typer.Option(help="Every n-th time of a data set")] = "4,2,1",
    shares: Annotated[str, typer.Option(help="Of the resolution at rest")] = "0.5,0.7,1",
    other: Annotated[
        list[Path] | None, typer.Option(help="Another scene, in which more or less moves (repeatable)")
    ] = None,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """How seconds and bytes grow with the number of pictures, with the resolution, and with what moves."""

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.growth import run_growth

        every = numbers_of("--strides", strides, 1, 1000)
        if any(n % 1 for n in every):
            raise InputError(f"--strides {strides}: expected whole numbers, such as 4,2,1")
        sizes = numbers_of("--shares", shares, 0.01, 1)
        others = [run_of("growth", path, preset, overrides, device, run.talk) for path in other or []]
        run_growth(run, folder, [int(n) for n in every], sizes, others, json or folder / "growth.json")

    run_benchmark("growth", measure, scene, preset, overrides, out, json, device, quiet)


@bench.command()
def reference(
    scene: SceneArgument,
    minutes: Annotated[float, typer.Option(min=0, help="No part of the ablation begins later")] = 9.0,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """The published recipe in full, and the ablation at half size: quality, seconds, memory."""

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.reference import run_reference

        run_reference(run, folder, json or folder / "reference.json", minutes)

    run_benchmark("reference", measure, scene, "reference", overrides, out, json, device, quiet)


@bench.command()
def stability(
    scene: SmallSceneArgument = None,
    axes: Annotated[
        str | None, typer.Option(help="Some of the axes or groups of them, by name; default: all")
    ] = None,
    severities: Annotated[
        int | None, typer.Option(min=1, help="How many of each axis, the worst among them; default: all")
    ] = None,
    seeds: SeedsOption = 1,
    minutes: Annotated[float, typer.Option(min=0, help="No case begins later")] = math.inf,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """Where the pipeline breaks: the scene along one axis of damage at a time, and what the pipeline says there.

    A suite that was stopped goes on where it was, with the same --out.
    """

    from devrf.pipelines.bench.stability.axes import AXES, GROUPS, axes_of

    with errors_told(talk_of(quiet)):  # before anything is rendered
        chosen = list(AXES) if axes is None else axes_of(names_of("--axes", axes, [*GROUPS, *AXES]))

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.stability.stability import run_stability

        path = json or folder / "stability.json"
        run_stability(run, folder, chosen, severities, range(seeds), path, minutes)

    if scene is None:
        out = out or Path("bench-stability")
        scene, overrides = small_session(out, json, overrides, device, quiet)
    run_benchmark("stability", measure, scene, None, overrides, out, json, device, quiet)


@bench.command()
def parts(
    scene: SmallSceneArgument = None,
    preset: PresetOption = None,
    parts: Annotated[
        str | None, typer.Option(help="Some of the parts, by name; default: all that are in use")
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=2, max=100, help="Pairs of trainings per part; they give the interval")
    ] = 3,
    overrides: SetOption = None,
    out: OutOption = None,
    json: JsonOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
) -> None:
    """What each part of the model earns: trainings with and without it, paired by seed, 95 % intervals.

    A benchmark that was stopped goes on where it was, with the same --out.
    """

    from devrf.reconstruct.parts import PARTS

    known = [part.name for part in PARTS]
    with errors_told(talk_of(quiet)):  # before anything is rendered
        chosen = known if parts is None else names_of("--parts", parts, known)

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.parts import run_parts
        from devrf.pipelines.bench.trainings import Bench

        run_parts(Bench.prepare(run, folder), chosen, range(seeds), json or folder / "parts.json")

    if scene is None:
        out = out or Path("bench-parts")
        chosen_preset = [] if preset is None else [f"preset={preset}"]  # before it stands the session's own
        scene, overrides = small_session(out, json, [*chosen_preset, *(overrides or [])], device, quiet)
    run_benchmark("parts", measure, scene, preset, overrides, out, json, device, quiet)


for command in (calibration, sync, flow, ingest):
    bench.command()(command)
