"""The cache: what is kept and taken, what is never taken, and what it does with several runs and little room."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.pipelines.small_stages import ALL, SCENE, job, small_stages, write
from tests.waiting import wait_for

from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.exit_codes import BAD_INPUT, DONE
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run, dry_run
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stamps import cache as cache_module
from devrf.pipelines.stamps.cache import Cache, cache_of
from devrf.pipelines.stamps.digests import CACHE_TAG

CACHE = "cache.folder=kept"


def ran(folder: Path, *overrides: str, choice: Choice | None = None, **works: Callable) -> tuple[list, list]:
    """What was executed, and what was taken from the cache."""
    run = job(folder, small_stages(**works), CACHE, *overrides, choice=choice)
    assert execute(run) == DONE
    return run.executed, run.taken


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def entries(folder: Path, stage: str = "*") -> list[Path]:
    return sorted((folder / "kept").glob(f"{stage}/*"))


def test_an_earlier_configuration_is_taken_instead_of_run(folder: Path) -> None:
    assert ran(folder) == (ALL, [])
    before = content(folder / "run/second")
    assert ran(folder, "reconstruct.rays=200") == (["second", "third"], [])
    assert ran(folder) == ([], ["second", "third"])
    assert content(folder / "run/second") == before
    assert ran(folder) == ([], [])
    assert ran(folder, "reconstruct.rays=200") == ([], ["second", "third"])


def test_what_was_made_before_there_was_a_cache_is_kept_too(folder: Path) -> None:
    assert execute(job(folder, small_stages())) == DONE
    assert not (folder / "kept").exists()
    ran(folder, "reconstruct.rays=200")
    assert ran(folder) == ([], ["second", "third"])


def test_another_scene_with_the_same_inputs_shares_it(folder: Path, tmp_path: Path) -> None:
    ran(folder)
    other = tmp_path / "other"
    other.mkdir()
    (other / "scene.yaml").write_text(
        (folder / "scene.yaml").read_text().replace("seed: 1", "seed: 2").replace("static.mp4", "sweep.mp4")
    )
    (other / "sweep.mp4").write_bytes((folder / "static.mp4").read_bytes())
    (other / "cam0.mp4").write_bytes((folder / "cam0.mp4").read_bytes())
    run = job(other, small_stages(), "cache.folder=../kept")
    assert execute(run) == DONE
    assert (run.executed, run.taken) == (["other"], ["first", "second", "third"])


def test_status_and_dry_run_know(folder: Path, capsys: pytest.CaptureFixture) -> None:
    ran(folder)
    ran(folder, "reconstruct.rays=200")
    run = job(folder, small_stages(), CACHE, "reconstruct.seed=5")
    run.talk = Talk("normal")
    dry_run(run, run.standings())
    said = capsys.readouterr().out
    assert re.search("second: .*cache.*: reconstruct.rays: 200 .* 100", said)
    assert re.search("third: .*cache.*: second ", said)  # known by what second holds
    assert re.search("other: would run: reconstruct.seed: 1 .* 5", said)
    assert [now.cached is not None for now in run.standings()] == [False, True, False, True]


def test_what_is_forced_runs(folder: Path) -> None:
    ran(folder)
    ran(folder, "reconstruct.rays=200")
    executed, taken = ran(folder, choice=Choice(force=("second",)))
    assert "second" in executed and "second" not in taken


# --- what is never taken ---


def damage_a_byte(entry: Path) -> None:
    path = entry / "sub/result.txt"
    text = path.read_bytes()
    path.unlink()  # not the linked file in the run folder
    path.write_bytes(bytes([text[0] ^ 1]) + text[1:])


def lose_a_file(entry: Path) -> None:
    (entry / "made_of.txt").unlink()


def add_a_file(entry: Path) -> None:
    (entry / "more.txt").write_text("more")


def tear_the_stamp(entry: Path) -> None:
    stamp = (entry / "stamp.json").read_text()
    (entry / "stamp.json").unlink()
    (entry / "stamp.json").write_text(stamp[:100])


@pytest.mark.parametrize("fault", [damage_a_byte, lose_a_file, add_a_file, tear_the_stamp])
def test_a_damaged_entry_is_not_taken(folder: Path, fault: Callable[[Path], None]) -> None:
    ran(folder)
    good = content(folder / "run/second")
    ran(folder, "reconstruct.rays=200")
    for entry in entries(folder, "second"):
        fault(entry)
    executed, _ = ran(folder)
    assert executed == ["second"]  # and third is taken: second came out as it was
    again = content(folder / "run/second")
    assert {n: b for n, b in again.items() if n != "stamp.json"} == {
        n: b for n, b in good.items() if n != "stamp.json"
    }
    ran(folder, "reconstruct.rays=200")
    assert ran(folder) == ([], ["second", "third"])  # the damaged entry was replaced


def test_a_file_written_in_place_in_the_run_folder_is_not_taken_for_the_cached_one(folder: Path) -> None:
    """Both are one file by its hard link."""
    ran(folder)
    (folder / "run/second/sub/result.txt").write_text("SECOND")
    executed, taken = ran(folder)
    assert (executed, taken) == (["second"], [])
    assert (folder / "run/second/sub/result.txt").read_text() == "second"


def test_a_stage_that_quotes_stamps_is_not_kept(folder: Path) -> None:
    *others, third = small_stages()
    run = job(folder, (*others, replace(third, quotes_stamps=True)), CACHE)
    assert execute(run) == DONE
    assert {entry.parent.name for entry in entries(folder)} == {"first", "second", "other"}
    run = job(folder, (*others, replace(third, quotes_stamps=True)), CACHE, choice=Choice(force=("second",)))
    assert execute(run) == DONE
    assert run.executed == ["second", "third"]  # the same content, made anew: its times are others


# --- room ---


def big(context: StageContext) -> None:
    write("big")(context)
    (context.out / "big.bin").write_bytes(bytes(400_000))


def test_what_was_used_longest_ago_goes_first(folder: Path) -> None:
    for rays in (101, 102, 103, 101, 104):  # 400 kB each, of a megabyte
        ran(folder, f"reconstruct.rays={rays}", "cache.max_gb=0.001", second=big)
        time.sleep(0.01)
    kept = [
        json.loads((e / "stamp.json").read_text())["identity"]["config"] for e in entries(folder, "second")
    ]
    assert sorted(config["reconstruct.rays"] for config in kept) == [101, 104]


def test_what_is_larger_than_the_cache_is_not_kept(folder: Path) -> None:
    ran(folder, "cache.max_gb=0.0003", second=big)
    assert entries(folder, "second") == [] and len(entries(folder, "first")) == 1
    assert cache_of(load_scene(folder / "scene.yaml", [CACHE, "cache.max_gb=0"]), folder) is None


def test_a_cache_that_cannot_be_written_stops_nothing(folder: Path, capsys: pytest.CaptureFixture) -> None:
    (folder / "kept").mkdir()
    (folder / "kept" / CACHE_TAG).touch()
    (folder / "kept" / "first").write_text("a file in the way")
    run = job(folder, small_stages(), CACHE)
    run.talk = Talk("normal")
    assert execute(run) == DONE
    assert run.executed == ALL
    assert "first: not kept in the cache" in capsys.readouterr().out


def test_another_disk_gets_copies(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_link(source: Path, target: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(cache_module.os, "link", no_link)
    ran(folder)
    (entry,) = entries(folder, "second")
    assert (entry / "made_of.txt").stat().st_ino != (folder / "run/second/made_of.txt").stat().st_ino
    ran(folder, "reconstruct.rays=200")
    assert ran(folder) == ([], ["second", "third"])


def test_what_is_no_cache_is_left_alone(folder: Path, capsys: pytest.CaptureFixture) -> None:
    precious = folder / "photos/holiday/a.jpg"
    precious.parent.mkdir(parents=True)
    precious.write_text("dear")
    os.utime(precious.parent, (1, 1))
    ran(folder)
    for place, refusal in (("photos", "(holiday)"), ("run", "[folder-exists]"), (".", "[folder-exists]"),
                           ("scene.yaml", "[folder-is-file]"), ("run/kept", "[cache-inside-run]")):  # fmt: skip
        for choice in (Choice(), Choice(force=("all",))):
            assert execute(job(folder, small_stages(), f"cache.folder={place}", choice=choice)) == BAD_INPUT
        assert refusal in capsys.readouterr().err
    other = folder / "kept/first/mine"
    other.mkdir()
    os.utime(other, (1, 1))
    ran(folder, "reconstruct.rays=300")
    assert precious.exists() and other.exists()


def test_with_less_room_than_a_stage_needs_it_shrinks(folder: Path) -> None:
    ran(folder)
    assert len(entries(folder)) == 4
    ran(folder, "cache.max_gb=0.000000001", "reconstruct.rays=300")
    assert entries(folder) == []


def test_where_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_scene(folder / "scene.yaml")
    monkeypatch.delenv("DEVRF_CACHE", raising=False)
    assert cache_of(config, folder) is None
    monkeypatch.setenv("DEVRF_CACHE", str(folder / "mine"))
    assert cache_of(config, folder) == Cache(folder / "mine", 50.0)
    ours = load_scene(folder / "scene.yaml", ["cache.folder=ours", "cache.max_gb=2"])
    assert cache_of(ours, folder) == Cache(folder / "ours", 2.0)


# --- killed, and several at a time ---


def test_what_a_killed_run_left_is_removed_one_day(folder: Path) -> None:
    ran(folder)
    left = folder / "kept/second/.new-abc"
    left.mkdir()
    (left / "half.txt").write_text("half")
    ran(folder, "reconstruct.rays=200")
    assert left.exists()  # another run may be at work on it
    os.utime(left, (1, 1))
    ran(folder, "reconstruct.rays=300")
    assert not left.exists()


@pytest.mark.full
def test_runs_share_a_cache_while_others_empty_it(tmp_path: Path) -> None:
    """Six at a time in a cache with room for a few entries, three of them killed: what the others have is whole."""
    folders = []
    for n in range(6):
        folder = tmp_path / f"{n}"
        folder.mkdir()
        (folder / "static.mp4").write_bytes(b"sweep")
        (folder / "cam0.mp4").write_bytes(b"clip")
        (folder / "scene.yaml").write_text(SCENE + "cache: {folder: ../kept, max_gb: 0.0000015}\n")
        folders.append(folder)
    command = [sys.executable, "-m", "tests.pipelines.test_cache"]
    runs = [subprocess.Popen([*command, str(folder)], stderr=subprocess.PIPE) for folder in folders]
    wait_for((tmp_path / "kept").exists)
    for n, run in enumerate(runs[:3]):
        time.sleep(0.05 * n)
        run.kill()
    for run, folder in zip(runs[3:], folders[3:], strict=True):
        _, err = run.communicate(timeout=60)
        assert run.returncode == 0, err.decode()
        made = {n: text for n, text in content(folder / "run/second").items() if n != "stamp.json"}
        alone = tmp_path / "alone"
        if not alone.exists():
            shutil.copytree(folder, alone, ignore=shutil.ignore_patterns("run"))
            assert execute(job(alone, small_stages(), "cache.max_gb=0", "reconstruct.rays=102")) == DONE
        assert made == {n: b for n, b in content(alone / "run/second").items() if n != "stamp.json"}
    for run in runs[:3]:
        run.wait()


if __name__ == "__main__":
    scene = Path(sys.argv[1])
    for turn in range(12):
        run = Run(
            load_scene(scene / "scene.yaml", [f"reconstruct.rays={100 + turn % 3}"]),
            scene,
            small_stages(),
            Choice(),
            Talk("quiet"),
        )
        if code := execute(run):
            sys.exit(code)
