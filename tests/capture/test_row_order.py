"""Rows of poses and pictures whose names sort in two ways: where pictures can tell, they decide."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from devrf.capture.formats import read_dataset
from devrf.capture.photos.picture_files import natural_key


@pytest.fixture
def unpadded(crew_files: Path, tmp_path: Path) -> Path:
    """Fourteen rendered pictures, 1.jpg to 14.jpg, with rows by the code points of their names."""
    source = crew_files.parent / "formats/llff-row-order/unpadded"
    return shutil.copytree(source, tmp_path / "set")


@pytest.mark.parametrize("numbered", [False, True])
def test_what_pictures_share_decides(unpadded: Path, numbered: bool) -> None:
    right = read_dataset("llff", unpadded, notes=[])
    cameras = {frame.path.name: frame.camera.cam_from_world for frame in right.static}
    if numbered:
        table, names = np.load(unpadded / "poses_bounds.npy"), sorted(cameras)
        rows = [names.index(name) for name in sorted(names, key=natural_key)]
        np.save(unpadded / "poses_bounds.npy", table[rows])
    notes: list[str] = []
    for frame in read_dataset("llff", unpadded, notes=notes).static:
        np.testing.assert_array_equal(frame.camera.cam_from_world, cameras[frame.path.name])
    said = [note for note in notes if "order" in note]
    assert len(said) == 1 and ("1.jpg, 2.jpg" in said[0]) == numbered and "share" in said[0]


def test_pictures_that_share_nothing_leave_it_to_the_usual_tool(unpadded: Path) -> None:
    one = (unpadded / "images/1.jpg").read_bytes()
    for path in unpadded.glob("images/*.jpg"):
        path.write_bytes(one)
    notes: list[str] = []
    first = read_dataset("llff", unpadded, notes=notes).static[1].path.name
    assert first == "10.jpg" and not any("share" in note for note in notes)
