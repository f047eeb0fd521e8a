"""The pages that the program writes about itself are those in docs/, and hold every key and every option."""

import re
from pathlib import Path
from typing import Any

import pytest
import typer

from devrf.pipelines.cli import app
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.manual import commands, configuration
from devrf.pipelines.manual.command_line import commands_of
from devrf.pipelines.stages import STAGES

DOCS = Path(__file__).parents[2] / "docs"
COMMANDS = commands_of(app)


@pytest.mark.parametrize(
    ("name", "page"), [("configuration.md", configuration.page), ("commands.md", commands.page)]
)
def test_the_page_is_current(name: str, page) -> None:
    same = (DOCS / name).read_text(encoding="utf-8") == page()
    assert same, f"docs/{name} is not what the code says: python -m devrf.pipelines.manual writes it again"


def rows() -> dict[str, list[str]]:
    """Key -> its cells on the page."""
    lines = (line.split(" | ") for line in configuration.page().splitlines() if line.startswith("| `"))
    return {cells[0].strip("| `"): [cell.strip(" |") for cell in cells] for cells in lines}


def leaves(schema: dict, definitions: dict, prefix: str = "") -> set[str]:
    """Dotted keys of a JSON schema, another way to them than the page's."""
    found = set()
    for name, field in schema["properties"].items():
        kinds = [field, *field.get("anyOf", []), *field.get("allOf", [])]
        below = [definitions[kind["$ref"].split("/")[-1]] for kind in kinds if "$ref" in kind]
        found |= {f"{prefix}{name}"} | (leaves(below[0], definitions, f"{prefix}{name}.") if below else set())
    return found


def test_every_key_has_a_row_with_its_meaning() -> None:
    schema = SceneConfig.model_json_schema()
    assert set(rows()) == leaves(schema, schema["$defs"])
    assert all(len(cells) == 5 and len(cells[3]) > 5 for cells in rows().values()), rows()


@pytest.mark.parametrize(
    ("key", "cell", "text"),
    [
        ("name", 2, "(needed)"),
        ("capture.board.square_m", 1, "a number above 0 up to 10, metres"),
        ("capture.rest", 1, "start, end, none"),
        ("capture.static", 1, "a path"),
        ("evaluate.holdout_every", 2, "`8`"),
        ("reconstruct.resolution", 2, "`112` · `160` · `160`"),
        ("capture.mattes.folder", 4, "scene"),
        ("evaluate.truth", 4, "evaluate"),
        ("budget.memory_gb", 4, "–"),
    ],
)
def test_what_a_row_says(key: str, cell: int, text: str) -> None:
    assert rows()[key][cell] == text


def test_stages_of_keys_are_those_of_the_stages() -> None:
    said = {key: set(cells[4].split(", ")) for key, cells in rows().items()}
    for stage in STAGES:
        assert all(stage.name in said[key] for key in stage.config_keys), stage.name


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_help(name: str) -> None:
    command: Any = typer.main.get_command(app)
    for word in name.split():
        command = command.commands[word]
    listed = re.findall(r"^  (--[a-z-]+)", command.get_help(typer.Context(command)), flags=re.MULTILINE)
    assert set(listed) == COMMANDS[name].options
