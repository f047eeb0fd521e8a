"""What the pages promise is there: links, commands, options and their values, keys, files, targets of make."""

import ast
import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.docs.pages import PAGES, REPOSITORY, Block, Call, anchors, blocks, calls, links, prose

from devrf.pipelines.cli import app
from devrf.pipelines.config.files import input_paths
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.words import field_at
from devrf.pipelines.manual.command_line import commands_of
from devrf.pipelines.simulate_command import PROTOCOLS
from devrf.pipelines.stages import stage_names
from devrf.reconstruct.options import PRESETS

COMMANDS = commands_of(app)
FIRST_WORDS = {name.split()[0] for name in COMMANDS}
OF_OTHERS = {"--find-links"}  # options of pip
CAPTURE: dict[str, Any] = {  # what a block of some keys is put into
    "name": "kuka",
    "capture": {
        "static": "static.mp4",
        "cameras": {"cam0": "cam0.mp4", "cam1": "cam1.mp4"},
        "test_cameras": {"witness": "w.mp4"},
    },
}


each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name + "/" + page.name)


def calls_on(page: Path) -> list[Call]:
    return list(calls(page, FIRST_WORDS | {"COMMAND"}))


# --- links ---


@each_page
def test_links_lead_somewhere_on_github(page: Path) -> None:
    for link in links(page):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}: there is no {path}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}: no such heading"


def test_anchors_are_those_of_github(tmp_path: Path) -> None:
    """So that the test above can fail."""
    page = tmp_path / "page.md"
    page.write_text(
        "# scene.yaml: `a` – b\n## One\n## One\n```sh\n# no heading\n```\n### [R³](x.md) voxels_2\n[x](#two)\n"
    )
    assert anchors(page) == {"sceneyaml-a--b", "one", "one-1", "r³-voxels_2"}
    assert links(page) == ["x.md", "#two"]


# --- calls ---


def alternatives(call: Call) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Command (of several with | between, each) and the words behind it."""
    words = call.words
    if words[0] != "bench":
        yield words[0], words[1:]
        return
    for n, word in enumerate(words[1:], 1):
        if n == 1 or words[n - 1] == "|":
            yield f"bench {word}", tuple(w for w in words[n + 1 :] if w != "|")


@each_page
def test_commands_and_options_exist(page: Path) -> None:
    for call in calls_on(page):
        for name, words in alternatives(call):
            assert name in COMMANDS or name == "COMMAND", f"{call}: there is no command {name}"
            options = COMMANDS[name].options if name in COMMANDS else {"--help"}
            said = {word.strip("[]") for word in words if word.strip("[").startswith("--")}
            assert said <= options, f"{call}: {said - options}"


@each_page
def test_values_of_options_are_known(page: Path, tmp_path: Path) -> None:
    for call in calls_on(page):
        check_values(call, tmp_path)


def check_values(call: Call, tmp_path: Path) -> None:
    known = {"--preset": {*PRESETS}, "--from": {*stage_names()}, "--until": {*stage_names()}}
    settings = []
    for option, value in zip(call.words, call.words[1:], strict=False):
        if option in known and not value.isupper() and not value.startswith("--"):
            assert value in known[option], f"{call}: {option} {value}"
        if option in ("--set", "--set-for"):
            settings.append(value.split(":")[-1])
    if call.words[0] == "simulate":
        protocol = dict(zip(call.words, call.words[1:], strict=False)).get("--protocol", "session")
        assert {setting.split("=")[0] for setting in settings} <= {*PROTOCOLS[protocol].options.model_fields}
    elif settings:
        dataset = any(setting.startswith("dataset.") for setting in settings)
        scene = {"name": "x", "dataset": {"format": "devrf", "path": "set"}} if dataset else CAPTURE
        (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
        load_scene(tmp_path / "scene.yaml", settings, check_files=False)


def test_calls_are_found() -> None:
    """So that the tests above see them: on lines, within sentences, over two lines, and without the program's name."""
    words = [" ".join(call.words) for call in calls_on(REPOSITORY / "docs" / "reference.md")]
    assert any(line.startswith("bench speed SCENE --preset fast") and "--set-for" in line for line in words)
    words = [" ".join(call.words) for call in calls_on(REPOSITORY / "docs" / "results.md")]
    assert "bench calibration --only colour" in words
    assert sum(len(calls_on(page)) for page in PAGES) > 80


@each_page
def test_options_and_keys_in_sentences_exist(page: Path) -> None:
    options = (
        {option for command in COMMANDS.values() for option in command.options} | {"--version"} | OF_OTHERS
    )
    for code in re.findall(r"`([^`\n]+)`", prose(page)):
        if re.match(r"--[a-z]", code):
            assert code.split()[0] in options, f"{page.name}: {code}"
        key = re.fullmatch(
            r"(?:capture|dataset|calibration|flow|reconstruct|budget|cache|evaluate)\.[a-z_.]+", code
        )
        if key and not code.endswith((".py", ".json", ".toml", ".mp4")):
            told_as_gone = page.name == "CHANGELOG.md" and code in GONE
            assert told_as_gone or field_at(tuple(code.split("."))), (
                f"{page.name}: {code} is no key of scene.yaml"
            )


# --- blocks ---


def merged(base: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    both = {**base, **more}
    for key in base.keys() & more.keys():
        if isinstance(base[key], dict) and isinstance(more[key], dict):
            both[key] = merged(base[key], more[key])
    return both


@each_page
def test_configurations_are_taken_by_the_loader(page: Path, tmp_path: Path) -> None:
    for block in blocks(page):
        if block.language != "yaml":
            continue
        said = yaml.safe_load(block.text)
        whole = said if "name" in said else merged(CAPTURE, said)
        path = tmp_path / "scene.yaml"
        path.write_text(yaml.safe_dump(whole))
        config = load_scene(path, check_files=False)
        for file in input_paths(config).values():
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).touch()
        load_scene(path)


@each_page
def test_what_else_is_called_exists(page: Path) -> None:
    for block in blocks(page):
        if block.language == "sh":
            check_lines(block)


def check_lines(block: Block) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), flags=re.MULTILINE))
    extras = re.findall(r"^([a-z]+) = \[", (REPOSITORY / "pyproject.toml").read_text(), flags=re.MULTILINE)
    for line in block.text.splitlines():
        words = line.split("#")[0].split()
        if words[:1] == ["make"]:
            assert words[1] in targets, line
        for word in words:
            if word.startswith(("tests/", "benchmarks/", "examples/")):
                assert (REPOSITORY / word).exists(), line
            if word.startswith(("benchmarks.", "devrf.")):
                path = REPOSITORY / word.removeprefix("devrf.").replace(".", "/")
                assert path.with_suffix(".py").is_file() or path.is_dir(), line
            if extra := re.fullmatch(r"'?\.\[([a-z,]+)\]'?", word):
                assert {*extra[1].split(",")} <= {*extras}, line


@each_page
def test_other_blocks_are_well_formed_and_name_what_there_is(page: Path) -> None:
    """Of Python the names that are imported from devrf; what pieces of files say is tried in test_extending."""
    for block in blocks(page):
        if block.language == "json":
            json.loads(block.text)
        if block.language == "python" and not block.text.startswith(" "):
            for node in ast.walk(ast.parse(block.text)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("devrf"):
                    module = importlib.import_module(str(node.module))
                    assert all(hasattr(module, name.name) for name in node.names), block.text
