"""Video: times from timestamps, upright pictures, and files that are not what they should be."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from tests.make.clips import add_pictures
from tests.refused import refused

from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.system.errors import InputError
from devrf.capture.video.media import MOST_THREADS, open_media, video_stream
from devrf.capture.video.packets import scan_packets
from devrf.capture.video.reader import VideoReader, probe_video


def read(path: Path) -> tuple[list[float], list[np.ndarray], str | None]:
    with VideoReader(path) as reader:
        frames = list(reader)
        return [f.time_s for f in frames], [f.rgb for f in frames], reader.ended_early


def test_times_are_the_files_own_not_index_over_rate(make_clip, pictures):
    times = np.cumsum([0.5, *np.random.default_rng(1).uniform(0.02, 0.11, 11)])
    path = make_clip("variable.mp4", pictures, times)
    got, rgb, early = read(path)
    np.testing.assert_allclose(got, times, atol=1 / 90_000)
    assert early is None and scan_packets(path).count == 12
    assert np.abs(rgb[3].astype(int) - pictures[3]).mean() < 6  # right order, right colours


def test_probe_tells_size_sound_and_length(make_clip, pictures):
    info = probe_video(make_clip("a.mp4", pictures, sound=np.zeros(48_000)))
    assert (info.width, info.height, info.codec, info.has_audio) == (64, 48, "h264", True)
    assert info.announced_frames == 12 and info.duration_s == pytest.approx(12 / 25, abs=0.05)


@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_stored_turn_is_applied_once(make_clip, pictures, rotation):
    path = make_clip("turned.mp4", pictures, rotation=rotation)
    rgb = read(path)[1][5]
    expected = np.rot90(pictures[5], rotation // 90)  # counter-clockwise, as ffmpeg defines the matrix
    assert rgb.shape == expected.shape
    assert np.abs(rgb.astype(int) - expected).mean() < 6
    info = probe_video(path)
    assert (info.width, info.height) == (expected.shape[1], expected.shape[0])
    assert info.upright.degrees == rotation % 360 and len(info.notes) == 1


def test_unlabelled_small_pictures_are_bt601(make_clip):
    colour = np.full((48, 64, 3), (200, 60, 30), np.uint8)
    assert np.abs(read(make_clip("c.mp4", [colour] * 3))[1][1].astype(int) - colour).max() <= 6


def noisy() -> np.ndarray:
    """Forty pictures that leave much data each."""
    return np.random.default_rng(2).integers(0, 255, (40, 48, 64, 3)).astype(np.uint8)


def test_truncated_file_gives_what_is_there_and_says_so(make_clip, pictures):
    path = make_clip("cut.mp4", noisy(), faststart=True)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data))])
    times, _, early = read(path)
    assert 10 <= len(times) < 40 and np.all(np.diff(times) > 0)
    assert early is not None and f"ends at frame {len(times)} of 40" in early


def test_damage_in_the_middle_ends_the_clip_with_a_note(make_clip):
    path = make_clip("hole.mp4", noisy(), faststart=True)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 6000] = bytes(6000)
    path.write_bytes(data)
    times, _, early = read(path)
    assert 5 <= len(times) < 40 and early is not None and "of 40" in early


@pytest.mark.parametrize(
    "name, content, code",
    [
        ("text.mp4", b"this is a shopping list\n" * 20, "file-is-text"),
        ("list.mp4", b"ffconcat version 1.0\nfile 'other.mp4'\n", "file-is-text"),
        (
            "playlist.mp4",
            b"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nother.mp4\n#EXT-X-ENDLIST\n",
            "file-is-text",
        ),
        ("session.mp4", b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nm=video 5004 RTP/AVP 96\n", "file-is-text"),
        ("empty.mp4", b"", "file-empty"),
        ("noise.mp4", bytes(range(128, 256)) * 40, "file-not-video"),
    ],
)
def test_not_a_video(make_clip, pictures, tmp_path, name, content, code):
    make_clip("other.mp4", pictures)  # which a list may name
    path = tmp_path / name
    path.write_bytes(content)
    with refused(code, name, kind=InputError):
        probe_video(path)


def test_index_cut_off_and_no_frames(make_clip, pictures):
    path = make_clip("noindex.mp4", pictures)
    path.write_bytes(path.read_bytes()[:1500])
    with refused("file-cut-short", "noindex.mp4", kind=InputError):
        probe_video(path)
    with refused("video-missing", "none.mp4", kind=InputError):
        probe_video(make_clip("none.mp4", []))


def test_missing_folder_and_sound_only(tmp_path):
    with refused("file-missing", "nothing.mp4", kind=InputError):
        probe_video(tmp_path / "nothing.mp4")
    with refused("file-is-folder", tmp_path, kind=InputError):
        probe_video(tmp_path)
    import wave

    with wave.open(str(tmp_path / "sound.wav"), "wb") as file:
        file.setparams((1, 2, 48_000, 0, "NONE", ""))
        file.writeframes(bytes(9600))
    with refused("video-missing", "sound.wav", "audio", kind=InputError):
        probe_video(tmp_path / "sound.wav")


def test_reader_can_be_read_once(make_clip, pictures):
    with VideoReader(make_clip("a.mp4", pictures)) as reader:
        list(reader)
        with pytest.raises(ValueError, match="once"):
            list(reader)


def test_real_clips(data_dir):
    folder = data_dir / "pose2sim_single" / "videos"
    infos = [probe_video(folder / f"cam0{i}.mp4") for i in (1, 2, 3, 4)]
    assert [i.width for i in infos] == [1080, 1080, 1088, 1088]
    assert [i.codec for i in infos] == ["h264", "vp9", "h264", "h264"]
    assert [i.has_audio for i in infos] == [False, True, False, False]


@pytest.mark.parametrize(
    ("wish", "asked", "threads"), [("1", None, 1), ("1", 3, 3), ("1", 100, MOST_THREADS)]
)
def test_a_decoder_takes_the_cores_that_a_run_is_given(
    make_clip, pictures, monkeypatch, wish: str, asked: int | None, threads: int
) -> None:
    """By itself ffmpeg takes all of the machine's."""
    monkeypatch.setenv("OMP_NUM_THREADS", wish)
    path = make_clip("cam0.mp4", pictures)
    with open_media(path) as container:
        assert video_stream(container, path, asked).codec_context.thread_count == threads


