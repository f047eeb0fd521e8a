"""`devrf-pipeline simulate`: its options. The simulator is loaded when it is asked for."""

from pathlib import Path
from typing import Annotated

import typer

from devrf.pipelines.terminal.shared_options import QuietOption, errors_told, talk_of


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to write into")],
    scene: Annotated[
        str | None,
        typer.Option(
            help="What moves. session: sheet (default), column, blocks, figure, plant, leaving, rod, "
            "workshop (a furnished room filmed with phones) and others; "
            "devrf, devrf-forward: robot, flower or arm (default: arm; forward: flower)"
        ),
    ] = None,
    protocol: Annotated[
        str,
        typer.Option(
            help="session: raw clips as a crew brings them home. devrf: a data set from all around with exact "
            "flow and depth. devrf-forward: the same from side by side, before a wall"
        ),
    ] = "session",
    cameras: Annotated[
        int | None,
        typer.Option(
            help="Fixed cameras, without the witness or test camera. Default: 4; devrf-forward: 3. "
            "devrf: more cameras begin with those of fewer"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed")] = 0,
    size: Annotated[
        str | None,
        typer.Option(
            help="Size of the pictures, WIDTHxHEIGHT. Default: 480x360, workshop 640x360; devrf: 400x400; "
            "devrf-forward: 480x270"
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Option of the protocol: spp=24 (repeatable)")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Render a raw session or a data set with known truth (needs the extra `simulate`).

    A data set that was begun with the same arguments is completed; a complete one is left as it is.
    """
    from devrf.lab import simulate_command

    talk = talk_of(quiet)
    with errors_told(talk):
        simulate_command.simulate(talk, out, scene, protocol, cameras, seed, size, settings or [])
