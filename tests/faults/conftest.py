"""Fixtures of the fault suite."""

from pathlib import Path

import pytest
from tests.faults.harness import Tiny
from tests.faults.tiny_stages import prepare


@pytest.fixture
def tiny(tmp_path: Path) -> Tiny:
    """A folder of its own for the tiny pipeline."""
    prepare(tmp_path)
    return Tiny(tmp_path)
