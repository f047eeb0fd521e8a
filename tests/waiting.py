"""Waiting for what another process or thread does."""

import subprocess
import time
from collections.abc import Callable

POLL_S = 0.01


def wait_for(
    what: Callable[[], object], limit_s: float = 90.0, process: "subprocess.Popen | None" = None
) -> None:
    """Return once `what()` is true.

    Args:
        what: Asked now and then.
        limit_s: After this time the test fails.
        process: The one that is to bring it about: if it ends before, the test fails, with what it said.
    """
    deadline = time.monotonic() + limit_s
    while not what():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, f"not within {limit_s:g} s"
        time.sleep(POLL_S)
