"""What messages and health rows propose can be done: keys, their values, options and commands are there."""

import json
import re
import shlex
from collections.abc import Iterator

import pytest
from tests.docs.test_pages import COMMANDS, OF_OTHERS, ROWS
from tests.test_messages import KEPT

from devrf.pipelines.health.judge import entries

SECTIONS = "capture|dataset|calibration|flow|reconstruct|budget|evaluate"
KEY = re.compile(rf"\b(?:{SECTIONS})(?:\.[a-z_]+)+")
# "set KEY to a, b or c." or "KEY: a,"
VALUES = re.compile(
    rf"((?:{SECTIONS})(?:\.[a-z_]+)+)(?: to|:) ((?:[a-z0-9]+, )*[a-z0-9]+(?: or [a-z0-9]+)?)(?=[.;,)]|$)"
)
FILES = (".json", ".py", ".yaml", ".npz", ".toml")


def texts() -> Iterator[str]:
    """All that the program says where something is wrong."""
    for said in json.loads(KEPT.read_text("utf-8")).values():
        yield from said
    for entry in entries().values():
        yield from [entry.remedy] if isinstance(entry.remedy, str) else entry.remedy.values()


SAID = sorted(set(texts()))


def test_keys_exist() -> None:
    named = {key for text in SAID for key in KEY.findall(text) if not key.endswith(FILES)}
    known = {
        key
        for key in named
        if any(f"{row}.".startswith(f"{key}.") or key.startswith(f"{row}.") for row in ROWS)
    }
    assert named - known == set() and len(named) > 25


def test_values_are_allowed() -> None:
    tried = 0
    for text in SAID:
        for key, values in VALUES.findall(text):
            allowed = ROWS[key][0].replace("`", "")
            for value in re.split(", | or ", values):
                if re.fullmatch(r"[a-z, 0-9]+", allowed) and "," in allowed:
                    assert value in allowed.split(", "), f"{value} is no value of {key}: {text}"
                    tried += 1
    assert tried >= 6


def test_options_and_commands_exist() -> None:
    options = (
        {"--version", "--num-cpus", "--address", "--head", "--port", "--memory"}
        | OF_OTHERS
        | set().union(*COMMANDS.values())
    )
    assert {o for text in SAID for o in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)} <= options
    for text in SAID:
        for call in re.findall(r"`(devrf-pipeline [^`]+)`", text):
            name, *words = shlex.split(call)[1:]
            assert name in COMMANDS, text
            assert {w for w in words if w.startswith("--")} <= COMMANDS[name], text


@pytest.mark.parametrize("code", sorted(entries()))
def test_a_row_that_can_refuse_says_what_to_do(code: str) -> None:
    entry = entries()[code]
    fails = (entry.high or entry.low or (None, None))[1] is not None
    said = [entry.remedy] if isinstance(entry.remedy, str) else list(entry.remedy.values())
    assert not fails or all(len(text.split()) > 4 for text in said)
