"""The summary of a batch: which code speaks for it, what stands on a terminal, files that are whole."""

import io
import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console

from devrf.pipelines.batch.board import Board
from devrf.pipelines.batch.rows import SceneRow, exit_code
from devrf.pipelines.console import Talk


def rows_with(*codes: int | None) -> list[SceneRow]:
    found = []
    for n, code in enumerate(codes):
        row = SceneRow(f"/{n}/scene.yaml", f"scene{n}", f"/{n}/run")
        if code is not None:
            row.end(code, "it is <b>broken</b>" if code else None)
        found.append(row)
    return found


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ((0, 0), 0),
        ((0, 2), 2),
        ((2, 3, 0), 3),
        ((3, 1, 2), 1),
        ((1, 130, 3), 130),
        ((0, 137), 1),
        ((-9, 3), 1),
        ((), 0),
    ],
)
def test_the_worst_code_speaks_for_the_batch(codes: tuple[int, ...], expected: int) -> None:
    assert exit_code(rows_with(*codes)) == expected


def test_on_a_terminal_what_runs_is_shown_and_taken_away(tmp_path: Path) -> None:
    talk = Talk("normal")
    screen = io.StringIO()
    talk.out = Console(file=screen, force_terminal=True, width=120)
    rows = rows_with(None, None, 0)
    rows[0].state, rows[0].nodes, rows[0].made = "running", ["node7"], ["ingest", "sync"]
    with Board(talk, tmp_path, rows, "local") as board:
        board.show()
        board._live.refresh() if board._live is not None else None
    shown = screen.getvalue()
    assert "node7" in shown and "ingest, sync" in shown and "1 waiting" in shown


def test_a_summary_that_cannot_be_written_stops_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with Board(Talk("quiet"), out, rows_with(0), "local") as board:
        shutil.rmtree(out)
        board.write()
        board.write()
    assert not board.written
    assert capsys.readouterr().err.count("the summary cannot be written (No such file or directory)") == 1


def test_the_files_follow_the_rows(tmp_path: Path) -> None:
    rows = rows_with(None, 1)
    with Board(Talk("quiet"), tmp_path, rows, "ray"):
        batch = json.loads((tmp_path / "batch.json").read_text())
        assert not batch["finished"] and batch["states"] == {"waiting": 1, "failed": 1}
        rows[0].end(0)
    batch = json.loads((tmp_path / "batch.json").read_text())
    assert batch["finished"] and batch["code"] == 1
    assert [row["code"] for row in batch["scenes"]] == [0, 1]
    assert "&lt;b&gt;broken" in (tmp_path / "batch.html").read_text()
    assert {path.name for path in tmp_path.iterdir()} == {"batch.json", "batch.html"}
