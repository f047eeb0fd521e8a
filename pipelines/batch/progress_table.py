"""The state of a batch while it runs: batch.json, a live table on a terminal, plain lines elsewhere."""

import time
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from devrf.capture.system.durable import write_json
from devrf.pipelines.batch.scene_rows import SceneRow, summary
from devrf.pipelines.terminal.console import Talk, duration

JSON_FILE = "batch.json"
WRITE_EVERY_S = 2.0  # at most; a thousand scenes make a file of a megabyte


class Board:
    """Rows of a batch, shown and written.

    Args:
        talk: Where to speak.
        out: Folder of the summary.
        rows: One per scene.
        engine: What carries out the tasks, in words.
    Attributes:
        written: Whether the file is as the rows were when it was last written.
    """

    def __init__(self, talk: Talk, out: Path, rows: list[SceneRow], engine: str) -> None:
        self.rows, self.written = rows, True
        self._talk, self._out, self._engine = talk, out, engine
        self._started, self._start = time.strftime("%Y-%m-%d %H:%M:%S"), time.monotonic()
        self._written_s = -WRITE_EVERY_S

    def live(self) -> AbstractContextManager:
        """On a terminal, a table of what runs that keeps itself up to date; elsewhere nothing."""
        if self._talk.loudness == "quiet":
            return nullcontext()
        return Live(get_renderable=self._table, console=self._talk.out, refresh_per_second=2, transient=True)

    def say(self, row: SceneRow, text: str) -> None:
        """One line about a scene."""
        self._talk.say(f"{row.name}: {text}")

    def ended(self, row: SceneRow) -> None:
        """A scene will not be gone on with."""
        took = f" in {duration(row.seconds)}" if row.seconds else ""
        if row.code == 0:
            self.say(row, f"done{took}" if row.seconds else "nothing to do")
        else:
            why = row.message or f"exit code {row.code}"
            self._talk.error(f"{row.name}: {row.state}{took}: {why}", f"scene-{row.state}")

    def write(self, *, now: bool = True) -> None:
        """batch.json, whole or not at all; a disk that is full does not stop the scenes.

        Args:
            now: Or only where it has not been written for a while.
        """
        if not now and time.monotonic() - self._written_s < WRITE_EVERY_S:
            return
        self._written_s = time.monotonic()
        seconds = self._written_s - self._start
        try:
            write_json(self._out / JSON_FILE, summary(self.rows, self._engine, self._started, seconds))
            self.written = True
        except OSError as error:
            if self.written:
                what = f"{self._out}: the summary cannot be written ({error.strerror}); make room there"
                self._talk.error(what, "folder-unwritable")
            self.written = False

    def _table(self) -> Group:
        """What runs now, and how many stand where."""
        table = Table(box=None)
        for column in ("scene", "stages made"):
            table.add_column(column, overflow="ellipsis", no_wrap=True)
        for row in self.rows:
            if row.state == "running":
                table.add_row(escape(row.name), ", ".join(row.made))
        counts = Counter(row.state for row in self.rows)
        states = ", ".join(f"{count} {state}" for state, count in counts.items())
        return Group(table, Text(f"{states}; {duration(time.monotonic() - self._start)}"))
