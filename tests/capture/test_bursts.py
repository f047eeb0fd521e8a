"""Near-doubles of one burst are held out whole or not at all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from devrf.capture.bursts import bursts, held_out
from devrf.capture.camera import Camera
from devrf.capture.exif import read_exif
from devrf.capture.formats.parts.assembly import hold_out
from devrf.capture.scene import PosedFrame
from devrf.capture.view_axes import look_at

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def around(*turns_deg: float, radius: float = 2.0) -> list[Camera]:
    """Cameras that look at the middle from all around."""
    angles = np.radians(turns_deg)
    centres = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    return [Camera(640, 480, K, look_at(centre, np.zeros(3)), np.zeros(5)) for centre in centres]


RING = tuple(range(0, 360, 15))


@pytest.mark.parametrize(
    ("turns_deg", "taken_s", "found"),
    [
        (RING, (), []),
        (tuple(np.arange(0, 360, 1.2)), (), []),  # a dense sweep
        ((*RING, 0.2), (), [[0, 24]]),  # another one from the first place
        (RING, tuple(float(3 * n) for n in range(24)), []),
        # three photos in a second on the way
        ((*RING, 47, 49), (*(float(3 * n) for n in range(24)), 9.4, 10.3), [[3, 24, 25]]),
        ((*RING, 187, 189), (*(float(3 * n) for n in range(24)), 9.4, 10.3), [[24, 25]]),  # by two people
        ((*RING, 47, 49), (*(0.8 * n for n in range(24)), 2.5, 2.6), []),  # all in haste: time tells nothing
        ((*RING, 47, 49), (None,) * 26, []),
    ],
)
def test_what_a_burst_is(
    turns_deg: tuple[float, ...], taken_s: tuple[float | None, ...], found: list[list[int]]
) -> None:
    assert bursts(around(*turns_deg), taken_s) == found


def test_a_slow_walk_is_no_burst() -> None:
    """A step of half of what counts as one place: two or three pictures each, not one chain of all."""
    groups = bursts(around(*np.arange(0, 360, 0.3)))
    assert max(map(len, groups)) <= 4


def test_a_burst_is_held_out_whole_or_not_at_all() -> None:
    assert np.flatnonzero(held_out(20, 8)).tolist() == [0, 8, 16]
    found = [[0, 1, 2], [9, 10], [11, 15]]
    held = held_out(20, 8, found)
    assert all(len({bool(held[n]) for n in members}) == 1 for members in found)
    assert np.flatnonzero(held).tolist() == [0, 1, 2, 11, 15]


def test_pictures_of_a_data_set_too() -> None:
    frame = PosedFrame(Path("0.png"), around(0)[0], "static", 0, None, None, "train")
    frames = tuple(replace(frame, camera=camera) for camera in around(0, 0.1, *range(15, 180, 15)))
    notes: list[str] = []
    assert [f.split for f in hold_out(frames, 8, 0, notes)][:3] == ["test", "test", "train"]
    assert len(notes) == 1 and "1 bursts" in notes[0]


def test_when_a_photo_was_taken(tmp_path: Path) -> None:
    tags = Image.Exif()
    own = tags.get_ifd(ExifTags.IFD.Exif)
    own[ExifTags.Base.DateTimeOriginal], own[ExifTags.Base.SubsecTimeOriginal] = "2026:11:28 10:00:01", "25"
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=tags)
    own[ExifTags.Base.DateTimeOriginal] = "0000:00:00 00:00:00"  # of a device without a clock
    Image.new("RGB", (8, 8)).save(tmp_path / "b.jpg", exif=tags)
    with Image.open(tmp_path / "a.jpg") as a, Image.open(tmp_path / "b.jpg") as b:
        taken_s = read_exif(a).taken_s
        assert taken_s is not None and taken_s % 60 == 1.25 and read_exif(b).taken_s is None
