"""Clips as crews bring them home: each fault is made, found, and named with its place and a remedy."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.ingest.extract_clip import Extract, Keep, extract_clip
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.video.reader import VideoReader

SIZE = (320, 240)


def scenery(seed: int = 0, margin: int = 40) -> np.ndarray:
    """A textured wall, larger than the picture."""
    rng = np.random.default_rng(seed)
    width, height = SIZE[0] + 2 * margin, SIZE[1] + 2 * margin
    picture = np.zeros((height, width, 3), np.float32)
    for cells in (10, 30, 80):
        colours = rng.random((cells, cells, 3)).astype(np.float32)
        picture += cv2.resize(colours, (width, height), interpolation=cv2.INTER_CUBIC)
    picture -= picture.min()
    return (40 + 170 * picture / picture.max()).astype(np.uint8)


def view(wall: np.ndarray, n: int, shift: float = 0.0, zoom: float = 1.0, subject: bool = True) -> np.ndarray:
    """What a camera before the wall sees in frame n: a disc that moves, and its own shift and zoom about the middle."""
    height, width = wall.shape[:2]
    middle = np.array([width / 2, height / 2])
    offset = np.array(SIZE) / 2 - zoom * middle + [shift, 0]
    matrix = np.array([[zoom, 0, offset[0]], [0, zoom, offset[1]]])
    picture = cv2.warpAffine(wall, matrix, SIZE, flags=cv2.INTER_CUBIC)
    if subject:
        cv2.circle(picture, (60 + 6 * (n % 30), 120), 30, (250, 240, 30), -1)
    return picture


def extract(path: Path, out: Path, keep: Keep | None = None) -> Extract:
    return extract_clip(path, out, path.stem, "camera", path.name, keep or Keep())


def found(got: Extract) -> dict[str, str]:
    """Why -> what was found; without the bit rate, because drawn pictures in which little moves need few bits."""
    return {fault.why: str(fault.value) for fault in got.frames.faults if fault.why != "bits"}


def test_a_healthy_clip_has_no_faults(make_clip, tmp_path):
    wall = scenery()
    rng = np.random.default_rng(3)  # noise of a sensor, two levels
    pictures = [np.clip(view(wall, n) + rng.normal(0, 2, (240, 320, 1)), 0, 255) for n in range(60)]
    got = extract(make_clip("a.mp4", [p.astype(np.uint8) for p in pictures]), tmp_path)
    assert got.frames.faults == () and got.frames.notes == () and len(got.frames.used) == 60


# --- A4: doubled frames ---


def test_repeated_frames_are_left_out_and_their_times_kept(make_clip, tmp_path):
    wall = scenery()
    shown = [0, 1, 2, 3, 3, 5, 6, 7, 7, 7, 10, 11, 12, 13, 14]
    got = extract(make_clip("a.mp4", [view(wall, n) for n in shown]), tmp_path)
    left_out = [f for f in got.frames.frames if not f.used]
    assert [f.index for f in left_out] == [4, 8, 9] and all(f.file is None for f in left_out)
    assert [f.time_s for f in left_out] == pytest.approx([4 / 25, 8 / 25, 9 / 25])
    assert len(list((tmp_path / "frames/a").iterdir())) == len(shown) - 3
    assert found(got) == {"repeated": "3 of 15 frames repeat the one before: 4, 8, 9; they are not used"}


def test_a_scene_at_rest_repeats_nothing(make_clip, tmp_path):
    """Where nothing moves, pictures are alike and all of them are true; motion begins and ends with such."""
    wall = scenery()
    shown = [0] * 8 + list(range(10)) + [10] * 8
    got = extract(make_clip("a.mp4", [view(wall, n) for n in shown]), tmp_path)
    assert len(got.frames.used) == len(shown) and found(got) == {}


# --- A5, A6: stabilisation, tripod, zoom, focus ---


@pytest.mark.parametrize("shift, zoom, check", [(1.5, 1.0, "shift"), (0.0, 1.004, "zoom")])
def test_a_fixed_camera_whose_picture_moves(make_clip, tmp_path, shift, zoom, check):
    wall = scenery()
    still, moved = range(55), range(55, 80)
    pictures = [view(wall, n) for n in still] + [view(wall, n, shift, zoom) for n in moved]
    got = extract(make_clip("a.mp4", pictures), tmp_path)
    # 1.5 px and 0.4 % as made; followed corners are good to 0.1 px, so to 0.1 % over half the picture and more.
    words = {"shift": ("up to 1.", "px, at 3.0 s"), "zoom": ("up to 0.4", "%, at 3.0 s")}[check]
    assert list(found(got)) == [check] and all(w in found(got)[check] for w in words), found(got)


def test_a_sweep_may_move(make_clip, tmp_path):
    wall = scenery()
    path = make_clip("a.mp4", [view(wall, n, 0.5 * n, subject=False) for n in range(60)])
    assert found(extract_clip(path, tmp_path, "static", "sweep", "a.mp4", Keep(most=5))) == {}


# --- A12: sizes that change within a clip; A24: damage ---


def film_of_two_sizes(path: Path, first: list[np.ndarray], second: list[np.ndarray]) -> Path:
    """One stream, 25 pictures a second, in which the second pictures follow the first."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = first[0].shape[1::-1]
        other = av.CodecContext.create("libx264", "w")
        assert isinstance(other, av.VideoCodecContext)
        other.width, other.height = second[0].shape[1::-1]
        other.pix_fmt, other.time_base, other.framerate = "yuv420p", Fraction(1, 25), Fraction(25)
        n = 0
        for coder, pictures in ((stream.codec_context, first), (other, second)):
            coder.options = {"tune": "zerolatency"}  # no picture waits for a later one
            for picture in [*pictures, None]:
                frame = None if picture is None else av.VideoFrame.from_ndarray(picture, format="rgb24")
                if frame is not None:
                    frame.pts, frame.time_base, n = n, Fraction(1, 25), n + 1
                for packet in coder.encode(frame):
                    packet.stream = stream
                    container.mux(packet)
    return path


