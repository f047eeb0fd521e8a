"""Budgets: how many pictures a stage works on at once within the memory that it may use."""

import re
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devrf.capture.frames import CameraFrames, FrameRecord
from devrf.capture.orientation import Upright
from devrf.capture.photos import raw
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.session import CaptureSession
from devrf.capture.video import reader as video
from devrf.capture.video.reader import VideoInfo
from devrf.capture.video.video_writer import write_video
from devrf.pipelines.budget import at_once
from devrf.pipelines.budget.at_once import (
    BASE,
    fitting,
    flow_at_once,
    ingested_at_once,
    registered_at_once,
    swept_at_once,
)
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stage import Allowance, StageContext
from devrf.pipelines.stages.preflight import photos_too_large

GB = 10**9
LARGE = 3840, 2160


@pytest.fixture(autouse=True)
def eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(at_once, "usable_cores", lambda: 8)


def within(memory: float | None, said: list[str] | None = None) -> StageContext:
    """A stage that may use so many bytes."""
    config = SceneConfig.model_validate({"name": "x", "capture": {"static": "s.mp4"}})
    allowance = Allowance(None if memory is None else int(memory))
    say, here = ([] if said is None else said).append, Path()
    return StageContext(config, here, here, here, lambda *_: None, "cpu", say=say, allowance=allowance)


def filmed(width: int, height: int, count: int = 1) -> CameraFrames:
    frames = tuple(FrameRecord(n, None, 1.0, True, f"{n}.jpg") for n in range(count))
    return CameraFrames("sweep", "s", width, height, None, False, False, None, 0, frames)


