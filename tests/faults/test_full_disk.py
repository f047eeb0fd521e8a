"""Disks that become full at random moments."""

import os
import random
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.faults.conftest import TinyMaker
from tests.faults.harness import Count, Tiny, go_on
from tests.faults.test_killed import start_from

from devrf.pipelines.terminal.exit_codes import DONE, FAILED

KB = 1024
NEEDED_KB = 720  # of an undisturbed run, about


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small file system of its own, in memory."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if mounted.returncode != 0:
        reason = f"no small disk can be mounted: {mounted.stderr.strip()}; try unshare -rm python -m pytest {__file__}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def resize(disk: Path, kilobytes: int) -> None:
    """Give the disk another size."""
    subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(disk)], check=True, capture_output=True)


def test_a_full_disk_costs_no_more_than_the_stage(
    disk: Path, new_tiny: TinyMaker, reference: Path, faults: str, figures
) -> None:
    rng, count = random.Random(4), Count()
    while count.took_effect < (50 if faults == "full" else 7):  # those that found room enough are not counted
        resize(disk, 20_000)
        tiny = new_tiny()
        on_disk = Tiny(disk / "tiny")
        shutil.copytree(tiny.folder, on_disk.folder)
        settings = start_from(on_disk, reference, made=rng.random() < 0.4)
        used = sum(path.stat().st_blocks * 512 for path in disk.rglob("*") if path.is_file()) // KB
        resize(disk, used + rng.randint(4, NEEDED_KB + 50))
        result = on_disk.run(*settings)
        assert "Traceback" not in result.stderr, result.stderr
        assert result.returncode in (DONE, FAILED), result.stderr
        if result.returncode == FAILED:
            count.took_effect += 1
            assert str(on_disk.run_dir) in result.stderr and "[disk-full]" in result.stderr
            assert not list(on_disk.run_dir.glob(".new-*"))  # its room is free again
        resize(disk, 20_000)
        go_on(on_disk, reference, count)
        shutil.rmtree(on_disk.folder)
    assert count.took_effect > count.faults / 3
    assert count.used_again == count.finished_before > 0
    figures(**count.figures())
