"""docs/commands.md, from the command line itself: every command with its arguments and options."""

import re
from collections.abc import Iterator

from devrf.pipelines.cli import app
from devrf.pipelines.manual.command_line import Command, Parameter, commands_of

PROGRAM = "devrf-pipeline"
HEAD = f"""# Command line

<!-- Written by `python -m devrf.pipelines.manual`; what it says stands in pipelines/cli*.py and pipelines/bench. -->

Every command of `{PROGRAM}`; `{PROGRAM} COMMAND --help` says the same. Exit codes: 0 done; 1 a stage failed; 2 bad
configuration or input, seen before anything was started; 3 a health check refused the result
([conventions.md](conventions.md#exit-codes)).
"""


def page() -> str:
    """The page, as Markdown."""
    commands = commands_of(app).values()
    table = [f"| [`{c.name}`](#{_anchor(c)}) | {_escaped(_paragraphs(c)[0])} |" for c in commands]
    sections = [line for command in commands for line in _section(command)]
    return "\n".join([HEAD, "| command | does |", "|---|---|", *table, "", *sections])


def _section(command: Command) -> Iterator[str]:
    arguments = [p.shown if p.needed else f"[{p.shown}]" for p in command.parameters if not p.names]
    yield f"## {PROGRAM} {command.name}\n"
    yield f"```\n{' '.join([PROGRAM, command.name, *arguments, '[OPTIONS]'])}\n```\n"
    yield from (f"{_escaped(paragraph)}\n" for paragraph in _paragraphs(command))
    yield "| argument, option | takes | default | meaning |\n|---|---|---|---|"
    yield from map(_row, command.parameters)
    yield ""


def _row(parameter: Parameter) -> str:
    names = ", ".join(f"`{name}`" for name in parameter.names or (parameter.shown,))
    default = (
        "(needed)" if parameter.needed else "–" if parameter.default is None else f"`{parameter.default}`"
    )
    takes = parameter.takes + (", repeatable" if parameter.repeatable else "")
    return f"| {names} | {takes or 'nothing'} | {default} | {_escaped(parameter.help)} |"


def _paragraphs(command: Command) -> list[str]:
    return [" ".join(paragraph.split()) for paragraph in command.help.split("\n\n")]


def _anchor(command: Command) -> str:
    return f"{PROGRAM} {command.name}".replace(" ", "-")


def _escaped(text: str) -> str:
    """Help as Markdown; pages that it names become links."""
    return re.sub(r"docs/([\w-]+\.md)", r"[\1](\1)", text.replace("|", "\\|").replace("<", "&lt;"))
