"""The command line where paths or streams are none: words and exit codes, no traces."""

import subprocess
import sys
from pathlib import Path

import pytest

from devrf.pipelines.exit_codes import BAD_INPUT, DONE

PROGRAM = f"{sys.executable} -m devrf.pipelines.cli"
LONG = "a" * 300


def called(words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(f"{PROGRAM} {words}", shell=True, capture_output=True, text=True, cwd=folder)


@pytest.mark.parametrize("words", [f"status {LONG}", f"compare {LONG} {LONG}", f"check . --json {LONG}"])
def test_names_that_no_system_takes(tmp_path: Path, words: str) -> None:
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "scene.yaml").write_text("{name: x, capture: {static: a.mp4}}")
    result = called(words, tmp_path)
    assert result.returncode == BAD_INPUT and "Traceback" not in result.stderr
    assert LONG in result.stderr.replace("\n", "") and "too long" in result.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_streams_that_are_closed(tmp_path: Path, closed: str) -> None:
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "scene.yaml").write_text("{name: x, output: run, capture: {static: a.mp4}}")
    assert called(f"status . {closed}", tmp_path).returncode == DONE
    missing = called(f"status nothing {closed}", tmp_path)
    assert missing.returncode == BAD_INPUT and "Traceback" not in missing.stderr
