"""A place that cannot be written, told as an error with its remedy."""

from collections.abc import Iterator
from contextlib import contextmanager

from devrf.capture.errors import DevrfError


@contextmanager
def disk_told(place: object, remedy: str, kind: type[DevrfError] = DevrfError) -> Iterator[None]:
    """An `OSError` of this block becomes one of ours: the place, what the system says, and what to do."""
    try:
        yield
    except OSError as error:
        text = f"{place}: cannot be written ({error.strerror or error}); {remedy}"
        raise kind("folder-unwritable", text) from None