def test_of_several_streams_of_pictures_the_largest(tmp_path):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as out:
        streams = [out.add_stream("libx264", rate=25) for _ in range(2)]
        for stream, side in zip(streams, (32, 64), strict=True):
            stream.width, stream.height, stream.pix_fmt = 2 * side, side, "yuv420p"
        for stream in streams:
            add_pictures(out, stream, [np.full((stream.height, stream.width, 3), 99, np.uint8)] * 5)
    info = probe_video(path)
    assert (info.width, info.height) == (128, 64) and any("64x32" in note for note in info.notes)
    assert scan_packets(path).count == 5


@pytest.mark.parametrize(("rotation", "aspect"), [(0, 4 / 3), (180, 4 / 3), (90, 3 / 4)])
def test_pixels_that_are_not_square(make_clip, pictures, tmp_path, rotation, aspect):
    path = make_clip("wide.mp4", pictures, rotation=rotation, pixel_aspect=Fraction(4, 3))
    info = probe_video(path)
    assert info.pixel_aspect == pytest.approx(aspect) and any("4:3" in note for note in info.notes)
    frames = extract_clip(path, tmp_path, "cam0", "camera", "wide.mp4", Keep()).frames
    assert frames.pixel_aspect == info.pixel_aspect and frames.upright == info.upright
    assert probe_video(make_clip("square.mp4", pictures)).pixel_aspect == 1
