"""`bench calibration`, `sync`, `flow` and `ingest`: parts of the pipeline against references, without a scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from devrf.capture.system.errors import InputError
from devrf.lab.bench.arguments import JsonOption, check_places, names_of
from devrf.pipelines.terminal.shared_options import QuietOption, errors_told, talk_of

ACCURACY: dict[str, tuple[str, dict[str, str]]] = {
    "calibration": (
        "Boards, rigs, sweeps and colours against references, on real captures and simulated ones.",
        {name: name for name in ("boards", "colour", "sweeps", "rigs")},
    ),
    "sync": (
        "Clocks from sound, light and motion against known offsets, on real captures and simulated ones.",
        {"flash": "sync_flash", "motion": "sync_motion", "sound": "sync_sound"},
    ),
    "flow": (
        "Every method's error on pairs with truth, seconds per pair, and bytes per pixel on disk.",
        dict.fromkeys(("accuracy", "speed", "store"), "flow_pairs"),
    ),
    "ingest": (
        "Speed of ingest against plain decoding, memory against length, RAW photos, and what storing pictures costs.",
        dict.fromkeys(("speed", "memory", "raw", "quality"), "ingest_speed"),
    ),
}
"""By command: what it says of itself, and its parts: functions from `Cases` to rows, each with its module."""


def add_accuracy(group: typer.Typer) -> None:
    """Add these commands to a group."""
    for title, (about, parts) in ACCURACY.items():
        _add(group, title, about, parts)


def _add(group: typer.Typer, title: str, about: str, parts: Mapping[str, str]) -> None:
    which = f"Some of the parts, by name, with commas between; default: all of {','.join(parts)}"
    where = f"Folder for what the parts make; default: bench-{title}"

    def command(
        data: Annotated[
            Path | None, typer.Option(help="Folder of real captures with references, a folder each")
        ] = None,
        only: Annotated[str | None, typer.Option(help=which)] = None,
        out: Annotated[Path | None, typer.Option(help=where)] = None,
        json: JsonOption = None,
        quiet: QuietOption = False,
    ) -> None:
        from devrf.lab.bench.accuracy.cases import Cases, run_parts

        talk = talk_of(quiet)
        with errors_told(talk):
            if data is not None and not data.is_dir():
                text = f"--data {data}: no such folder; name the folder that holds the captures' folders"
                raise InputError("folder-missing", text)
            chosen = {name: parts[name] for name in names_of("--only", only or ",".join(parts), list(parts))}
            folder = out or Path(f"bench-{title}")
            check_places(folder, json)
            folder.mkdir(parents=True, exist_ok=True)
            run_parts(title, chosen, Cases(data, folder, talk), json or folder / f"{title}.json")

    command.__doc__ = about
    group.command(title)(command)
