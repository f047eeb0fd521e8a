"""Which files of a card belong to one recording."""

from datetime import datetime, timezone
from pathlib import Path

import av
import numpy as np
import pytest
from tests.make.clips import add_pictures

from devrf.capture.ingest.recordings import chapter_faults, chapters, is_of_photo, join_command, small_copy_of


def named(folder: Path, *names: str) -> list[Path]:
    for name in names:
        (folder / name).touch()
    return [folder / name for name in names]


@pytest.mark.parametrize(
    "names",
    [
        ("GX010012.MP4", "GX020012.MP4", "GX030012.MP4"),
        ("GOPR0042.MP4", "GP010042.MP4"),
        ("gh010007.mp4", "gh020007.mp4"),
    ],
)
def test_chapters_by_their_names(tmp_path, names):
    parts = named(tmp_path, *names)
    named(tmp_path, "GX010013.MP4", "GOPR0043.MP4", names[0].replace("MP4", "LRV").replace("mp4", "lrv"))
    for part in parts:
        assert chapters(part) == parts
    (fault,) = chapter_faults(parts[0])
    assert names[1] in str(fault.value) and fault.facts["command"] == join_command(parts)


def recording(path: Path, start_s: float, pictures: int) -> Path:
    """A clip of 25 pictures a second that says when it was made."""
    made = datetime.fromtimestamp(1.7e9 + start_s, timezone.utc).isoformat()
    with av.open(str(path), "w") as out:
        out.metadata["creation_time"] = made
        stream = out.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        add_pictures(out, stream, np.zeros((pictures, 48, 64, 3), np.uint8))
    return path


def test_cameras_that_somebody_numbered_are_no_chapters(tmp_path):
    parts = [recording(tmp_path / "cam1.mp4", 0.0, 100), recording(tmp_path / "cam2.mp4", 4.0, 25)]
    for part in parts:
        assert chapters(part) == [part]


@pytest.mark.parametrize(
    "names",
    [
        ("C0001.MP4", "C0002.MP4"),
        ("MVI_0009.MP4", "MVI_0010.MP4"),
        ("DJI_0003.MP4", "DJI_0004.MP4"),
        ("DJI_20240512143000_0003_D.MP4", "DJI_20240512143004_0004_D.MP4"),
        ("00000.MP4", "00001.MP4"),
    ],
)
def test_chapters_that_count_on_where_one_begins_as_the_other_ends(tmp_path, names):
    parts = [recording(tmp_path / names[0], 0.0, 100), recording(tmp_path / names[1], 4.0, 25)]
    assert chapters(parts[0]) == chapters(parts[1]) == parts
    recording(parts[1], 9.0, 25)  # filmed later
    assert chapters(parts[0]) == [parts[0]] and chapter_faults(parts[1]) == []


def test_small_copies_and_clips_of_photos():
    card = Path("card")
    clip = card / "CLIP" / "C0001.MP4"
    others = [clip, card / "CLIP" / "C0002.MP4", Path("cam1") / "C0001.MP4"]
    assert small_copy_of(card / "SUB" / "C0001S03.MP4", others) == clip
    assert small_copy_of(card / "CLIP" / "proxy" / "C0001.MP4", others) == clip
    assert small_copy_of(card / "CLIP" / "C0001_Proxy.mov", others) == clip
    assert small_copy_of(clip, others) is None and small_copy_of(others[2], others) is None
    photo = card / "IMG_1.HEIC"
    assert is_of_photo(card / "IMG_1.MOV", [photo], 2.9)
    assert not is_of_photo(card / "IMG_1.MOV", [photo], 20.0)
    assert not is_of_photo(Path("IMG_1.MOV"), [photo], 2.9)
