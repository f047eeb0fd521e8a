"""Signals that end a run, as one error wherever they come."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

AGAIN_S = 0.01  # after which a signal that was lost is raised again


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does, wherever either comes; without effect but in the main thread."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def again(unraisable: Any) -> None:
        """Where nothing can be raised (a callback of the garbage collector) Python would only print it."""
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            return hook(unraisable)
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook, sys.unraisablehook = sys.unraisablehook, again
    previous = {sign: signal.signal(sign, stop) for sign in (signal.SIGTERM, signal.SIGALRM)}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for sign, handler in previous.items():
            signal.signal(sign, handler)
        sys.unraisablehook = hook
