"""Hostile input through the entry points that users have, and what counts as a fault.

A fault is: a traceback, words that blame the program, an exit code that the contract does not have for this, an error
that says nothing, more than 30 s of work, more memory than any real input of this size could need, death by a signal.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIMIT_S = 30.0  # of processor time, where the machine is shared
LONGEST_S = 90.0  # by the clock: what only waits is found too
MOST_MB = 2500.0  # of the process, 600 of them for the libraries
BLAMES = ("Traceback (most recent call last)", "[unexpected]", "Exception ignored in")


@dataclass(frozen=True)
class Outcome:
    """How a case ended: exit code (below 0: a signal, None: over the limit), what was said, seconds by the clock and of
    processors, peak of memory."""

    code: int | None
    said: str
    seconds: float
    worked_s: float
    peak_mb: float

    def fault(self, allowed: Sequence[int]) -> str | None:
        """What is wrong with it, or None."""
        if self.code is None or self.worked_s > LIMIT_S:
            return f"hangs: {self.worked_s:.0f} s of work, {self.seconds:.0f} s by the clock"
        if self.code < 0:
            return f"killed by signal {-self.code}"
        blame = next((word for word in BLAMES if word in self.said), None)
        if blame is not None:
            return f"says {blame!r}"
        if self.code not in allowed:
            return f"exit code {self.code}, expected one of {list(allowed)}"
        if self.code != 0 and not self.said.strip():
            return f"exit code {self.code} without a word"
        if self.peak_mb > MOST_MB:
            return f"takes {self.peak_mb:.0f} MB"
        return None


class Fuzzer:
    """Cases, one at a time."""

    def __init__(self, server: "subprocess.Popen[str]", folder: Path) -> None:
        self._server, self._said = server, folder / "said.txt"
        self.slowest_s = self.most_worked_s = self.most_mb = 0.0

    def command(self, *arguments: str | Path) -> Outcome:
        """`devrf-pipeline` with these arguments."""
        return self._ask(arguments=[str(a) for a in arguments])

    def read(self, reader: str, path: Path) -> Outcome:
        """One of `fuzz_readers.READERS`; an error of ours is exit code 1, as in a stage."""
        return self._ask(reader=reader, path=str(path))

    def _ask(self, **job: Any) -> Outcome:
        assert self._server.stdin is not None and self._server.stdout is not None
        self._server.stdin.write(json.dumps({**job, "said": str(self._said), "limit_s": LONGEST_S}) + "\n")
        self._server.stdin.flush()
        answer = json.loads(self._server.stdout.readline())
        outcome = Outcome(said=self._said.read_text(errors="replace"), **answer)
        self.slowest_s = max(self.slowest_s, outcome.seconds)
        self.most_worked_s = max(self.most_worked_s, outcome.worked_s)
        self.most_mb = max(self.most_mb, outcome.peak_mb)
        return outcome


@contextmanager
def fuzzer() -> Iterator[Fuzzer]:
    """Start the server, and end it."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.faults.fuzz_server"]
        root = Path(__file__).resolve().parents[2]
        server = subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            yield Fuzzer(server, Path(folder))
        finally:
            assert server.stdin is not None
            server.stdin.close()
            server.wait(LONGEST_S)
