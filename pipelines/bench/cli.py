"""`devrf-pipeline bench …`: words of the command line into benchmarks."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from devrf.capture.errors import InputError
from devrf.capture.writable import check_file, check_folder
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
from devrf.pipelines.console import Talk
from devrf.pipelines.device import resolve_device
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stages import STAGES
from devrf.reconstruct.ablation import VARIANTS
from devrf.reconstruct.options import PresetName

if TYPE_CHECKING:
    from devrf.pipelines.bench.accuracy.cases import Part

bench = typer.Typer(help="Measured tables and charts.", no_args_is_help=True, rich_markup_mode=None)

SeedsOption = Annotated[int, typer.Option(min=1, max=100, help="Trainings per case; they give the spread")]
OutOption = Annotated[
    Path | None, typer.Option(help="Folder for models and pictures; default: beside the run folder")
]
DataOption = Annotated[
    Path | None, typer.Option(help="Folder of real captures with references, a folder each")
]
PARTS_HELP = "Some of the parts, by name, with commas between; default: all of "
SmallSceneArgument = Annotated[
    Path | None,
    typer.Argument(help="scene.yaml with test cameras; default: a small simulated session, rendered first"),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Rows as JSON; a chart is drawn beside it")]


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

        chosen = VARIANTS if only is None else _names("--only", only.replace("+", ""), VARIANTS)
        run_ablation(Bench.prepare(run, folder), range(seeds), json or folder / "ablation.json", chosen)

    _measure("ablation", measure, scene, preset, overrides, out, json, device, quiet)


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

    _measure("views", measure, scene, preset, overrides, out, json, device, quiet)


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
            _names("--presets", presets, get_args(PresetName)),
            _numbers("--efforts", efforts, 0.001, 100),
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

    _measure("speed", measure, scene, preset, overrides, out, json, device, quiet)


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

        every = _numbers("--strides", strides, 1, 1000)
        if any(n % 1 for n in every):
            raise InputError(f"--strides {strides}: expected whole numbers, such as 4,2,1")
        sizes = _numbers("--shares", shares, 0.01, 1)
        others = [_run("growth", path, preset, overrides, device, run.talk) for path in other or []]
        run_growth(run, folder, [int(n) for n in every], sizes, others, json or folder / "growth.json")

    _measure("growth", measure, scene, preset, overrides, out, json, device, quiet)


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

    _measure("reference", measure, scene, "reference", overrides, out, json, device, quiet)


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

    talk = talk_of(quiet)
    with errors_told(talk):  # before anything is rendered
        chosen = list(AXES) if axes is None else axes_of(_names("--axes", axes, [*GROUPS, *AXES]))
        resolve_device(device)

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.stability.stability import run_stability

        path = json or folder / "stability.json"
        run_stability(run, folder, chosen, severities, range(seeds), path, minutes)

    if scene is None:
        out = out or Path("bench-stability")
        scene, overrides = _small_session(out, json, overrides, quiet)
    _measure("stability", measure, scene, None, overrides, out, json, device, quiet)


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

    def measure(run: Run, folder: Path) -> None:
        from devrf.pipelines.bench.parts import run_parts
        from devrf.pipelines.bench.trainings import Bench
        from devrf.reconstruct.parts import PARTS

        known = [part.name for part in PARTS]
        chosen = known if parts is None else _names("--parts", parts, known)
        run_parts(Bench.prepare(run, folder), chosen, range(seeds), json or folder / "parts.json")

    if scene is None:
        out = out or Path("bench-parts")
        chosen_preset = [] if preset is None else [f"preset={preset}"]  # before it stands the session's own
        scene, overrides = _small_session(out, json, [*chosen_preset, *(overrides or [])], quiet)
    _measure("parts", measure, scene, preset, overrides, out, json, device, quiet)


@bench.command()
def calibration(
    data: DataOption = None,
    only: Annotated[str | None, typer.Option(help=PARTS_HELP + "boards,colour,sweeps,rigs")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for what the parts make; default: bench-calibration")
    ] = None,
    json: JsonOption = None,
    quiet: QuietOption = False,
) -> None:
    """Boards, rigs, sweeps and colours against references, on real captures and simulated ones."""
    from devrf.pipelines.bench.accuracy.parts import CALIBRATION

    _accuracy("calibration", CALIBRATION, data, only, out, json, quiet)


@bench.command()
def sync(
    data: DataOption = None,
    only: Annotated[str | None, typer.Option(help=PARTS_HELP + "flash,learned,motion,sound")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for what the parts make; default: bench-sync")
    ] = None,
    json: JsonOption = None,
    quiet: QuietOption = False,
) -> None:
    """Clocks from sound, light and motion against known offsets, on real captures and simulated ones."""
    from devrf.pipelines.bench.accuracy.parts import SYNC

    _accuracy("sync", SYNC, data, only, out, json, quiet)


@bench.command()
def flow(
    data: DataOption = None,
    only: Annotated[str | None, typer.Option(help=PARTS_HELP + "accuracy,speed,store")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for what the parts make; default: bench-flow")
    ] = None,
    json: JsonOption = None,
    quiet: QuietOption = False,
) -> None:
    """Every method's error on pairs with truth, seconds per pair, and bytes per pixel on disk."""
    from devrf.pipelines.bench.accuracy.parts import FLOW

    _accuracy("flow", FLOW, data, only, out, json, quiet)


