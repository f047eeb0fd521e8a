"""Clips whose fields are coded as pictures."""

import numpy as np
import pytest
from tests.make.clips import film

from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.video.interlaced import SecondFields
from devrf.capture.video.packets import scan_packets
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.sampled import picture_times


def test_two_fields_are_one_picture(crew_files, tmp_path):
    path = crew_files / "field-pictures" / "cam0.mts"
    with VideoReader(path) as reader:
        decoded = [(frame.index, frame.time_s) for frame in reader]
    times = picture_times(path)
    assert [n for n, _ in decoded] == list(range(25)) and scan_packets(path).count == 25
    np.testing.assert_allclose(times, [t for _, t in decoded], atol=1e-9)
    with VideoReader(path, from_s=0.5) as reader:
        assert [frame.index for frame in reader] == list(range(13, 25))
    got = extract_clip(path, tmp_path, "cam0", "sweep", "cam0.mts", Keep(most=5)).frames
    assert len(got.used) == 5 and got.fps_mean == pytest.approx(25)


@pytest.mark.parametrize(
    ("codec", "name", "options"),
    [
        ("libx264", "a.mp4", {}),
        ("libx264", "a.ts", {"x264-params": "interlaced=1"}),  # frames of which each macroblock chooses
        ("libx264", "a.mp4", {"x264-params": "interlaced=1:cqm=jvt"}),  # with scaling lists
        ("mpeg2video", "a.mpg", {"flags": "+ildct+ilme"}),  # both fields in a packet
    ],
)
def test_frames_of_interlaced_clips_are_counted_as_they_are(tmp_path, codec, name, options):
    pictures = np.random.default_rng(0).integers(0, 255, (12, 64, 96, 3), np.uint8)
    path = film(tmp_path / name, list(pictures), codec, **options)
    assert scan_packets(path).count == 12


def mpeg2(number: int, structure: int) -> bytes:
    """Headers of an MPEG-2 picture: 1 is a top field, 2 a bottom field, 3 both."""
    head = b"\0\0\1\0" + bytes([number >> 2, (number & 3) << 6 | 8, 0, 0])
    return head + b"\0\0\1\xb5" + bytes([0x81, 0x11, 0x10 | structure, 0, 0]) + bytes(20)


def test_fields_of_mpeg2():
    fields = SecondFields("mpeg2video", None)
    packets = [mpeg2(0, 1), mpeg2(0, 2), mpeg2(3, 2), mpeg2(3, 1), mpeg2(1, 3), mpeg2(2, 1), b"", mpeg2(2, 2)]
    assert [fields.second(p) for p in packets] == [False, True, False, True, False, False, False, False]


def test_other_codecs_and_damaged_headers_have_no_fields():
    assert not SecondFields("hevc", None).possible
    assert not SecondFields("h264", None).possible and not SecondFields("h264", b"\1\0\0").possible
    assert not SecondFields("h264", b"\0\0\1\x67").second(b"\0\0\1\x65")
    assert not SecondFields("h264", bytes([1, 77, 0, 30, 255, 225, 0, 200, 0x67])).second(b"\0\0\0\5\x65")
