"""Folders of photos as cameras and cards lay them, and what of them is not read."""

from pathlib import Path

import pytest
from PIL import Image
from tests.refused import refused

from devrf.capture.photos.photo_folders import list_pictures, unread_faults, unread_kinds
from devrf.capture.photos.upright_pictures import probe_picture, read_picture


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_what_is_not_read_is_counted_by_kind(tmp_path):
    touch(tmp_path, "a.jpg", "b.JFIF", "c.heic", "d.HEIC", "e.jxl", "f.avif", "a.heic", ".g.heic")
    assert [p.name for p in list_pictures(tmp_path)] == ["a.jpg", "b.JFIF"]
    kinds = {kind: [p.name for p in files] for kind, files in unread_kinds(tmp_path).items()}
    # a.heic is there as JPEG
    assert kinds == {"HEIC": ["c.heic", "d.HEIC"], "JPEG XL": ["e.jxl"], "AVIF": ["f.avif"]}
    (fault,) = unread_faults(tmp_path)
    assert all(word in str(fault.value) for word in ("4 beside 2", "2 HEIC", "1 JPEG XL", "c.heic"))


def test_a_photo_that_is_there_as_raw_and_as_jpeg_is_one(tmp_path):
    """Cameras write both; the RAW file is developed, the picture beside it is neither a second view nor unread."""
    touch(tmp_path, "a.JPG", "a.DNG", "b.jpg", "c.nef", "c.heic", "d.HIF", "d.ARW")
    assert [p.name for p in list_pictures(tmp_path)] == ["a.DNG", "b.jpg", "c.nef", "d.ARW"]
    assert unread_faults(tmp_path) == []


def test_folders_of_a_card_are_one(tmp_path):
    touch(tmp_path, "100CANON/IMG_0099.JPG", "101CANON/IMG_0001.JPG", "101CANON/IMG_0002.HEIC", "MISC/x.jpg")
    assert [p.name for p in list_pictures(tmp_path)] == ["IMG_0099.JPG", "IMG_0001.JPG"]
    assert [str(f.value).split(": ")[1][0] for f in unread_faults(tmp_path)] == ["1", "1"]  # HEIC; MISC


def test_photos_in_folders_inside_are_said(tmp_path):
    touch(tmp_path, "a.jpg", "more/b.jpg", "more/c.jpg")
    (fault,) = unread_faults(tmp_path)
    assert "2 in more" in str(fault.value) and list_pictures(tmp_path) == [tmp_path / "a.jpg"]


def test_a_folder_of_folders_names_them_with_their_photos(tmp_path):
    touch(tmp_path, "day1/a.jpg", "day1/b.jpg", "DCIM/100CANON/c.jpg", "notes/d.txt")
    with refused("pictures-inside", str(tmp_path), "1 in DCIM", "2 in day1"):
        list_pictures(tmp_path)


def test_a_folder_of_clips_names_them(tmp_path):
    touch(tmp_path, "a.MP4")
    with refused("pictures-none", "1 clip", f"{tmp_path.name}/a.MP4"):
        list_pictures(tmp_path)
    touch(tmp_path, "b.mov")
    with refused("pictures-none", "2 clips", "a.MP4, b.mov", "ffmpeg -i a.MP4 -vf fps=2"):
        list_pictures(tmp_path)


def test_a_folder_of_what_is_not_read(tmp_path):
    touch(tmp_path, "a.heic", "b.jxl")
    with refused("picture-kind-unread", "1 HEIC", "1 JPEG XL", "JPEG"):
        list_pictures(tmp_path)


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"\0\0\0\x18ftypheic", "HEIC"),
        (b"\xff\x0a", "JPEG XL"),
        (b"\0\0\0\x0cJXL \r\n", "JPEG XL"),
        (b"\0\0\0\x1cftypavif", "AVIF"),
    ],
)
def test_another_kind_under_the_name_of_a_jpeg(tmp_path, head, kind):
    path = tmp_path / "a.jpg"
    path.write_bytes(head + bytes(64))
    with refused("picture-kind-unread", path, kind, "JPEG"):
        probe_picture(path)


def test_jpeg_under_another_ending(tmp_path):
    Image.new("RGB", (8, 6), (200, 0, 0)).save(tmp_path / "a.jfif", format="JPEG")
    assert read_picture(tmp_path / "a.jfif").shape == (6, 8, 3)
