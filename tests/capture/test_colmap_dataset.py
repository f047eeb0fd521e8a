"""COLMAP's text models, written here by hand; binary ones are in test_export.py."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.errors import CaptureError
from devrf.capture.formats import read_dataset

POSES = ("1 0 0 0 0.1 0.2 3", "0.9238795325112867 0 0.3826834323650898 0 0 0 3", "2 0 0 0 -1 0 3")


def colmap_text(folder: Path, camera: str) -> None:
    """Three pictures, two points seen by all and one by two; one line of keypoints is empty."""
    model = folder / "sparse"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"# Camera list\n7 {camera}\n")
    lines = ["# Image list"]
    for n, pose in enumerate(POSES):
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "images" / f"a {n}.png"), np.full((32, 48, 3), 100, np.uint8))
        lines += [f"{n + 3} {pose} 7 a {n}.png", "" if n == 2 else "1.5 2.5 11 3.5 4.5 -1"]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text(
        "11 0 0 1 9 9 9 0.5 3 0 4 0 5 0\n12 0.1 0 1 9 9 9 5.0 3 0 4 0 5 0\n"
        "13 0 0.5 1 9 9 9 0.5 3 0 4 0\n14 0 1 2 9 9 9 0.1 5 0 4 1 3 1\n"
    )


@pytest.mark.parametrize(
    ("camera", "K", "lens"),
    [
        ("SIMPLE_PINHOLE 48 32 40 23 15", [40, 40, 23, 15], [0, 0, 0, 0, 0]),
        ("PINHOLE 48 32 40 41 23 15", [40, 41, 23, 15], [0, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL 48 32 40 23 15 0.1", [40, 40, 23, 15], [0.1, 0, 0, 0, 0]),
        ("RADIAL 48 32 40 23 15 0.1 0.2", [40, 40, 23, 15], [0.1, 0.2, 0, 0, 0]),
        ("OPENCV 48 32 40 41 23 15 .1 .2 .3 .4", [40, 41, 23, 15], [0.1, 0.2, 0.3, 0.4, 0]),
        ("FULL_OPENCV 48 32 40 41 23 15 .1 .2 .3 .4 .5 0 0 0", [40, 41, 23, 15], [0.1, 0.2, 0.3, 0.4, 0.5]),
    ],
)
def test_colmap_text(tmp_path: Path, camera, K, lens):
    colmap_text(tmp_path, camera)
    scene = read_dataset("colmap", tmp_path, holdout_every=2)
    assert [(f.path.name, f.split) for f in scene.static] == [
        ("a 0.png", "test"),
        ("a 1.png", "train"),
        ("a 2.png", "test"),
    ]
    camera = scene.static[1].camera
    assert [camera.K[0, 0], camera.K[1, 1], *camera.K[:2, 2]] == K
    np.testing.assert_array_equal(camera.distortion, lens)
    np.testing.assert_allclose(camera.cam_from_world[0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-12)
    np.testing.assert_allclose(scene.static[2].camera.centre, [1, 0, -3])  # its quaternion had length 2
    assert scene.points is not None  # one point has too large an error, one is seen twice only
    np.testing.assert_array_equal(scene.points.xyz, [[0, 0, 1], [0, 1, 2]])
    assert scene.points.obs_frame.tolist() == [0, 1, 2, 0, 1, 2]


def test_colmap_lenses_that_are_not_read_are_named(tmp_path: Path):
    colmap_text(tmp_path, "FOV 48 32 40 41 23 15 .1")
    with refused("lens-unread", "FOV", kind=CaptureError):
        read_dataset("colmap", tmp_path)