def test_a_clip_that_changes_its_size(make_clip, tmp_path):
    wall = scenery()
    large = [view(wall, n) for n in range(10)]
    small = [cv2.resize(view(wall, n), (160, 120)) for n in range(10, 16)]
    got = extract(film_of_two_sizes(tmp_path / "both.ts", large, small), tmp_path)
    assert (got.frames.width, got.frames.height) == SIZE
    assert {f.used for f in got.frames.frames[:9]} == {True} and len(got.frames.used) == 10
    text = found(got)["size"]
    assert all(named in text for named in ("6 frames", "10 at 0.40 s", "160x120", "320x240"))


def damaged(path: Path, at: float, count: int, seed: int = 2) -> Path:
    """Overwrite bytes of the pictures' data; the index, in front, stays whole."""
    data = bytearray(path.read_bytes())
    start = int(at * len(data))
    noise = np.random.default_rng(seed).integers(0, 255, count).astype(np.uint8)
    data[start : start + count] = noise.tobytes()
    path.write_bytes(data)
    return path


def test_damaged_frames_and_those_made_of_them_are_left_out(make_clip, tmp_path):
    rng = np.random.default_rng(5)
    pictures = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(40)]
    for at in np.linspace(0.3, 0.8, 12):  # some damage ends a clip, some cannot be seen
        path = damaged(make_clip("a.mp4", pictures, faststart=True), float(at), 300)
        with VideoReader(path) as reader:
            marked = [f.index for f in reader if f.damaged]
        got = extract(path, tmp_path)
        used = {f.index for f in got.frames.used}
        if not marked:
            continue
        with VideoReader(path) as reader:
            keys = [f.index for f in reader if f.picture.key_frame and f.index > marked[0]]
        after = min(keys, default=len(got.frames.frames))
        assert not used & set(range(marked[0], after)) and marked[0] - 1 in used
        assert f"{marked[0]} at {marked[0] / 25:.2f} s" in found(got)["damaged"]
        assert got.frames.missing_frames == 0
        return
    pytest.fail("no damage that the decoder marks was made")


# --- A19, A23: levels and bits ---


