"""Digests of files: what is read again, what is trusted, what is said of a file that cannot be read."""

import os
import time
from pathlib import Path

import pytest
import typer
from tests.pipelines.small_stages import job, small_stages

from devrf.pipelines.cli.main import status
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.stamps import digests
from devrf.pipelines.stamps.digests import Digests
from devrf.pipelines.terminal.exit_codes import BAD_INPUT


def test_a_digest_is_remembered_only_of_a_file_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []
    real = digests.file_digest
    monkeypatch.setattr(digests, "file_digest", lambda path: read.append(path.name) or real(path))
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"one")

    def look() -> str:
        known = Digests(tmp_path)
        digest = known.of(path)
        known.save()
        return digest

    first = look()
    look()
    assert read == ["clip.mp4"] * 2  # written a moment ago: read again
    monkeypatch.setattr(digests, "RACY_S", 0.0)
    time.sleep(0.02)
    look()
    look()
    assert len(read) == 2
    stat = path.stat()
    path.write_bytes(b"two")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # size and time as before
    assert look() != first and len(read) == 3
    monkeypatch.setattr(digests.time, "time_ns", lambda: 1)  # the clock was set back
    look()
    assert len(read) == 4


def test_a_file_that_cannot_be_read_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def denied(path: Path) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(digests, "file_digest", denied)
    assert execute(job(folder, small_stages())) == BAD_INPUT
    said = capsys.readouterr().err
    assert f"{folder}/static.mp4: " in said and "[file-unreadable]" in said
    with pytest.raises(typer.Exit) as ended:
        status(folder / "scene.yaml")
    assert ended.value.exit_code == BAD_INPUT


def test_a_folder_counts_by_names_and_contents(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for n in range(20):  # more than are read one by one
        (data / "in" / f"{n}").parent.mkdir(parents=True, exist_ok=True)
        (data / "in" / f"{n}").write_bytes(bytes([n]))

    def now() -> str:
        return Digests(tmp_path / "run").of(data)

    seen = {now()}
    for name in ("devrf.log", ".digests.json"):  # a run folder does not count, begun or only looked at
        (data / f"run of {name}").mkdir()
        (data / f"run of {name}" / name).write_text("{}")
        assert now() in seen
    for name in (
        ".DS_Store",
        "._7",
        "Thumbs.db",
        "desktop.ini",
        "7~",
        ".7.swp",
        "7.bak",
    ):  # dropped by others
        (data / "in" / name).write_text("dropped")
        assert now() in seen
    (data / "in" / "7").write_bytes(b"\x08")
    seen.add(now())
    (data / "in" / "8").rename(data / "in" / "eight")
    seen.add(now())
    (data / "in" / "9").unlink()
    seen.add(now())
    assert len(seen) == 4


@pytest.mark.parametrize(
    "text", ["", "[]", "[" * 100_000, '{"a": 1}', '{"clip.mp4": [1, 2]}', '{"clip.mp4": [1,1,1,1,1,2]}']
)
def test_damaged_memory_of_digests_is_forgotten(tmp_path: Path, text: str) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"clip")
    (tmp_path / ".digests.json").write_text(text)
    assert Digests(tmp_path).of(tmp_path / "clip.mp4") == digests.file_digest(tmp_path / "clip.mp4")
