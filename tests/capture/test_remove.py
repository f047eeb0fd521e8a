"""Folders are removed, and a signal that comes meanwhile is raised as a signal."""

import os
from pathlib import Path

import pytest

from devrf.capture.system.remove import remove_tree


def full_folder(parent: Path) -> Path:
    folder = parent / "full"
    (folder / "inside").mkdir(parents=True)
    (folder / "inside" / "file").write_text("x")
    return folder


def test_what_is_in_it_goes_too(tmp_path: Path) -> None:
    remove_tree(full_folder(tmp_path))
    assert not list(tmp_path.iterdir())
    remove_tree(tmp_path / "not there")


@pytest.mark.parametrize("nth", [1, 2])
def test_a_signal_right_after_a_folder_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nth: int
) -> None:
    """rmtree closes the folder again, which fails: without care the signal would be told as an error of the disk."""
    folder, closed, close = full_folder(tmp_path), 0, os.close

    def close_and_signal(handle: int) -> None:
        nonlocal closed
        close(handle)
        closed += 1
        if closed == nth:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "close", close_and_signal)
    with pytest.raises(KeyboardInterrupt):
        remove_tree(folder)
    assert closed >= nth
