"""A checkpoint is taken up only as it was written, and is written no more often than costs little."""

import logging
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.storage import checkpoint as checkpoints
from devrf.reconstruct.storage.checkpoint import NOWHERE, Begun, Checkpoint, State
from devrf.reconstruct.storage.training_log import TrainingLog

TENSORS = {
    "grid": torch.arange(12.0).reshape(3, 4),
    "step": torch.tensor(7),
    "nothing": torch.zeros(0, 3),
    "none": torch.from_numpy(np.array([])),  # whose stride is 0
}


def _log() -> TrainingLog:
    return TrainingLog("cpu", 3)


def _state() -> State:
    return TENSORS, {"share": 1 / 3}


def test_what_was_written_is_found(tmp_path: Path) -> None:
    log = _log()
    for _ in range(5):
        log.add(10, {"mse": torch.tensor(0.1)})
    Checkpoint(tmp_path / "state", "one", every_s=0.0).keep(5, 500, log, _state)
    again = _log()
    saved = Checkpoint(tmp_path / "state", "one").found(again)
    assert saved is not None and saved.done == 5 and saved.numbers["share"] == 1 / 3
    assert {name: t.tolist() for name, t in saved.tensors.items()} == {
        n: t.tolist() for n, t in TENSORS.items()
    }
    assert again.iteration == 5 and again.rays == 50 and again.rows == log.rows
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_that_of_another_training_is_not_taken_up(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    Checkpoint(tmp_path / "state", "one", every_s=0.0).keep(1, 500, _log(), _state)
    assert Checkpoint(tmp_path / "state", "other").found(_log()) is None
    (said,) = caplog.records
    assert said.levelname == "INFO" and str(tmp_path / "state") in said.getMessage()


def test_no_byte_of_it_can_change_unnoticed(tmp_path: Path) -> None:
    path = tmp_path / "state"
    Checkpoint(path, "one", every_s=0.0, chosen={"rays": 3}).keep(1, 500, _log(), _state)
    content, begun = path.read_bytes(), Begun(1, {"rays": 3})
    assert Checkpoint(path, "one").begun() == begun
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        assert Checkpoint(path, "one").found(_log()) is None, (at, content[at - 20 : at + 20])
        assert Checkpoint(path, "one").begun() in (None, begun), (at, content[at - 20 : at + 20])
    for length in range(len(content)):
        path.write_bytes(content[:length])
        assert Checkpoint(path, "one").found(_log()) is None, length
        assert Checkpoint(path, "one").begun() in (None, begun), length


def test_parts_are_removed_with_the_whole(tmp_path: Path) -> None:
    whole = Checkpoint(tmp_path / ".motion.safetensors", "one", every_s=0.0)
    part, other = whole.part("box"), Checkpoint(tmp_path / ".motions.safetensors", "one", every_s=0.0)
    for checkpoint in (whole, part, other):
        checkpoint.keep(1, 500, _log(), _state)
    assert (tmp_path / ".motion.box.safetensors").exists()
    assert whole.found(_log()) is not None and part.found(_log()) is not None
    whole.remove()
    assert [path.name for path in tmp_path.iterdir()] == [".motions.safetensors"]


def test_the_phase_written_last_says_how_far_it_is(tmp_path: Path) -> None:
    """A part left of an earlier beginning does not speak for the whole, nor the whole for a part that follows it."""
    whole = Checkpoint(tmp_path / ".motion.safetensors", "one", every_s=0.0, chosen="now")
    earlier = Checkpoint(whole.path, "one", every_s=0.0, chosen="before").part("fine-tuning")
    assert whole.path is not None and earlier.path is not None
    whole.keep(7, 500, _log(), _state)
    earlier.keep(300, 500, _log(), _state)
    for seconds, expected in ((10, Begun(300, "before")), (-10, Begun(7, "now"))):
        there = whole.path.stat().st_mtime
        os.utime(earlier.path, (there + seconds, there + seconds))
        assert whole.begun() == expected
    whole.path.unlink()
    assert whole.begun() == Begun(300, "before")
    whole.remove()
    assert whole.begun() is None


def test_without_a_place_nothing_is_kept() -> None:
    NOWHERE.keep(1, 500, _log(), _state)
    NOWHERE.part("box").keep(1, 500, _log(), _state)
    assert NOWHERE.found(_log()) is None
    NOWHERE.remove()


def test_a_full_disk_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint = Checkpoint(tmp_path / "state", "one", every_s=0.0)
    checkpoint.keep(1, 500, _log(), _state)

    def full(path: Path, *_: object) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints, "save_tensors", full)
    checkpoint.keep(2, 500, _log(), _state)
    assert str(tmp_path / "state") in caplog.text and "No space left on device" in caplog.text
    saved = Checkpoint(tmp_path / "state", "one").found(_log())
    assert saved is not None and saved.done == 1
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("stopped", [KeyboardInterrupt, ReconstructError])
def test_what_stops_it_while_it_writes_leaves_nothing_half_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: type[BaseException]
) -> None:
    """Ctrl-C, and the watch over the disk, come wherever the program is."""

    def half(path: Path, *_: object) -> None:
        path.write_bytes(b"half")
        raise stopped("disk-full", "no room")

    monkeypatch.setattr(checkpoints, "save_tensors", half)
    with pytest.raises(stopped):
        Checkpoint(tmp_path / "state", "one", every_s=0.0).keep(1, 500, _log(), _state)
    assert not list(tmp_path.iterdir())


def test_they_are_as_frequent_as_they_are_quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, written = [0.0], []
    monkeypatch.setattr("devrf.reconstruct.storage.checkpoint.time.monotonic", lambda: now[0])

    def slow(path: Path, *_: object) -> None:
        path.touch()
        written.append(now[0])
        now[0] += 10.0

    monkeypatch.setattr(checkpoints, "save_tensors", slow)
    checkpoint, log = Checkpoint(tmp_path / "state", "large fields"), _log()
    for done in range(500):
        checkpoint.keep(done, 500, log, lambda: ({"grid": torch.empty(1)}, {}))
        now[0] += 1.0
    assert written == [5.0, 215.0, 425.0]  # each takes 10 seconds, so the next follows 200 seconds later


def test_the_first_of_a_large_training_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("devrf.reconstruct.storage.checkpoint.time.monotonic", lambda: now[0])
    monkeypatch.setattr(checkpoints, "SLOW_DISK", 48.0)  # a second for the state, so 20 seconds before it
    checkpoint = Checkpoint(tmp_path / "state", "one")
    for done, there in ((6, False), (19, False), (21, True)):
        now[0] = done
        checkpoint.keep(done, 500, _log(), lambda: ({"grid": torch.zeros(12)}, {}))
        assert (tmp_path / "state").exists() == there
