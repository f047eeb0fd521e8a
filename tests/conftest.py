"""Fixtures that many tests share."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real captures: `DEVRF_DATA`, or ../shared/data beside the repository.

    Tests that need it skip where it is absent, but fail under CI, so that a missing mount is noticed.
    """
    folder = Path(os.environ.get("DEVRF_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        if os.environ.get("CI") == "true":
            pytest.fail(f"real captures not found at {folder}; set DEVRF_DATA")
        pytest.skip(f"real captures not found at {folder}; set DEVRF_DATA")
    return folder
