"""The table of neighbours names tests that are there, and enough of each kind."""

import ast
import re
from functools import cache

import pytest
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "tests" / "neighbours.md").read_text(encoding="utf-8")
ROW = re.compile(
    r"^\| (?P<input>[^|]+) \| (?P<right>[^|]+) \| `(?P<file>[^`]+\.py)::(?P<test>\w+)` \|$", re.M
)
KINDS = dict(re.findall(r"^## (.+?)\n(.+?)(?=^## |\Z)", PAGE, re.M | re.S))


@cache
def names_in(file: str) -> set[str]:
    """Names of the tests in a file."""
    tree = ast.parse((REPOSITORY / file).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_has_neighbours_with_tests_that_are_there(kind: str) -> None:
    rows = ROW.findall(KINDS[kind])
    assert len(rows) == KINDS[kind].count("\n| ") - 1 >= 3  # but for the head
    assert [f"{file}::{test}" for _, _, file, test in rows if test not in names_in(file)] == []


def test_there_are_eight_kinds() -> None:
    assert len(KINDS) == 8
