"""What a test expects of an error: its code, and the names and numbers in its text."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from devrf.capture.system.errors import DevrfError


@contextmanager
def refused(
    code: str, *named: object, kind: type[DevrfError] = DevrfError
) -> Iterator[pytest.ExceptionInfo[DevrfError]]:
    """Expect an error.

    Args:
        code: Of the error.
        named: What its text names: files, values, keys, remedies that are commands.
        kind: Its class.
    """
    with pytest.raises(kind) as caught:
        yield caught
    assert caught.value.code == code, f"{caught.value.code}: {caught.value}"
    for thing in named:
        assert str(thing) in str(caught.value)