@bench.command()
def ingest(
    data: DataOption = None,
    only: Annotated[str | None, typer.Option(help=PARTS_HELP + "speed,memory,raw,quality")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for what the parts make; default: bench-ingest")
    ] = None,
    json: JsonOption = None,
    quiet: QuietOption = False,
) -> None:
    """Speed of ingest against plain decoding, memory against length, RAW photos, and what storing pictures costs."""
    from devrf.pipelines.bench.ingest import INGEST

    _accuracy("ingest", INGEST, data, only, out, json, quiet)


def _accuracy(
    title: str,
    parts: "Mapping[str, Part]",
    data: Path | None,
    only: str | None,
    out: Path | None,
    json: Path | None,
    quiet: bool,
) -> None:
    from devrf.pipelines.bench.accuracy.cases import Cases, run_parts

    talk = talk_of(quiet)
    with errors_told(talk):
        if data is not None and not data.is_dir():
            raise InputError(
                f"--data {data}: no such folder; name the folder that holds the captures' folders"
            )
        chosen = list(parts) if only is None else _names("--only", only, list(parts))
        folder = out or Path(f"bench-{title}")
        _check_places(folder, json)
        folder.mkdir(parents=True, exist_ok=True)
        run_parts(title, parts, chosen, Cases(data, folder, talk), json or folder / f"{title}.json")


def _names(option: str, text: str, known: Sequence[str]) -> list[str]:
    """Names out of those that are known, as `base,c2f` lists them."""
    names = [name.strip() for name in text.split(",")]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"{option} {', '.join(unknown)}: unknown, expected {', '.join(known)}")
    return names


def _numbers(option: str, text: str, least: float, most: float) -> list[float]:
    """Numbers within bounds, as `0.25,1` names them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(least <= number <= most for number in numbers):
        raise InputError(f"{option} {text}: expected numbers from {least:g} to {most:g}, such as {least:g},1")
    return numbers


def _measure(
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
        run = _run(name, scene, preset, overrides, device, talk)
        folder = out or run.run_dir.with_name(f"{run.run_dir.name}-bench")
        _check_places(folder, json)
        measure(run, folder)


def _small_session(
    out: Path, json: Path | None, overrides: Sequence[str] | None, quiet: bool
) -> tuple[Path, list[str]]:
    """The small session in `out`, and its settings before those that were given."""
    from devrf.pipelines.bench.stability.session import SETTINGS, session

    talk = talk_of(quiet)
    with errors_told(talk):
        _check_places(out, json)
        return session(out, talk), [*SETTINGS, *(overrides or [])]


def _check_places(out: Path, json: Path | None) -> None:
    """Refuse places that cannot be written; nothing is made yet."""
    check_folder(out, "--out")
    if json is not None:
        check_file(json, "--json")


def _run(
    name: str, scene: Path, preset: str | None, overrides: Sequence[str] | None, device: str, talk: Talk
) -> Run:
    """A scene in motion as a benchmark takes it."""
    config, scene_dir = configured(scene, preset, overrides)
    if config.kind not in ("dynamic", "dataset"):
        raise InputError(f"{scene}: bench {name} needs a scene in motion, with a sweep and moving cameras")
    on = resolve_device(device, config.budget.gpu_memory_gb)
    return Run(config, scene_dir, STAGES, Choice(), talk, on)
