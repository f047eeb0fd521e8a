"""What the command line takes, read from the functions behind it: typer's public face is their signatures alone."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo

WORDS = {str: "text", Path: "path", int: "whole number", float: "number", bool: ""}


@dataclass(frozen=True)
class Parameter:
    """An argument or an option.

    Attributes:
        names: Of an option, its spellings; of an argument, none.
        shown: What to call it: `SCENE`, `--preset`.
        takes: Kind of value, in words; empty for a switch.
        default: What it is where it is not given; None where that is nothing.
        needed: Whether it has to be given.
        repeatable: Whether it may be given several times.
        help: What it means.
    """

    names: tuple[str, ...]
    shown: str
    takes: str
    default: Any
    needed: bool
    repeatable: bool
    help: str


@dataclass(frozen=True)
class Command:
    """A command: its words after the program's name, what it does, what it takes."""

    name: str
    help: str
    parameters: tuple[Parameter, ...]

    @property
    def options(self) -> set[str]:
        """All spellings of its options."""
        return {"--help"} | {name for parameter in self.parameters for name in parameter.names}


def commands_of(app: typer.Typer, words: str = "") -> dict[str, Command]:
    """Every command, those of groups too (`bench speed`), in the order of `--help`."""
    found = {}
    for info in app.registered_commands:
        assert info.callback is not None
        name = f"{words} {info.name or info.callback.__name__.replace('_', '-')}".strip()
        found[name] = Command(name, inspect.getdoc(info.callback) or "", _parameters(info.callback))
    for group in app.registered_groups:
        assert group.typer_instance is not None
        found |= commands_of(group.typer_instance, f"{words} {group.name}".strip())
    return found


def _parameters(function: Callable[..., Any]) -> tuple[Parameter, ...]:
    return tuple(map(_parameter, inspect.signature(function, eval_str=True).parameters.values()))


def _parameter(parameter: inspect.Parameter) -> Parameter:
    kind, *marks = get_args(parameter.annotation)
    (info,) = (mark for mark in marks if isinstance(mark, ArgumentInfo | OptionInfo))
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (k for k in get_args(kind) if k is not type(None))
    many = get_origin(kind) is list
    kind = get_args(kind)[0] if many else kind
    needed = parameter.default is inspect.Parameter.empty
    names: tuple[str, ...] = ()
    shown = parameter.name.upper() + ("..." if many else "")
    if isinstance(info, OptionInfo):
        plain = parameter.name.replace("_", "-")
        both = (f"--{plain}", f"--no-{plain}") if kind is bool else (f"--{plain}",)
        first = (info.default,) if isinstance(info.default, str) else ()  # where typer keeps Option("--name")
        declared = [d for d in (*first, *(info.param_decls or ())) if d.startswith("-")]
        names = tuple(name for d in declared for name in d.split("/")) or both
        shown = names[0]
    takes = WORDS[kind] + (f" from {info.min}" if info.min is not None else "")
    default = None if needed or parameter.default is False else parameter.default
    return Parameter(names, shown, takes, default, needed, many and bool(names), info.help or "")