@pytest.mark.parametrize("levels, says", [(2, 1), (1, 2), (1, 1), (2, 2)])
def test_a_range_that_contradicts_its_flag(make_clip, tmp_path, levels, says):
    ramp = np.repeat(np.linspace(0, 255, SIZE[0] // 16).astype(np.uint8), 16)[None, :, None]
    ramp = np.tile(ramp, (SIZE[1], 1, 3))
    path = make_clip("a.mp4", [ramp] * 30, colour=(1, 1, 1, levels), flagged=says, crf=1)
    faults = found(extract(path, tmp_path))
    assert ("range" in faults) == (levels != says)
    if levels != says:
        assert ("0 to 255" if levels == 2 else "16 and 235") in faults["range"]


@pytest.mark.parametrize(
    "transfer, says", [(1, None), (13, None), (8, "linear"), (9, "logarithmic")]
)  # H.273
def test_levels_of_another_curve(make_clip, tmp_path, transfer, says):
    """A17: BT.709 and sRGB are what is expected."""
    wall = scenery()
    path = make_clip("a.mp4", [view(wall, n) for n in range(30)], colour=(1, transfer, 1, 1))
    text = found(extract(path, tmp_path)).get("curve")
    assert text is None if says is None else text is not None and says in text and "sRGB" in text


def test_too_few_bits(make_clip, tmp_path):
    wall = scenery()
    got = extract(make_clip("a.mp4", [view(wall, n) for n in range(40)], crf=45), tmp_path)
    text = next(str(fault.value) for fault in got.frames.faults if fault.why == "bits")
    assert "(h264)" in text and "0.050" in text and float(text.split()[0]) < 0.05


# --- A2: seeking; long clips ---


def coded(path: Path, codec: str, options: dict[str, str], hidden: int = 0) -> Path:
    """Forty pictures, the first `hidden` of them hidden by an edit list, as where a phone trims a clip.

    25 a second, and every tenth time without a picture; an AVI has no times to tell that by.
    """
    wall = scenery()
    skip = 40 if path.suffix == ".avi" else 9
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled"} if hidden else {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = options
        for n in range(41):
            frame = None if n == 40 else av.VideoFrame.from_ndarray(view(wall, n), format="rgb24")
            if frame is not None:
                frame.pts, frame.time_base = n + n // skip, Fraction(1, 25)
            for packet in stream.encode(frame):
                assert packet.pts is not None and packet.dts is not None and packet.time_base is not None
                ticks = round((hidden + hidden // skip) / 25 / packet.time_base)
                packet.pts, packet.dts = packet.pts - ticks, packet.dts - ticks
                container.mux(packet)
    return path


OPEN_264 = {"x264-params": "open-gop=1:bframes=3:keyint=10:scenecut=0"}
OPEN_265 = {"x265-params": "open-gop=1:bframes=3:keyint=10:log-level=none"}
INTRA_REFRESH = {"x264-params": "intra-refresh=1:keyint=10"}


@pytest.mark.parametrize(
    "name, codec, options, hidden",
    [
        ("closed.mkv", "libx264", {"g": "10"}, 0),
        ("open.mp4", "libx264", OPEN_264, 0),
        ("open.ts", "libx264", OPEN_264, 0),
        ("open265.mp4", "libx265", OPEN_265, 0),
        ("refresh.mp4", "libx264", INTRA_REFRESH, 0),
        ("trimmed.mp4", "libx264", OPEN_264, 13),
        ("program.mpg", "mpeg2video", {"g": "10", "bf": "2"}, 0),
        ("old.avi", "libx264", {"g": "10"}, 0),
    ],
)
def test_reading_from_a_time_gives_the_same_frames(tmp_path, name, codec, options, hidden):
    """Key pictures before which others are shown, none at all, and such that are hidden: all as by reading all."""
    path = coded(tmp_path / name, codec, options, hidden)
    with VideoReader(path) as reader:
        whole = [(f.index, f.time_s, f.bgr) for f in reader]
    steps = np.diff([f[1] for f in whole])
    assert len(whole) == 40 - hidden and set(np.round(25 * steps, 2)) <= {1, 2}
    for from_s in (-1.0, *(whole[n][1] - 1e-4 for n in (0, 7, 9, 10, 11, 26)), 99.0):
        with VideoReader(path, from_s) as reader:
            jumped = reader.decoded
            part = [(f.index, f.time_s, f.bgr) for f in reader]
        assert options == INTRA_REFRESH or name == "old.avi" or from_s < 1 or jumped > 0
        expected = [f for f in whole if f[1] >= from_s]
        assert [f[:2] for f in part] == [f[:2] for f in expected], (name, from_s)
        assert all(np.array_equal(a[2], b[2]) for a, b in zip(part, expected, strict=True))


def test_a_range_is_jumped_to_and_nothing_else_is_decoded(make_clip, tmp_path):
    wall = scenery()
    path = make_clip("a.mp4", [view(wall, n) for n in range(60)])
    span = (1.0, 1.4)
    whole = extract(path, tmp_path / "whole", Keep(range_s=span))
    part = extract(path, tmp_path / "part", Keep(range_s=span, only_range=True))
    assert [(f.index, f.time_s, f.file) for f in part.frames.used] == [
        (f.index, f.time_s, f.file) for f in whole.frames.used
    ]
    for frame in part.frames.used:
        files = [(tmp_path / kind / str(frame.file)).read_bytes() for kind in ("whole", "part")]
        assert files[0] == files[1]
    assert len(whole.frames.frames) == 60 and len(part.frames.frames) == len(part.frames.used) == 11
    with refused("range-empty", "a.mp4", "7.00 and 8.00 s", "2.40 s"):
        extract(path, tmp_path / "none", Keep(range_s=(7.0, 8.0), only_range=True))


# --- A25: names ---


@pytest.mark.parametrize(
    "names, notes",
    [
        (["f1", "f2", "f10"], ["f1.png to f10.png"]),
        ([f"IMG_{n:04d}" for n in (7, 8, 9, 11, 12, 14)], ["between 7 and 14: 10, 13"]),
        ([f"{n:03d}" for n in range(5)], []),
        (["a", "b", "c"], []),
        (["00100", "00200", "00300"], []),
    ],
)
def test_numbers_in_names(tmp_path, names, notes):
    folder = tmp_path / "in"
    folder.mkdir()
    for name in names:
        write_picture(folder / f"{name}.png", np.zeros((8, 8, 3), np.uint8))
    got = extract_folder(folder, tmp_path, "static", "sweep", "in").notes
    assert len(got) == len(notes) and all(n in g for n, g in zip(notes, got, strict=True)), got
