"""Photos that lie in a folder twice."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from devrf.capture.frames import CameraFrames, Role
from devrf.capture.photos.extract import extract_folder


def scene(n: int) -> Image.Image:
    """A view of something with texture, a little further on with each number."""
    y, x = np.mgrid[0:384, 0:576].astype(float)
    waves = [np.sin((x + 16 * n) / (28 + 4 * c)) + np.sin((y + 4 * n) / (20 + 4 * c)) for c in range(3)]
    return Image.fromarray(np.clip(128 + 50 * np.stack(waves, -1), 0, 255).astype(np.uint8))


def extracted(folder: Path, role: Role = "sweep") -> tuple[CameraFrames, list[str | None]]:
    frames = extract_folder(folder, folder.parent / "out", "static", role, "in")
    assert all((folder.parent / "out" / f.file).is_file() == f.used for f in frames.frames if f.file)
    return frames, [f.photo for f in frames.used]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four photos, one of them twice to the byte, one coded anew, one as a messenger makes it smaller."""
    (tmp_path / "in").mkdir()
    for n in range(4):
        scene(n).save(tmp_path / "in" / f"IMG_{n}.jpg", quality=90)
    (tmp_path / "in" / "Copy of IMG_0.jpg").write_bytes((tmp_path / "in" / "IMG_0.jpg").read_bytes())
    with Image.open(tmp_path / "in" / "IMG_1.jpg") as one, Image.open(tmp_path / "in" / "IMG_2.jpg") as two:
        one.save(tmp_path / "in" / "IMG_1(1).jpg", quality=75)
        two.resize((288, 192), Image.Resampling.BOX).save(tmp_path / "in" / "A2.jpg", quality=80)
    return tmp_path / "in"


def test_each_picture_is_used_once(folder: Path) -> None:
    frames, used = extracted(folder)
    assert used == [f"IMG_{n}.jpg" for n in range(4)]
    (note,) = (note for note in frames.notes if "copies" in note)
    assert all(name in note for name in ("3 of 7", "Copy of IMG_0.jpg of IMG_0.jpg", "A2.jpg of IMG_2.jpg"))
    assert not any("mixed sizes" in note for note in frames.notes)


def test_pictures_that_only_look_alike_are_all_used(folder: Path) -> None:
    """Neighbours of a burst; photos that show nothing; photos of a camera that stands, which count by number."""
    for file in folder.iterdir():
        file.unlink()
    scene(0).save(folder / "a.jpg")
    scene(0).transform((576, 384), Image.Transform.AFFINE, (1, 0, 4, 0, 1, 0)).save(folder / "b.jpg")
    for name in ("c.png", "d.png"):
        Image.new("RGB", (576, 384), (30, 30, 30)).save(folder / name)
    frames, used = extracted(folder)
    assert len(used) == 4 and not any("copies" in note for note in frames.notes)
    scene(0).save(folder / "e.jpg")
    assert len(extracted(folder, "camera")[1]) == 5 and len(extracted(folder)[1]) == 4
