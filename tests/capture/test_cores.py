"""How many cores a process is meant to use."""

import os

import pytest

from devrf.capture.system.cores import usable_cores


@pytest.mark.parametrize(
    ("said", "expected"), [("1", 1), ("1,4", 1), ("100000", None), ("0", None), ("", None), ("all", None)]
)
def test_the_wish_counts_where_it_is_less_than_there_is(
    said: str, expected: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    assert usable_cores() == (expected or len(os.sched_getaffinity(0)))
