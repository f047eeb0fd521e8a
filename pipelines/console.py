"""What a run says: a bar with the time left on a terminal, plain lines elsewhere, everything in devrf.log."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as TimeLeftColumn

from devrf.capture.progress import Progress as ProgressCallback
from devrf.pipelines.health.rows import HealthRow

Loudness = Literal["quiet", "normal", "verbose"]

PLAIN_EVERY_S = 15.0  # between two progress lines where there is no terminal
LOG_FILE = "devrf.log"
LOG_BYTES = 5_000_000  # a longer log is begun anew
COLOUR = {"ok": "green", "warn": "yellow", "fail": "red"}

logger = logging.getLogger("devrf")


class Talk:
    """All that a run prints. Errors go to stderr, whatever the loudness."""

    def __init__(self, loudness: Loudness = "normal") -> None:
        self.loudness: Loudness = loudness
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())  # or Python prints what is logged a second time
        self.out = Console(file=sys.stdout, highlight=False, soft_wrap=True)
        self.err = Console(file=sys.stderr, highlight=False, soft_wrap=True)

    def say(self, text: str, *, style: str = "") -> None:
        """One line for people; not printed when quiet."""
        logger.info("%s", text)
        if self.loudness != "quiet":
            self.out.print(escape(text), style=style)

    def detail(self, text: str) -> None:
        """One line for the curious; printed when verbose."""
        logger.debug("%s", text)
        if self.loudness == "verbose":
            self.out.print(escape(text), style="dim")

    def error(self, text: str) -> None:
        """What went wrong."""
        logger.error("%s", text)
        self.err.print(escape(text), style="red")

    def health(self, rows: list[HealthRow]) -> None:
        """Rows that are not ok (all of them when verbose)."""
        for row in rows:
            if row.verdict == "ok" and self.loudness != "verbose":
                logger.info("%s", describe(row))
                continue
            line = f"  {row.verdict}: {describe(row)}"
            (logger.warning if row.verdict != "ok" else logger.info)("%s", line)
            if self.loudness != "quiet" or row.verdict == "fail":
                self.out.print(escape(line), style=COLOUR[row.verdict])

    @contextmanager
    def progress(self, title: str) -> Iterator[ProgressCallback]:
        """A callback that shows how far a stage is."""
        if self.loudness == "quiet":
            yield lambda fraction, message: None
        elif self.out.is_terminal:
            with Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeLeftColumn(),
                TextColumn("{task.fields[message]}"),
                console=self.out,
                transient=True,
            ) as bars:
                task = bars.add_task(title, total=1.0, message="")
                yield lambda fraction, message: bars.update(task, completed=fraction, message=message)
        else:
            yield self._plain(title)

    def _plain(self, title: str) -> ProgressCallback:
        start = last = time.monotonic()

        def line(fraction: float, message: str) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last < PLAIN_EVERY_S or fraction <= 0:
                return
            last = now
            left = (now - start) * (1 - fraction) / fraction
            self.out.print(escape(f"  {title} {100 * fraction:.0f} %, {duration(left)} left: {message}"))

        return line


def describe(row: HealthRow) -> str:
    """A row in one line."""
    if row.value is None:
        value = "not measured"
    elif isinstance(row.value, str):
        value = row.value
    else:
        value = f"{row.value:.4g} {row.unit}".rstrip()
    bound = row.fail if row.verdict == "fail" else row.warn
    expectation = f" (bound {bound:.4g} {row.unit}".rstrip() + ")" if bound is not None else ""
    return f"{row.check}: {value}{expectation if row.verdict != 'ok' else ''}" + (
        f"; {row.remedy}" if row.remedy else ""
    )


def duration(seconds: float) -> str:
    """Seconds for people: 8 s, 3 min 20 s, 1 h 5 min."""
    whole = int(round(seconds))
    if whole < 10:
        return f"{seconds:.1f} s"
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


@contextmanager
def log_file(run_dir: Path) -> Iterator[None]:
    """Write everything that is logged to devrf.log in the run folder, where it can be written."""
    path = run_dir / LOG_FILE
    try:
        too_long = path.exists() and path.stat().st_size > LOG_BYTES
        handler: logging.Handler = logging.FileHandler(path, mode="w" if too_long else "a", encoding="utf-8")
    except OSError:
        handler = logging.NullHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.handleError = lambda record: None  # a full disk must not hide the error that says so
    level, propagate = logger.level, logger.propagate
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    logger.addHandler(handler)
    warnings_logger = logging.getLogger("py.warnings")
    warnings_logger.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        warnings_logger.removeHandler(handler)
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate
        handler.close()