@pytest.mark.parametrize(
    ("memory", "fits"), [(None, 8), (9 * GB, 8), (9 * GB - 1, 7), (4 * GB, 3), (2 * GB, 1), (GB // 2, 1)]
)
def test_fewer_pictures_at_once_where_memory_is_short_and_that_is_said(memory: int | None, fits: int) -> None:
    """A gigabyte whatever is done, and one for each picture; one is tried where none fits."""
    said: list[str] = []
    assert fitting(within(memory, said), GB, GB) == fits
    assert len(said) == (fits < 8) and all(f"{fits} instead of 8" in line for line in said)


def test_pairs_of_large_pictures_take_what_was_measured() -> None:
    """One pair took 1.82 GB, two 2.87 GB (docs/budgets.md), less than a stage's libraries."""
    pixels = LARGE[0] * LARGE[1]
    assert [flow_at_once(within(gb * GB), pixels) for gb in (1.82, 2.87, 1.5 * 2.87)] == [1, 1, 2]


def test_clips_and_photos_take_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six pictures of a clip took 0.54 GB (docs/budgets.md); more bits and sound take more, photos one at a time."""
    clip = VideoInfo(Path("c.mp4"), *LARGE, "h264", 60.0, 1800, 30.0, False, Upright())

    def ingested(gb: float, static: Path | None = None, **changes: object) -> int:
        monkeypatch.setattr(video, "probe_video", lambda path: replace(clip, **changes))
        return ingested_at_once(within(gb * GB), CaptureSession(static=static, cameras={"cam0": clip.path}))

    assert 4 <= ingested(0.54 + 0.35) <= 6
    assert ingested(0.54 + 0.35, bits=10) == 1 < ingested(2.5, bits=10) < 8
    sound = 60 * 48_000 * 16 / GB
    assert ingested(1.0, has_audio=True) == ingested(1.0 - sound) < ingested(1.0)
    (tmp_path / "photos").mkdir()
    write_picture(tmp_path / "photos" / "0.jpg", np.zeros((LARGE[1], LARGE[0], 3), np.uint8))
    assert ingested(0.6 + BASE / GB, tmp_path / "photos") == ingested(0.6 + BASE / GB)
    monkeypatch.setattr(raw, "is_raw", lambda path: True)
    assert ingested(0.6 + BASE / GB, tmp_path / "photos") < ingested(0.6 + BASE / GB)


def test_the_sweep_is_reduced_only_where_not_one_picture_fits() -> None:
    """Features at 1280, 960, 720 pixels take 98, 55, 31 MB a picture of 4:3, beside what all of them take."""
    sweep = filmed(4000, 3000, 120)
    base = BASE + 0.16 * GB + 5 * 12e6 + 120 * 3e6
    found = [swept_at_once(within(base + mb * 1e6), sweep) for mb in (99 * 8, 2.5 * 99, 60, 40, 1)]
    assert found == [(8, 1280), (2, 1280), (1, 960), (1, 720), (1, 540)]
    assert swept_at_once(within(None), sweep) == (8, 1280)


def test_small_pictures_of_fixed_cameras_are_doubled_before_they_are_searched() -> None:
    """640x480 pixels twice as large take 98 MB, those of 2560x1920 reduced to 1280 the same."""
    for size in ((640, 480), (2560, 1920)):
        base = BASE + 0.16 * GB + 30 * size[0] * size[1] + 50 * 1e6
        assert registered_at_once(within(base + 3.5 * 98.4e6), [filmed(*size), filmed(64, 48)], 50) == 3


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep and a camera of 1920x1080."""
    folder = tmp_path_factory.mktemp("clips")
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (68, 120, 3)).astype(np.uint8).repeat(16, 0).repeat(16, 1)
    pictures = [np.ascontiguousarray(np.roll(coarse, 4 * n, 1)[:1080]) for n in range(24)]
    write_video(folder / "static.mp4", pictures, 24.0)
    shutil.copy(folder / "static.mp4", folder / "cam0.mp4")
    (folder / "scene.yaml").write_text(
        "name: x\noutput: run\npreset: tiny\ncapture: {static: static.mp4, cameras: {cam0: cam0.mp4}}\n"
    )
    return folder


@pytest.mark.full
def test_a_tight_budget_makes_the_same_pictures_with_less_memory(clips: Path, tmp_path: Path) -> None:
    """In processes of their own, as if there were 16 cores; the disk is slow, so that all are at work at once."""
    program = (
        "import os, re, sys, time\nfrom pathlib import Path\n"
        "from devrf.capture.ingest import picture_writer\n"
        "os.environ.pop('OMP_NUM_THREADS', None)\n"
        "os.sched_getaffinity = lambda pid: set(range(16))\n"
        "from devrf.pipelines.budget.keep import Budget\nfrom devrf.pipelines.config.load import load_scene\n"
        "from devrf.pipelines.stage import StageContext\nfrom devrf.pipelines.stages import ingest\n"
        "scene, out, *budget = sys.argv[1:]\n"
        "write, in_hand, most = picture_writer._write, [], []\n"
        "def slowly(path, frame):\n"
        "    in_hand.append(path)\n"
        "    time.sleep(0.1)\n"
        "    most.append(len(in_hand))\n"
        "    write(path, frame)\n"
        "    in_hand.remove(path)\n"
        "picture_writer._write = slowly\n"
        "config, folder, said = load_scene(Path(scene) / 'scene.yaml', budget), Path(scene), []\n"
        "allowance = Budget(config, Path(out)).allowance()\n"
        "Path(out).mkdir()\n"
        "context = StageContext(\n"
        "    config, folder, Path(out), Path(out), lambda *a: None, 'cpu', say=said.append, allowance=allowance\n"
        ")\n"
        "ingest.run(context)\n"
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]\n"
        "assert 'torch' not in sys.modules, 'ingest loads 0.3 GB for nothing'\n"
        "print(max(most), peak, *said)\n"
    )

    def ingested(name: str, *budget: str) -> tuple[int, int, str, dict[Path, bytes]]:
        """Most pictures in hand, most kilobytes, what was said, files."""
        out = tmp_path / name
        command = [sys.executable, "-c", program, str(clips), str(out), *budget]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        in_hand, kilobytes, *said = done.stdout.split()
        files = {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
        return int(in_hand), int(kilobytes), " ".join(said), files

    in_hand, kilobytes, said, pictures = ingested("tight", "budget.memory_gb=0.5")
    fewer = re.search(r"(\d+) instead of 16", said)
    assert fewer is not None and in_hand <= int(fewer[1]) < 8
    assert 1024 * kilobytes < 0.5e9 and len(pictures) > 40
    in_hand, _, said, same = ingested("free")
    assert "instead" not in said and in_hand > 8 and same == pictures


def test_a_photo_that_does_not_fit_is_named(tmp_path: Path) -> None:
    """The largest counts, by its header; its pixels are not there at all."""
    write_picture(tmp_path / "a.png", np.zeros((8, 12, 3), np.uint8))
    header = bytearray((tmp_path / "a.png").read_bytes())
    header[16:24] = (10_000).to_bytes(4, "big") * 2
    header[29:33] = zlib.crc32(header[12:29]).to_bytes(4, "big")
    (tmp_path / "b.png").write_bytes(header)
    session = CaptureSession(static=tmp_path)
    config = SceneConfig.model_validate({"name": "x", "capture": {"static": "s"}, "budget": {"memory_gb": 1}})
    (problem,) = photos_too_large(config, session)
    assert all(words in problem for words in ("b.png", "10000x10000", "1.4 GB", "budget.memory_gb"))
    (tmp_path / "b.png").unlink()
    assert photos_too_large(config, session) == []
