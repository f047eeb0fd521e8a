"""What a run says: a bar with the time left on a terminal, plain lines elsewhere, everything in the logs."""

import logging
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

from devrf.capture.system.progress import Progress as ProgressCallback
from devrf.pipelines.health.judge import HealthRow
from devrf.pipelines.terminal.logs import Events
from devrf.pipelines.terminal.printable import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

Loudness = Literal["quiet", "normal", "verbose"]

PLAIN_EVERY_S = 15.0  # between two progress lines where there is no terminal
EVENT_EVERY_S = 5.0  # between two events of progress
COLOUR = {"ok": "green", "warn": "yellow", "fail": "red"}

logger = logging.getLogger("devrf")


class Talk:
    """All that a run prints. Errors go to stderr, whatever the loudness.

    Attributes:
        loudness: quiet: only errors; verbose: every health row, and why nothing runs.
        events: Where programs read it; None outside a run.
    """

    def __init__(self, loudness: Loudness = "normal") -> None:
        self.loudness: Loudness = loudness
        self.events: Events | None = None
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())  # or Python prints what is logged a second time

    def prepare(self) -> None:
        """Load what it takes to speak: later there may be no memory for it."""
        _ = self.out, self.err

    @cached_property
    def out(self) -> "Console":
        """Where it speaks."""
        return console_on(sys.stdout, soft_wrap=True)

    @cached_property
    def err(self) -> "Console":
        """Where it says what went wrong."""
        return console_on(sys.stderr, soft_wrap=True)

    def say(self, text: str, *, style: str = "") -> None:
        """One line for people; not printed when quiet."""
        logger.info("%s", text)
        if self.loudness != "quiet":
            self.out.print(text, markup=False, style=style)

    def detail(self, text: str) -> None:
        """One line for the curious; printed when verbose."""
        logger.debug("%s", text)
        if self.loudness == "verbose":
            self.out.print(text, markup=False, style="dim")

    def event(self, event: str, **fields: Any) -> None:
        """One event for programs."""
        if self.events is not None:
            self.events.write(event, **fields)

    def error(self, text: str, code: str) -> None:
        """What went wrong, and which error it is (docs/conventions.md)."""
        logger.error("%s", text)
        self.event("error", message=text, code=code)
        self.err.print(f"{text} [{code}]", markup=False, style="red")

    def health(self, stage: str, rows: list[HealthRow]) -> None:
        """A stage's rows that are not ok (all of them when verbose)."""
        for row in rows:
            self.event("health", stage=stage, **row.as_dict())
            if row.verdict == "ok" and self.loudness != "verbose":
                logger.info("%s", describe(row))
                continue
            line = f"  {row.verdict}: {describe(row)}"
            (logger.warning if row.verdict != "ok" else logger.info)("%s", line)
            if self.loudness != "quiet" or row.verdict == "fail":
                self.out.print(line, markup=False, style=COLOUR[row.verdict])

    @contextmanager
    def progress(self, title: str) -> Iterator[ProgressCallback]:
        """A callback that shows how far a stage is; no fraction can be what breaks a stage."""
        with self._shown(title) as show:
            last = time.monotonic()

            def told(fraction: float, message: str) -> None:
                nonlocal last
                fraction = min(max(float(fraction), 0.0), 1.0) if math.isfinite(fraction) else 0.0
                if (now := time.monotonic()) - last >= EVENT_EVERY_S:
                    last = now
                    self.event("progress", stage=title, fraction=round(fraction, 4), text=message)
                show(fraction, message)

            yield told

    @contextmanager
    def _shown(self, title: str) -> Iterator[ProgressCallback]:
        if self.loudness == "quiet":
            yield lambda fraction, message: None
        elif self.out.is_terminal:
            from rich import progress

            with progress.Progress(
                progress.TextColumn("{task.description}", markup=False),
                progress.BarColumn(),
                progress.TaskProgressColumn(),
                progress.TimeElapsedColumn(),
                progress.TextColumn("left"),
                progress.TimeRemainingColumn(),
                progress.TextColumn("{task.fields[message]}", markup=False),
                console=self.out,
                transient=True,
            ) as bars:
                task = bars.add_task(title, total=1.0, message="")
                yield lambda fraction, message: bars.update(
                    task, completed=fraction, message=printable(message)
                )
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
            text = f"  {title} {100 * fraction:.0f} %, {duration(left)} left: {message}"
            logger.debug("%s", text)
            self.out.print(text, markup=False)

        return line


def console_on(file: Any, **options: Any) -> "Console":
    """A console on an open text file, on which no text from files or names steers the terminal."""
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **options: Any) -> "Text":
            return super().render_str(printable(text), **options)

    return Plain(file=file, highlight=False, **options)


def describe(row: HealthRow) -> str:
    """A row in one line."""

    def amount(value: float | int | str) -> str:
        return value if isinstance(value, str) else f"{value:.4g} {row.unit}".rstrip()

    bound = {"ok": None, "warn": row.warn, "fail": row.fail}[row.verdict]
    expectation = "" if bound is None else f" (bound {amount(bound)})"
    text = f"{row.title}: {'not measured' if row.value is None else amount(row.value)}{expectation}"
    return f"{text}; {row.remedy}" if row.remedy else text


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
