"""Files as crews bring them home: small captures of which is known what is right, mostly through the command line."""

import itertools
import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from tests.conftest import Command

from devrf.capture.frames import CameraFrames
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.raw_compression import compression_of
from devrf.capture.photos.upright_pictures import read_picture
from devrf.capture.session import CaptureSession, preflight
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.video_writer import write_video

Copy = Callable[[str], Path]


@pytest.fixture
def copy(crew_files: Path, tmp_path: Path) -> Copy:
    """Copies a capture, without programs, so that it can be written beside."""

    def made(name: str) -> Path:
        ignored = shutil.ignore_patterns("*.py", "*.md", "__pycache__")
        shutil.copytree(crew_files / name, tmp_path / name, ignore=ignored)
        return tmp_path / name

    return made


def run(devrf: Command, scene: Path, stage: str) -> Path:
    """The run folder of a scene that was run up to a stage."""
    done = devrf("run", scene, "--until", stage, "--preset", "tiny")
    assert done.code == 0, done.err
    return next(scene.parent.rglob("devrf.log")).parent


def clocks(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "sync" / "sync.json").read_text())["cameras"]


def extracted(path: Path, out: Path) -> tuple[CameraFrames, list[np.ndarray]]:
    frames = extract_clip(path, out, path.stem, "camera", path.name, Keep()).frames
    return frames, [read_picture(out / f.file).astype(int) for f in frames.used if f.file]


def test_pictures_that_show_nothing_at_the_start_tell_no_time(copy: Copy, devrf: Command) -> None:
    folder = run(devrf, copy("start-black") / "scene.yaml", "sync")
    for name, offset_s in (("cam1", 0.2317), ("cam2", -0.1483), ("cam3", 0.0871)):
        clock = clocks(folder)[name]
        assert clock["method"] == "audio" and clock["offset_s"] == pytest.approx(offset_s, abs=1e-3)
    camera = json.loads((folder / "ingest" / "ingest.json").read_text())["cameras"]["cam1"]
    assert [f["index"] for f in camera["frames"] if not f["used"]] == [0, 1, 2]


def test_photos_that_lie_there_twice(crew_files: Path, tmp_path: Path) -> None:
    """Eight to the byte, four coded anew."""
    frames = extract_folder(crew_files / "photo-copies" / "sweep", tmp_path, "static", "sweep", "sweep")
    assert [f.photo for f in frames.used] == [f"IMG_{n:04d}.jpg" for n in range(1, 13)]
    assert any("12 of 24 photos are copies" in note for note in frames.notes)


@pytest.mark.parametrize("folder", ["srgb", "p3", "adobe", "mixed"])
def test_photos_look_the_same_whatever_their_profile(crew_files: Path, tmp_path: Path, folder: str) -> None:
    photos = crew_files / "wide-gamut-photos"
    frames = extract_folder(photos / folder, tmp_path, "static", "sweep", folder)
    for frame in frames.used:
        want = read_picture(photos / "srgb" / str(frame.photo)).astype(int)
        assert np.abs(read_picture(tmp_path / str(frame.file)) - want).mean() < 1.5  # compressed twice


@pytest.mark.parametrize("kind", ["left_right", "top_bottom", "swapped"])
def test_clips_that_ask_to_be_mirrored(crew_files: Path, tmp_path: Path, kind: str) -> None:
    want = extracted(crew_files / "mirrored-clip" / "straight.mp4", tmp_path)[1]
    frames, seen = extracted(crew_files / "mirrored-clip" / f"{kind}.mp4", tmp_path)
    assert len(seen) == len(want) >= 10
    assert max(np.abs(a - b).mean() for a, b in zip(want, seen, strict=True)) < 4  # compressed twice
    assert any("mirrored" in note for note in frames.notes)


def cut_out(kind: str, n: int, picture: np.ndarray) -> np.ndarray:
    """560x314 of picture n of a sweep of 640x360, as a phone hands it on that stabilises, or zooms in picture 36."""
    x, y = (36 * np.sin(0.9 * n), 20 * np.cos(1.3 * n)) if kind == "stabilised" else (0.0, 0.0)
    zoom = 1.15 if kind == "zoomed" and n >= 36 else 1.0
    around = cv2.getRotationMatrix2D((320 + x, 180 + y), 0.0, zoom)
    around[:, 2] += [280 - 320 - x, 157 - 180 - y]
    return cv2.warpAffine(picture, around, (560, 314), flags=cv2.INTER_LINEAR)


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "every", "about", "named"),
    [
        ("stabilised", 2, "from picture to picture", "tabilisation"),
        ("zoomed", 1, "one for all pictures", "000036"),
    ],
)
def test_sweeps_whose_lens_is_elsewhere_in_each_picture(
    data_dir: Path, tmp_path: Path, devrf: Command, kind: str, every: int, about: str, named: str
) -> None:
    with VideoReader(data_dir / "kuka_room" / "static.mp4") as reader:
        shown = itertools.islice(reader, 0, None, every)
        pictures = [cut_out(kind, n, frame.rgb) for n, frame in enumerate(shown)]
    write_video(tmp_path / "sweep.mp4", pictures, 30.0)
    scene = tmp_path / "scene.yaml"
    scene.write_text("name: sweep\noutput: run\ncapture: {static: sweep.mp4}\n")
    done = devrf("run", scene, "--until", "static_poses", "--preset", "tiny")
    rows = json.loads((tmp_path / "run" / "static_poses" / "health.json").read_text())["rows"]
    found = {row["about"]: row for row in rows if row["verdict"] != "ok"}
    assert done.code == 3 and named in found[about]["remedy"]
    assert kind == "stabilised" or "horizontal (fx) against vertical (fy)" in found


