"""The faults of `benchmarks/seeded_faults.py` can still be made: a file or a line that went leaves one fault less."""

import json

import pytest
from tests.conftest import REPOSITORY

FAULTS = json.loads((REPOSITORY / "benchmarks/seeded_faults.json").read_text())


def test_there_are_forty() -> None:
    assert len(FAULTS) == 40


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault['path']} {fault['kind']}")
def test_a_fault_can_be_made(fault: dict[str, str]) -> None:
    text = (REPOSITORY / fault["path"]).read_text()
    assert text.count(fault["right"]) == 1 and fault["wrong"] != fault["right"]
