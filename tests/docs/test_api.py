"""docs/api.md and examples/api.ipynb as they stand: their code runs on a finished run."""

import json
import re
from pathlib import Path

import pytest
from tests.conftest import ExampleRun
from tests.docs.pages import REPOSITORY, blocks

import devrf

PAGE, NOTEBOOK = REPOSITORY / "docs" / "api.md", REPOSITORY / "examples" / "api.ipynb"
MOST_WORDS = 700


def run_blocks(texts: list[str], folder: Path, patch: pytest.MonkeyPatch) -> dict:
    """Run some code, part by part with the same names, in a folder; the names."""
    patch.chdir(folder)
    names: dict = {}
    for text in texts:
        exec(compile(text, "block", "exec"), names)
    return names


def page_code() -> list[str]:
    return [block.text for block in blocks(PAGE) if block.language == "python"]


def test_a_finished_run_of_the_page_on_small_run(
    small_run: ExampleRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [text for text in page_code() if "devrf.calibrate(" not in text]
    assert len(texts) == 3
    names = run_blocks(texts, small_run.scene.parent, monkeypatch)
    assert names["colour"].shape == (names["camera"].height, names["camera"].width, 3)
    assert names["opacity"].max() > 0.9
    assert names["ways"].shape == (len(names["scene"].times_s), len(names["surface"].xyz), 3)


@pytest.mark.full
def test_all_of_the_page_on_small_run(
    small_run: ExampleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in small_run.scene.parent.iterdir():
        (tmp_path / path.name).symlink_to(path)
    made = {path: path.stat().st_mtime_ns for path in small_run.run_dir.glob("*/stamp.json")}
    found = run_blocks(page_code(), tmp_path, monkeypatch)["calibration"]
    assert {
        "cam0",
        "cam2",
        "witness",
    } <= found.cameras.keys() and found.run_folder == tmp_path / "another" / "run"
    assert {path: path.stat().st_mtime_ns for path in made} == made, "a step made again what was fresh"


@pytest.mark.full
def test_cells_of_the_notebook_on_small_run(
    small_run: ExampleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import matplotlib

    matplotlib.use("agg")
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    (tmp_path / "workshop" / "runs").mkdir(parents=True)
    (tmp_path / "workshop" / "runs" / "workshop").symlink_to(small_run.run_dir)
    names = run_blocks(["".join(cell["source"]) for cell in cells], tmp_path, monkeypatch)
    assert names["test"]["psnr"] > names["still"]["psnr"]


def test_the_page_lists_all_that_is_public() -> None:
    text = PAGE.read_text(encoding="utf-8")
    public = text[text.index("## What is public") :]
    assert set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.+?) \|", public, re.M)))) == set(
        devrf.__all__
    )
    assert len(text.split()) <= MOST_WORDS