@pytest.mark.full
def test_timecode_counts_at_its_own_rate(copy: Copy, devrf: Command) -> None:
    folder = run(devrf, copy("timecode-own-rate") / "scene.yaml", "sync")
    cameras = json.loads((folder / "ingest" / "ingest.json").read_text())["cameras"]
    assert cameras["cam0"]["timecode_s"] == pytest.approx(35999.964, abs=2e-3)
    assert cameras["cam1"]["timecode_s"] == pytest.approx(36000.4645, abs=2e-3)
    assert cameras["cam1"]["timecode_fps"] == pytest.approx(30_000 / 1001)
    assert clocks(folder)["cam1"]["offset_s"] == pytest.approx(0.5005, abs=2e-3)  # 15 of 29.97


@pytest.mark.full
def test_clocks_by_timecode_alone(copy: Copy, devrf: Command) -> None:
    scene = copy("timecode-own-rate") / "scene.yaml"
    done = devrf(
        "run", scene, "--until", "sync", "--preset", "tiny", "--set", "calibration.sync.method=timestamps"
    )
    assert done.code == 0, done.err
    clock = clocks(next(scene.parent.rglob("devrf.log")).parent)["cam1"]
    assert clock["method"] == "timestamps" and clock["offset_s"] == pytest.approx(0.5005, abs=2e-3)


@pytest.mark.parametrize(
    ("table", "unit"), [("times_ms.csv", "milliseconds"), ("times_ns.csv", "nanoseconds")]
)
@pytest.mark.parametrize("command", ["run", "check"])
def test_a_table_that_is_not_in_seconds(
    copy: Copy, devrf: Command, command: str, table: str, unit: str
) -> None:
    scene = copy("table-unit") / "scene.yaml"
    scene.write_text(scene.read_text().replace("times_ms.csv", table))
    done = devrf(command, scene, "--preset", "tiny", *(["--until", "sync"] if command == "run" else []))
    assert done.code == 2 and table in done.err and unit in done.err


def test_photos_that_are_not_read_are_counted(copy: Copy, devrf: Command) -> None:
    scene = copy("unread-photos") / "scene.yaml"
    folder = run(devrf, scene, "ingest")
    camera = json.loads((folder / "ingest" / "ingest.json").read_text())["cameras"]["static"]
    assert len(camera["frames"]) == 18 and sum(f["photo"].endswith(".jfif") for f in camera["frames"]) == 6
    for text in (json.dumps(camera["faults"]), devrf("check", scene, "--preset", "tiny").out):
        assert "12 beside 18" in text and "6 HEIC" in text and "6 JPEG XL" in text


def scene_of(devrf: Command, folder: Path) -> tuple[dict[str, Any], str]:
    """The capture that `init` writes for a folder, and its page."""
    done = devrf("init", folder)
    assert done.code == 0, done.err
    return yaml.safe_load((folder / "scene.yaml").read_text())["capture"], done.out


@pytest.mark.full
def test_clips_of_photos_are_no_sweep(copy: Copy, devrf: Command) -> None:
    capture, page = scene_of(devrf, copy("live-photos"))
    assert capture["static"] == "DCIM/100APPLE"
    assert page.count(".MOV") == 1 and "4 clips" in page


@pytest.mark.full
def test_chapters_and_small_copies_are_no_cameras(copy: Copy, devrf: Command) -> None:
    capture, page = scene_of(devrf, copy("chapters"))
    assert sorted(capture["cameras"].values()) == [
        "card/CLIP/C0001.MP4",
        "left/GX010012.MP4",
        "right/GX010007.MP4",
    ]
    assert "card/SUB/C0001S03.MP4: " in page and "ffmpeg -f concat" in page
    assert page.count("2 chapters of one recording") == 2
    assert all(f"GX010012.MP4 GX020012.MP4 > chapters.txt{end}" in page for end in ("", " && "))


@pytest.mark.full
def test_channels_of_opposite_sign(copy: Copy, devrf: Command) -> None:
    clock = clocks(run(devrf, copy("opposed-channels") / "scene.yaml", "sync"))["cam1"]
    assert clock["method"] == "audio" and clock["offset_s"] == pytest.approx(0.2317, abs=1e-3)


def test_raw_photos_compressed_in_a_way_that_is_not_read(copy: Copy, devrf: Command) -> None:
    folder = copy("dng-jpeg-xl")
    done = devrf("run", folder / "scene_jpeg_xl.yaml", "--until", "ingest", "--preset", "tiny")
    assert done.code == 2 and "IMG_0000.DNG" in done.err and "JPEG XL (compression 52546)" in done.err
    assert [len(preflight(CaptureSession(static=folder / kind))) for kind in ("plain", "jpeg_xl")] == [0, 1]
    assert [compression_of(folder / kind / "IMG_0001.DNG") for kind in ("plain", "jpeg_xl")] == [1, 52546]
    odd = folder / "plain" / "IMG_0009.DNG"  # one photo among others, of a kind that nobody knows
    known, unknown = (struct.pack("<HHIH", 259, 3, 1, number) for number in (52546, 60000))
    odd.write_bytes((folder / "jpeg_xl" / "IMG_0001.DNG").read_bytes().replace(known, unknown))
    (fault,) = preflight(CaptureSession(static=folder / "plain"))
    assert "IMG_0009.DNG" in fault and "(compression 60000)" in fault
    cut = folder / "IMG_0002.DNG"
    cut.write_bytes((folder / "plain" / "IMG_0000.DNG").read_bytes()[:3000])
    for size in range(0, 3000, 97):
        cut.write_bytes(cut.read_bytes()[: 3000 - size])
        assert compression_of(cut) in (None, 1)
