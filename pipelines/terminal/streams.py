"""Standard input, output and errors: what cannot be said does not end the work."""

import io
import os
import sys

from devrf.pipelines.terminal.console import Talk

_lost = False  # whether something could not be said that somebody wanted to read


def open_streams() -> None:
    """Where a stream is closed (`>&-`, some service managers), let it lead nowhere; let the others outlive their end.

    Else the next file that is opened would take a closed one's place, and a full disk under a log would end the run.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            _lead_nowhere(number)
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode))
        elif number and isinstance(stream, io.TextIOWrapper) and stream.fileno() == number:
            setattr(sys, name, _Lasting(stream))


def all_was_said() -> bool:
    """Whether all that was printed has arrived, or nobody was left to read it."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    return not _lost


class _Lasting(io.TextIOWrapper):
    """A stream that leads nowhere from when it cannot be written: the reader has left, the disk below it is full."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        stream.flush()
        self._before = stream  # it would close what both write to when nobody holds it
        super().__init__(
            open(stream.fileno(), "wb", closefd=False),  # noqa: SIM115 (for the whole process)
            encoding=stream.encoding,
            errors=stream.errors,
            line_buffering=stream.line_buffering,
        )

    def write(self, text: str, /) -> int:
        """Write, or let it go."""
        try:
            return super().write(text)
        except OSError as error:
            self._end(error)
            return len(text)

    def flush(self) -> None:
        """Flush, or let it go."""
        try:
            super().flush()
        except OSError as error:
            self._end(error)

    def _end(self, error: OSError) -> None:
        _lead_nowhere(self.fileno())
        super().flush()  # what it held back
        if self.fileno() == 1 and not isinstance(error, BrokenPipeError):
            global _lost
            _lost = True
            text = f"standard output: cannot be written ({error.strerror}); the work goes on, what it says is lost"
            talk = Talk()
            talk.error(f"{text}: make room there, or send it elsewhere", "output-lost")


def _lead_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
