"""The command line where paths or streams are none: words and exit codes, no traces."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED

PROGRAM = f"{sys.executable} -m devrf"
LONG = "a" * 300


def called(words: str, folder: Path, shell: str = "sh") -> subprocess.CompletedProcess[str]:
    return subprocess.run([shell, "-c", f"{PROGRAM} {words}"], capture_output=True, text=True, cwd=folder)


@pytest.mark.parametrize("words", [f"status {LONG}", f"compare {LONG} {LONG}", f"check . --json {LONG}"])
def test_names_that_no_system_takes(tmp_path: Path, words: str) -> None:
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "scene.yaml").write_text("{name: x, capture: {static: a.mp4}}")
    result = called(words, tmp_path)
    assert result.returncode == BAD_INPUT and "Traceback" not in result.stderr
    assert LONG in result.stderr.replace("\n", "") and "too long" in result.stderr


@pytest.mark.parametrize(
    "closed", [*(pytest.param(one, marks=pytest.mark.full) for one in (">&-", "2>&-", "<&-")), ">&- 2>&- <&-"]
)
def test_streams_that_are_closed(tmp_path: Path, closed: str) -> None:
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "scene.yaml").write_text("{name: x, output: run, capture: {static: a.mp4}}")
    assert called(f"status . {closed}", tmp_path).returncode == DONE
    missing = called(f"status nothing {closed}", tmp_path)
    assert missing.returncode == BAD_INPUT and "Traceback" not in missing.stderr


def test_output_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    """A full disk under a log is said once, on the errors; a reader that has left is nobody's loss."""
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "scene.yaml").write_text("{name: x, output: run, capture: {static: a.mp4}}")
    full = called("status . > /dev/full", tmp_path)
    assert full.returncode == FAILED and full.stderr.count("[output-lost]") == 1
    assert "Traceback" not in full.stderr
    gone = called("status . | true; exit ${PIPESTATUS[0]}", tmp_path, shell="bash")
    assert gone.returncode == DONE and gone.stderr == ""


@pytest.mark.parametrize("digits", ["0x" + "f" * 5000, "0b" + "1" * 20_000, ":".join(["1"] + ["59"] * 5000)])
def test_whole_numbers_that_python_cannot_print(tmp_path: Path, digits: str) -> None:
    (tmp_path / "scene.yaml").write_text(f"{{name: x, capture: {{static: a.mp4}}, seed: {digits}}}")
    result = called("run .", tmp_path)
    assert result.returncode == BAD_INPUT and "[configuration]" in result.stderr and "4096" in result.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a command has no parent process")
def test_ctrl_c_while_the_program_loads(tmp_path: Path) -> None:
    """Before a module of ours is looked for Python itself answers; from then on nothing is said."""
    hears = "import sys, os, signal, devrf.__main__ as entry\n"
    hears += "def late(name, *rest): os.kill(os.getpid(), signal.SIGINT); raise SystemExit(9)\n"
    hears += "import builtins; builtins.__import__ = late; entry.main()"
    result = subprocess.run([sys.executable, "-c", hears], cwd=tmp_path, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (STOPPED, "", "")


def test_a_folder_that_may_not_be_read(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("everything may be read by root")
    tmp_path.chmod(0o300)
    try:
        result = called(f"init {tmp_path}", Path("/"))
    finally:
        tmp_path.chmod(0o700)
    assert result.returncode == BAD_INPUT and "[folder-unreadable]" in result.stderr


def test_a_truth_that_is_none_is_seen_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(
        "{name: x, output: run, capture: {static: a.mp4}, evaluate: {truth: truth.json}}"
    )
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "truth.json").write_text("[" * 60_000)
    result = called("run . --until ingest", tmp_path)
    assert result.returncode == BAD_INPUT and "evaluate.truth: " in result.stderr
    assert "truth.json" in result.stderr and "[inputs-unusable]" in result.stderr
