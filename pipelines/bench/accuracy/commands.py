"""`bench calibration`, `sync`, `flow` and `ingest`: parts of the pipeline against references, without a scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devrf.capture.errors import InputError
from devrf.pipelines.bench.arguments import JsonOption, check_places, names_of
from devrf.pipelines.cli_options import QuietOption, errors_told, talk_of

if TYPE_CHECKING:
    from devrf.pipelines.bench.accuracy.cases import Part

DataOption = Annotated[
    Path | None, typer.Option(help="Folder of real captures with references, a folder each")
]
PARTS_HELP = "Some of the parts, by name, with commas between; default: all of "


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


def sync(
    data: DataOption = None,
    only: Annotated[str | None, typer.Option(help=PARTS_HELP + "flash,motion,sound")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for what the parts make; default: bench-sync")
    ] = None,
    json: JsonOption = None,
    quiet: QuietOption = False,
) -> None:
    """Clocks from sound, light and motion against known offsets, on real captures and simulated ones."""
    from devrf.pipelines.bench.accuracy.parts import SYNC

    _accuracy("sync", SYNC, data, only, out, json, quiet)


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
        chosen = list(parts) if only is None else names_of("--only", only, list(parts))
        folder = out or Path(f"bench-{title}")
        check_places(folder, json)
        folder.mkdir(parents=True, exist_ok=True)
        run_parts(title, parts, chosen, Cases(data, folder, talk), json or folder / f"{title}.json")
