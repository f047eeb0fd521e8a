"""Commands of the lab, `bench` and `simulate`: found by the entry points of the installed program, not by import."""

from collections.abc import Callable
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution

import typer

from devrf.capture.system.errors import InputError
from devrf.pipelines.terminal.shared_options import errors_told, talk_of

GROUP = "devrf.commands"
NAMES = ("simulate", "bench")


def add_installed(app: typer.Typer) -> None:
    """Add the commands that this installation declares; one that it lacks says so when it is called."""
    declared = _declared()
    for name in NAMES:
        if name not in declared:
            anything = {"allow_extra_args": True, "ignore_unknown_options": True}
            app.command(name, context_settings=anything)(_missing(name))
            continue
        command = declared[name].load()
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)


def _declared() -> dict[str, EntryPoint]:
    try:
        points = distribution(
            "devrf"
        ).entry_points  # a search through all distributions takes ten times as long
    except PackageNotFoundError:
        return {}
    return {point.name: point for point in points if point.group == GROUP}


def _missing(name: str) -> Callable[[], None]:
    def command() -> None:
        """Not there: this installation does not declare it."""
        with errors_told(talk_of(False)):
            text = (
                f"{name}: this installation of devrf declares no such command (no entry point {name} in the group "
                f"{GROUP}); install it anew: python -m pip install devrf-*.whl, or -e . in a checkout"
            )
            raise InputError("command-not-declared", text)

    return command
