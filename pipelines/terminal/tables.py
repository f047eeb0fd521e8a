"""Tables for a terminal or a pipe."""

from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from devrf.pipelines.terminal.console import Talk, console_on

PIPE_WIDTH = 110  # characters, where no terminal says how wide it is


def print_table(
    talk: Talk, title: str | None, headings: Sequence[str], lines: Iterable[Sequence[str]]
) -> None:
    """Lines under headings; the first column stands left, and so does one whose heading ends with a star."""
    if talk.loudness == "quiet":
        return
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for n, heading in enumerate(headings):
        left = n == 0 or heading.endswith("*")
        table.add_column(heading.rstrip("*"), justify="left" if left else "right", overflow="fold")
    for line in lines:
        table.add_row(*line)
    width = None if talk.out.is_terminal else PIPE_WIDTH
    console_on(talk.out.file, width=width).print(table)
