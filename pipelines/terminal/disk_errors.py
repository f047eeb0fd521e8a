"""What the system refuses to read or write, told as an error with its remedy."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from devrf.capture.system.errors import DevrfError


@contextmanager
def disk_told(place: object, remedy: str, kind: type[DevrfError] = DevrfError) -> Iterator[None]:
    """An `OSError` of this block becomes one of ours: the place, what the system says, and what to do."""
    try:
        yield
    except OSError as error:
        text = f"{place}: cannot be written ({error.strerror or error}); {remedy}"
        raise kind("folder-unwritable", text) from None


def refused_by_system(error: BaseException, place: object) -> DevrfError | None:
    """What is said of an error that is the system's, or comes from one, wherever it happens; None for others.

    A disk that was pulled out or has turned read-only, a file larger than it may be, a folder that was moved.

    Args:
        error: What was raised.
        place: Where it is likely to have been, if it does not say so.
    """
    cause: BaseException | None = error
    while cause is not None and not (isinstance(cause, OSError) and cause.errno is not None):
        cause = cause.__cause__
    if cause is None:
        return None
    name = place if cause.filename is None else os.fsdecode(cause.filename)
    wrong = f"{name}: the system cannot read or write it ({cause.strerror})"
    remedy = "see whether its disk is there, may be written and takes files so large, then do this again"
    return DevrfError("system-refused", f"{wrong}; {remedy}")
