"""Signals: handlers for some work, and those that end a run as one error wherever they come."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

AGAIN_S = 0.01  # after which a signal that was lost is raised again


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *signs: signal.Signals) -> Iterator[None]:
    """Have signals handled so in this block; in the main thread only."""
    before = {sign: signal.signal(sign, handler) for sign in signs}
    try:
        yield
    finally:
        for sign, usual in before.items():
            signal.signal(sign, usual)


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
    try:
        with handled(stop, signal.SIGTERM, signal.SIGALRM):
            try:
                yield
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        sys.unraisablehook = hook
