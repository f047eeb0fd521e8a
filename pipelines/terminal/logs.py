"""What a run leaves to be read: devrf.log for people, events.jsonl for programs (docs/formats.md).

Each run begins a devrf.log of its own; the last ones of earlier runs lie in `logs/`, under their run's name. Events
of all runs are in one file, a line each, every line whole: it is written by one call, and what a kill or a full disk
tore is cut off before the next line.
"""

import json
import logging
import math
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from devrf.pipelines.terminal.printable import printable

LOG_FILE = "devrf.log"  # also what a run folder is known by
EVENTS_FILE = "events.jsonl"
OLD_LOGS = "logs"  # folder of earlier runs' logs
KEPT_LOGS = 30  # a night's tries and more; a log is some 10 kB
EVENTS_BYTES = 20_000_000  # a longer file of events goes to the old logs: some 100 000 events

logger = logging.getLogger("devrf")


class Events:
    """Appends events to the run folder's events.jsonl; what cannot be written is not worth an error.

    Args:
        run_dir: The run folder.
        run: Name of the run, which stands in every event.
    """

    def __init__(self, run_dir: Path, run: str) -> None:
        self.run = run
        self._path = run_dir / EVENTS_FILE

    def write(self, event: str, **fields: Any) -> None:
        """One event: when, which run, what, and its own fields."""
        now = time.time()
        when = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        line = json.dumps(_finite({"time": when, "run": self.run, "event": event, **fields})) + "\n"
        try:
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
            try:
                _cut_torn_line(handle)
                os.write(handle, line.encode())
            finally:
                os.close(handle)
        except OSError:
            pass


def last_scene(run_dir: Path) -> str | None:
    """The scene that a run folder was begun for most lately; None where nothing says so."""
    try:
        lines = (run_dir / EVENTS_FILE).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for line in reversed(lines):
        if '"run_started"' in line:
            try:
                return str(json.loads(line)["scene"])
            except (ValueError, KeyError, TypeError):  # torn
                continue
    return None


def new_run_name() -> str:
    """Name of a run, in the order of time: 20261122-231500-1f3a."""
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"


@contextmanager
def log_file(run_dir: Path, run: str | None = None) -> Iterator[None]:
    """Write everything that is logged to devrf.log, where it can be written.

    Args:
        run_dir: The run folder.
        run: Name of a run that begins, which gets a log of its own; None goes on with the last one's.
    """
    path = run_dir / LOG_FILE
    try:
        if run is not None:
            _put_away(run_dir)
        handler: logging.Handler = logging.FileHandler(path, encoding="utf-8")
    except OSError:
        handler = logging.NullHandler()
    handler.setFormatter(_Printable("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.handleError = lambda record: None  # a full disk must not hide the error that says so
    level, propagate = logger.level, logger.propagate
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    logger.addHandler(handler)
    warnings_logger = logging.getLogger("py.warnings")
    warnings_logger.addHandler(handler)
    logging.captureWarnings(True)
    if run is not None:
        logger.info("run %s", run)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        warnings_logger.removeHandler(handler)
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate
        handler.close()


class _Printable(logging.Formatter):
    """Logs are read in terminals."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def _put_away(run_dir: Path) -> None:
    """Move the last run's log to the old ones, under that run's name, and drop the oldest."""
    path, old = run_dir / LOG_FILE, run_dir / OLD_LOGS
    if path.exists():
        old.mkdir(exist_ok=True)
        with path.open(encoding="utf-8", errors="replace") as file:
            first = file.readline().split()
        made = time.strftime("%Y%m%d-%H%M%S", time.localtime(path.stat().st_mtime))
        name = first[-1] if first[-2:-1] == ["run"] else made
        path.replace(old / f"{name}.log")
    events = run_dir / EVENTS_FILE
    if events.exists() and events.stat().st_size > EVENTS_BYTES:
        old.mkdir(exist_ok=True)
        events.replace(old / f"events-until-{time.strftime('%Y%m%d-%H%M%S')}.jsonl")
    logs = sorted(old.glob("[0-9]*.log"), key=lambda log: log.stat().st_mtime)
    for log in logs[:-KEPT_LOGS]:
        log.unlink(missing_ok=True)


def _cut_torn_line(handle: int) -> None:
    """Cut off what follows the last line break: a line that was not written to its end."""
    size = os.fstat(handle).st_size
    if size == 0 or os.pread(handle, 1, size - 1) == b"\n":
        return
    tail_from = max(0, size - (1 << 20))
    tail = os.pread(handle, size - tail_from, tail_from)
    os.ftruncate(handle, tail_from + tail.rfind(b"\n") + 1)


def _finite(value: Any) -> Any:
    """JSON knows no infinity: null stands for what could not be computed."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
