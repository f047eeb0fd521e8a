"""Frames: which are chosen, what timestamps tell, and what lies on disk afterwards."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps, PngImagePlugin
from tests.refused import refused

from devrf.capture.frames import FrameSet, sharp, sharpest_per_window, sharpness, timing, window_of
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.ingest.ingest import read_motion, read_sounds, write_frames, write_sounds
from devrf.capture.ingest.signals import ROW_BANDS
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.photo_folders import list_pictures
from devrf.capture.photos.picture_files import natural_key
from devrf.capture.photos.upright_pictures import probe_picture, read_picture, write_picture
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.video.timestamps import FrameTimes


def test_sharpness_falls_with_blur():
    picture = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
    values = [sharpness(cv2.GaussianBlur(picture, (0, 0), s)) for s in (0.5, 1.0, 2.0)]
    assert values == sorted(values, reverse=True)


def test_windows_cover_the_clip_and_keep_the_sharpest():
    assert [window_of(i, 10, 3) for i in range(10)] == [0, 0, 0, 0, 1, 1, 1, 2, 2, 2]
    values = [1.0, 5.0, 2.0, 0.0, 3.0, 9.0, 1.0]
    assert sharpest_per_window(values, 3) == [1, 4, 5]
    assert sharpest_per_window(values, 7) == sharpest_per_window(values, 100) == list(range(7))


def test_blurred_frames_are_those_below_half_of_their_neighbours():
    values = [10.0] * 20
    values[7] = 4.0
    assert np.flatnonzero(~sharp(values)).tolist() == [7]


def test_timing_tells_variable_rate_from_dropped_frames():
    even = np.arange(100) / 30
    assert timing(even).notes == () and timing(even).fps_mean == pytest.approx(30)
    dropped = timing(np.delete(even, [40, 41, 70]))
    assert dropped.missing_frames == 3 and not dropped.variable_rate
    assert all(n in dropped.notes[0] for n in ("3 frames", "2 gaps", "1.30 s, 2.30 s"))
    varying = timing(np.cumsum(np.random.default_rng(0).uniform(0.02, 0.05, 100)))
    assert varying.variable_rate and len(varying.notes) == 1
    assert not timing(np.round(even, 3)).variable_rate  # millisecond time base
    assert timing(np.array([1.0])).fps_mean is None


def test_natural_order():
    names = ["f10.jpg", "f2.jpg", "F1.jpg", "a.jpg", "10.jpg", "9.jpg"]
    assert sorted(names, key=natural_key) == ["9.jpg", "10.jpg", "a.jpg", "F1.jpg", "f2.jpg", "f10.jpg"]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_baked_once(tmp_path, orientation):
    picture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (24, 36, 3)).astype(np.uint8), (0, 0), 2
    )
    image = Image.fromarray(picture)
    exif = image.getexif()
    exif[0x0112] = orientation
    (tmp_path / "in").mkdir()
    image.save(tmp_path / "in" / "a.jpg", exif=exif, quality=98)
    with Image.open(tmp_path / "in" / "a.jpg") as again:
        expected = np.asarray(ImageOps.exif_transpose(again)).astype(int)
    info = probe_picture(tmp_path / "in" / "a.jpg")
    assert (info.height, info.width) == expected.shape[:2]
    frames = extract_folder(tmp_path / "in", tmp_path, "static", "sweep", "in")
    written = tmp_path / str(frames.frames[0].file)
    got = read_picture(written).astype(int)
    assert got.shape == expected.shape and np.abs(got - expected).mean() < 2
    if orientation == 1:
        assert written.read_bytes() == (tmp_path / "in" / "a.jpg").read_bytes()
    else:
        assert frames.notes[0].startswith("1 ") and probe_picture(written).upright.nothing


def test_mixed_sizes_are_reported_and_transparency_kept(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    rgba = np.random.default_rng(0).integers(0, 255, (20, 30, 4)).astype(np.uint8)
    for i in range(3):
        write_picture(folder / f"{i}.png", np.roll(rgba, i, axis=0))
    write_picture(folder / "3.png", rgba[:10])
    frames = extract_folder(folder, tmp_path, "static", "sweep", "in")
    assert [f.used for f in frames.frames] == [True, True, True, False]
    assert "3 of 30x20" in frames.notes[0] and "1 of 30x10" in frames.notes[0]
    np.testing.assert_array_equal(read_picture(tmp_path / "frames/static/000000.png"), rgba)
    assert not (tmp_path / "frames/static/000003.png").exists()


def test_a_sweep_may_mix_sizes_of_which_it_has_enough(tmp_path):
    (tmp_path / "in").mkdir()
    for i in range(10):
        upright = np.zeros((20, 30, 3) if i % 2 else (30, 20, 3), dtype=np.uint8)
        write_picture(tmp_path / "in" / f"{i}.png", upright)
    frames = extract_folder(tmp_path / "in", tmp_path, "static", "sweep", "in")
    assert len(frames.used) == 10 and "5 of" in frames.notes[0]
    board = extract_folder(tmp_path / "in", tmp_path / "b", "board_static", "board", "in")
    assert len(board.used) == 5  # one set of intrinsics


def test_folders_without_photos(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with refused("pictures-none", tmp_path, ".txt", kind=InputError):
        list_pictures(tmp_path)
    with refused("folder-missing", tmp_path / "nothing", kind=InputError):
        list_pictures(tmp_path / "nothing")


def test_clip_keeps_the_sharpest_of_each_window(make_clip, pictures, tmp_path):
    blurred = [cv2.GaussianBlur(p, (0, 0), 3) if i % 3 else p for i, p in enumerate(pictures)]
    got = extract_clip(make_clip("a.mp4", blurred), tmp_path, "static", "sweep", "a.mp4", Keep(most=4))
    assert [f.index for f in got.frames.used] == [0, 3, 6, 9]
    files = sorted(p.name for p in (tmp_path / "frames/static").iterdir())
    assert files == ["000000.jpg", "000003.jpg", "000006.jpg", "000009.jpg"]
    assert len(got.frames.frames) == 12 and got.frames.fps_mean == pytest.approx(25)
    picture = read_picture(tmp_path / "frames/static/000003.jpg").astype(int)
    assert np.abs(picture - blurred[3]).mean() < 6
    every = extract_clip(tmp_path / "a.mp4", tmp_path, "j", "joint", "a.mp4", Keep(most=4, choose="every"))
    assert [f.file for f in every.frames.used][1] == "frames/j/000003.jpg"


def test_clip_in_a_range_and_by_a_table_of_times(make_clip, pictures, tmp_path):
    path = make_clip("a.mp4", pictures)
    got = extract_clip(path, tmp_path, "cam0", "camera", "a.mp4", Keep(range_s=(0.1, 0.2)))
    assert [f.index for f in got.frames.used] == [3, 4, 5]
    assert [round(float(t), 3) for t in got.courses.motion[:2, 0]] == [0.02, 0.06]  # motion is kept of all
    times = FrameTimes(np.array([0, 1, 3, 20]), np.array([7.0, 7.5, 8.25, 30.0]))
    got = extract_clip(path, tmp_path, "cam0", "camera", "a.mp4", Keep(), times)
    assert [(f.index, f.time_s) for f in got.frames.used] == [(0, 7.0), (1, 7.5), (3, 8.25)]
    assert any("9 of 12 frames" in n for n in got.frames.notes)
    assert any("frame 20" in n and "12" in n for n in got.frames.notes)
    with refused("range-empty", "a.mp4", "5.00 and 6.00 s", "0.00 to 0.44", kind=CaptureError):
        extract_clip(path, tmp_path, "cam0", "camera", "a.mp4", Keep(range_s=(5.0, 6.0)))


def test_a_plain_clip_has_no_notes(make_clip, pictures, tmp_path):
    calm = extract_clip(make_clip("b.mp4", pictures), tmp_path, "cam1", "camera", "b.mp4", Keep())
    assert calm.frames.notes == ()


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_turned_clips_keep_the_order_of_the_sensors_rows(make_clip, tmp_path, rotation):
    stored = np.repeat(np.arange(0, 240, 5, dtype=np.uint8)[:, None, None], 64, axis=1).repeat(3, axis=2)
    path = make_clip("a.mp4", [stored] * 3, rotation=rotation)  # brighter down the sensor
    got = extract_clip(path, tmp_path, "cam0", "camera", "a.mp4", Keep())
    bands = got.courses.brightness
    assert bands.shape == (3, 1 + ROW_BANDS) and np.all(np.diff(bands[:, 1:], axis=1) > 0)


def test_whole_session_on_disk_and_back(make_clip, pictures, tmp_path):
    tone = 0.3 * np.sin(np.arange(30_000) / 20)
    cam0 = make_clip("cam0.mp4", pictures, np.arange(12) / 25 + 0.2, sound=tone)
    cam1 = make_clip("cam1.mp4", pictures)
    session = CaptureSession(
        static=make_clip("static.mp4", pictures),
        cameras={"cam0": cam0, "cam1": cam1},
        test_names=("cam1",),
        board_clips={"cam0": make_clip("board.mp4", pictures)},
        joint_clips={"cam0": cam0, "cam1": make_clip("joint1.mp4", pictures)},
    )
    out = tmp_path / "ingest"
    sounds = write_sounds(session, out)
    frames = write_frames(session, sounds, out, tmp_path)
    assert FrameSet.read(out) == frames
    roles = {name: c.role for name, c in frames.cameras.items()}
    assert roles == {
        "static": "sweep", "cam0": "camera", "cam1": "test", "board_cam0": "board", "joint_cam1": "joint",
    }  # fmt: skip
    assert frames.joint == {"cam0": "cam0", "cam1": "joint_cam1"}
    assert list(sounds) == ["cam0"] and frames.cameras["cam0"].has_audio
    assert len(frames.cameras["cam1"].notes) == 1 and not frames.cameras["cam1"].has_audio
    assert frames.cameras["cam0"].frames[0].time_s == pytest.approx(0.2)
    assert frames.cameras["cam0"].source == "cam0.mp4"
    for camera in frames.cameras.values():
        assert all((out / str(f.file)).is_file() for f in camera.used) and len(camera.used) == 12
    again = read_sounds(out, frames)["cam0"]
    assert again.start_s == pytest.approx(sounds["cam0"].start_s)
    assert read_motion(out, frames)["cam1"].shape == (11, 2)
    (out / "ingest.json").write_text("{}")
    with refused("file-damaged", "ingest.json", kind=CaptureError):
        FrameSet.read(out)
    assert replace(frames.cameras["cam0"], frames=()).used == ()


def test_real_photos(data_dir, tmp_path):
    path = data_dir / "fox_static" / "images"
    frames = extract_folder(path, tmp_path, "static", "sweep", "images")
    assert len(frames.used) == 50 and (frames.width, frames.height) == (540, 960)
    exif = probe_picture(list_pictures(data_dir / "sceaux_castle" / "images")[0]).exif
    assert exif is not None and exif.focal_px == pytest.approx(1452.94, rel=0.03)  # K.txt


@pytest.mark.parametrize("behind", [False, True], ids=["before the pixels", "behind the pixels"])
def test_tags_of_png_are_read_without_decoding(tmp_path, behind, monkeypatch):
    """exiftool and others put the chunk of tags behind the pixels."""
    image, path = Image.new("RGB", (40, 30)), tmp_path / "a.png"
    exif = image.getexif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    image.save(path, exif=exif)
    data = path.read_bytes()
    if behind:
        at = data.index(b"eXIf") - 4
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        data = data[:at] + data[end:-12] + data[at:end] + data[-12:]  # IEND is the last
        path.write_bytes(data)
    monkeypatch.setattr(Image.Image, "load", lambda image: pytest.fail("decoded"))
    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", lambda image: pytest.fail("decoded"))
    info = probe_picture(path)
    assert (info.width, info.height, info.upright.degrees) == (30, 40, 270)
    assert info.exif is not None and info.exif.device == "Maker"
