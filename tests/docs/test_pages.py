"""What the pages promise is there: links, commands, options, keys; what the program writes of itself is current."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from tests.docs.pages import PAGES, PROGRAM, REPOSITORY, anchors, blocks, calls, links, prose

from devrf.pipelines.cli.main import app
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.load import load_scene

DOCS = REPOSITORY / "docs"
SCHEMA = REPOSITORY / "pipelines" / "config" / "scene.schema.json"
OF_OTHERS = {"--find-links", "--build-arg"}  # options of pip and docker
CAPTURE: dict[str, Any] = {  # what a block of some keys is put into
    "name": "kuka",
    "capture": {
        "static": "static.mp4",
        "cameras": {"cam0": "cam0.mp4", "cam1": "cam1.mp4"},
        "test_cameras": {"witness": "w.mp4"},
    },
}
ROW = re.compile(r"^\| `(\S+)` \| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", re.MULTILINE)  # of configuration.md
ROWS = {key: cells for key, *cells in ROW.findall((DOCS / "configuration.md").read_text(encoding="utf-8"))}

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name + "/" + page.name)


def commands_of(group: Any, before: str = "") -> dict[str, set[str]]:
    """Every command, those of groups too (`bench speed`) -> its options."""
    found: dict[str, set[str]] = {}
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            found |= commands_of(command, f"{name} ")
        else:
            said = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
            found[before + name] = {"--help", *said}
    return found


COMMANDS = commands_of(typer.main.get_command(app))
GONE_COMMANDS = {
    "bench growth",
    "bench parts",
    "bench reference",
}  # CHANGELOG.md says of earlier versions what they had
FIRST_WORDS = {name.split()[0] for name in COMMANDS} | {"COMMAND"}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the pages and the schema that the program writes of itself."""
    folder = tmp_path_factory.mktemp("pages")
    commands = ["-m", "typer", "devrf.pipelines.cli.main", "utils", "docs", "--name", PROGRAM, "--output"]
    for name, command in (
        ("commands.md", commands),
        ("configuration.md", [DOCS / "site" / "configuration.py"]),
    ):
        subprocess.run([sys.executable, *command, folder / name], check=True, capture_output=True)
    return folder


@pytest.mark.parametrize("name", ["commands.md", "configuration.md"])
def test_the_page_is_current(name: str, written: Path) -> None:
    same = (DOCS / name).read_text(encoding="utf-8") == (written / name).read_text(encoding="utf-8")
    assert same, f"docs/{name} is not what the program says: `make pages` writes it again"


def test_the_schema_for_editors_is_current(written: Path) -> None:
    now, kept = written / SCHEMA.name, json.loads(SCHEMA.read_text(encoding="utf-8"))
    assert json.loads(now.read_text(encoding="utf-8")) == kept, "`make pages` writes it again"
    assert kept["properties"]["preset"]["description"] and kept["additionalProperties"] is False


def test_the_schema_takes_the_example_and_no_slip(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    example = yaml.safe_load((DOCS.parent / "examples/workshop/scene.yaml").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(example, schema)
    for slip in ({"presett": "tiny"}, {"preset": "slow"}, {"reconstruct": {"resolution": "high"}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**example, **slip}, schema)


def test_what_the_page_of_keys_says() -> None:
    assert all(len(meaning) > 5 for _, _, meaning, _ in ROWS.values()) and len(ROWS) > 60
    assert ROWS["name"][1] == "(needed)" and ROWS["capture.static"][0] == "path"
    assert ROWS["capture.board.square_m"][0] == "number above 0 to 10"
    assert ROWS["capture.rest"][0] == "auto, start, middle, end, none"
    assert ROWS["evaluate.holdout_every"][1] == "`8`"
    assert ROWS["reconstruct.resolution"][1] == "`112` · `160` · `160`"
    assert [ROWS[key][3] for key in ("evaluate.truth", "budget.memory_gb")] == ["evaluate", "–"]
    simulate = (DOCS / "configuration.md").read_text(encoding="utf-8").split("## Options of simulate")[1]
    assert "\n| `sweep_frames` | whole number from 2 to 2000 | `72` | Pictures of the sweep" in simulate


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


# --- commands, options, keys ---


def alternatives(words: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Command (of several with | between, each) and the words behind it."""
    if words[0] != "bench":
        yield words[0], words[1:]
        return
    for n, word in enumerate(words[1:], 1):
        if n == 1 or words[n - 1] == "|":
            yield f"bench {word}", [w for w in words[n + 1 :] if w != "|"]


@each_page
def test_commands_and_options_exist(page: Path) -> None:
    for call in calls(page, FIRST_WORDS):
        for name, words in alternatives(call):
            if page.name == "CHANGELOG.md" and name in GONE_COMMANDS:
                continue
            assert name in COMMANDS or name == "COMMAND", f"{call}: there is no command {name}"
            said = {word.strip("[]") for word in words if word.strip("[").startswith("--")}
            if page.name == "CHANGELOG.md":  # says what earlier versions did
                said -= {key.split()[1] for key in GONE if key.startswith(f"{name} ")}
            assert said <= COMMANDS.get(name, {"--help"}), f"{call}: {said - COMMANDS.get(name, set())}"


def test_calls_are_found() -> None:
    """So that the test above sees them: on lines, within sentences, over two lines, and without the program's name."""
    found = [" ".join(call) for page in PAGES for call in calls(page, FIRST_WORDS)]
    assert any(line.startswith("bench speed SCENE --preset fast") and "--set-for" in line for line in found)
    assert "run --until flow" in found and len(found) > 80


@each_page
def test_options_and_keys_in_sentences_exist(page: Path) -> None:
    options = {"--version"} | OF_OTHERS | set().union(*COMMANDS.values())
    options |= {key.split()[1] for key in GONE if " --" in key}
    for code in re.findall(r"`([^`\n]+)`", prose(page)):
        if re.match(r"--[a-z]", code):
            assert code.split()[0] in options, f"{page.name}: {code}"
        key = re.fullmatch(
            r"(?:capture|dataset|calibration|flow|reconstruct|budget|evaluate)\.[a-z_.]+", code
        )
        if key and not code.endswith((".py", ".json", ".toml", ".mp4")):
            assert code in ROWS or code in GONE, f"{page.name}: {code} is no key"


@each_page
def test_configurations_are_taken_by_the_loader(page: Path, tmp_path: Path) -> None:
    for block in blocks(page):
        if block.language == "yaml":
            said = yaml.safe_load(block.text)
            capture = {**CAPTURE["capture"], **said.get("capture", {})}
            whole = said if "name" in said else {**CAPTURE, **said, "capture": capture}
            (tmp_path / "scene.yaml").write_text(yaml.safe_dump(whole))
            load_scene(tmp_path / "scene.yaml", check_files=False)
