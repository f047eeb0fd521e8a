"""The state of a batch while it runs: batch.json and batch.html, a live table on a terminal, plain lines elsewhere."""

import time
from pathlib import Path
from types import TracebackType

from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from devrf.capture.durable import write_json
from devrf.pipelines.batch.page import page
from devrf.pipelines.batch.rows import SceneRow, summary
from devrf.pipelines.console import Talk, duration

JSON_FILE, HTML_FILE = "batch.json", "batch.html"
WRITE_EVERY_S = 2.0  # at most; a thousand scenes make a page of a megabyte
COLOUR = {"done": "green", "running": "cyan", "waiting": "dim", "stopped": "dim", "unhealthy": "yellow"}


class Board:
    """Rows of a batch, shown and written.

    Args:
        talk: Where to speak.
        out: Folder of the summary.
        rows: One per scene.
        engine: What carries out the tasks, in words.
    Attributes:
        written: Whether the files are as the rows were when they were last written.
    """

    def __init__(self, talk: Talk, out: Path, rows: list[SceneRow], engine: str) -> None:
        self.rows, self.written = rows, True
        self._talk, self._out, self._engine = talk, out, engine
        self._started, self._start = time.strftime("%Y-%m-%d %H:%M:%S"), time.monotonic()
        self._written_s = -WRITE_EVERY_S
        live = talk.out.is_terminal and talk.loudness != "quiet"
        self._live = Live(console=talk.out, refresh_per_second=2, transient=True) if live else None

    def __enter__(self) -> "Board":
        if self._live is not None:
            self._live.start()
        self.show()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
        self.write()

    def say(self, row: SceneRow, text: str) -> None:
        """One line about a scene."""
        self._talk.say(f"{row.name}: {text}")

    def ended(self, row: SceneRow) -> None:
        """A scene will not be gone on with."""
        took = f" in {duration(row.seconds)}" if row.seconds else ""
        if row.code == 0:
            self.say(row, f"done{took}" if row.seconds else "nothing to do")
        else:
            self._talk.error(f"{row.name}: {row.state}{took}: {row.message or f'exit code {row.code}'}")

    def show(self) -> None:
        """Bring the table up to date, and now and then the files."""
        if self._live is not None:
            self._live.update(self._table())
        if time.monotonic() - self._written_s > WRITE_EVERY_S:
            self.write()

    def write(self) -> None:
        """batch.json and batch.html, each whole or not at all; a disk that is full does not stop the scenes."""
        self._written_s = time.monotonic()
        now = summary(self.rows, self._engine, self._started, time.monotonic() - self._start)
        try:
            write_json(self._out / JSON_FILE, now)
            whole = self._out / f".{HTML_FILE}.tmp"
            whole.write_text(page(now, self._out.resolve()), encoding="utf-8")
            whole.replace(self._out / HTML_FILE)
            self.written = True
        except OSError as error:
            if self.written:
                self._talk.error(
                    f"{self._out}: the summary cannot be written ({error.strerror}); make room there"
                )
            self.written = False

    def _table(self) -> Group:
        """What runs now, and how many stand where."""
        table = Table(box=None)
        for column in ("scene", "state", "stages made", "node"):
            table.add_column(column, overflow="ellipsis", no_wrap=True)
        for row in self.rows:
            if row.state == "running":
                table.add_row(escape(row.name), row.state, ", ".join(row.made), ", ".join(row.nodes[-1:]))
        states = [row.state for row in self.rows]
        counts = Text(", ").join(
            Text(f"{states.count(state)} {state}", COLOUR.get(state, "red"))
            for state in dict.fromkeys(states)
        )
        return Group(table, counts, Text(duration(time.monotonic() - self._start), "dim"))
