"""Camera paths as nerfstudio writes them: axes, field of view, its own frame undone, what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.camera import Camera
from devrf.capture.formats.geometry.camera_path import read_camera_path
from devrf.capture.system.errors import InputError

POSE = np.array([[0.0, 0, 1, 2], [1, 0, 0, -1], [0, 1, 0, 0.5], [0, 0, 0, 1]])  # OpenGL, world from camera
USUAL = (320, 180)


def written(folder: Path, **values: Any) -> Path:
    entry = {"camera_to_world": POSE.reshape(-1).tolist(), "fov": 60, "aspect": 1.5}
    value = {"camera_path": [entry, {**entry, "fov": 50}], "fps": 12, "seconds": 2}
    value |= {"render_width": 300, "render_height": 200, "camera_type": "perspective", **values}
    path = folder / "camera_path.json"
    path.write_text(json.dumps({key: v for key, v in value.items() if v is not None}))
    return path


def same_view(camera: Camera) -> None:
    """It stands at (2, -1, 0.5) and looks along its pose's minus third column, which is (-1, 0, 0)."""
    np.testing.assert_allclose(camera.centre, POSE[:3, 3], atol=1e-9)
    middle = np.array([camera.width / 2, camera.height / 2])
    np.testing.assert_allclose(camera.directions(middle), -POSE[:3, 2], atol=1e-9)
    up = camera.project(POSE[:3, 3] - POSE[:3, 2] + 0.1 * POSE[:3, 1])
    assert up[1] < camera.height / 2  # the pose's second column points up in the picture


def test_pictures_of_a_path(tmp_path: Path) -> None:
    found = read_camera_path(written(tmp_path), None, USUAL)
    assert found.every_picture and found.fps == 12 and found.times is None and len(found.cameras) == 2
    camera = found.cameras[0]
    assert (camera.width, camera.height) == (300, 200)
    assert 2 * np.degrees(np.arctan(100 / camera.K[1, 1])) == pytest.approx(60)  # of the height
    same_view(camera)
    larger = read_camera_path(written(tmp_path), (600, 400), USUAL).cameras[0]
    assert larger.K[0, 0] == pytest.approx(2 * camera.K[0, 0])
    unnamed = read_camera_path(written(tmp_path, render_width=None), None, USUAL).cameras[0]
    assert (unnamed.width, unnamed.height) == USUAL


@pytest.mark.parametrize("text", [False, True])
def test_key_frames_with_times_of_old_and_new_viewers(tmp_path: Path, text: bool) -> None:
    """Old ones wrote text, column by column."""
    matrix = json.dumps(POSE.T.reshape(-1).tolist()) if text else POSE.reshape(-1).tolist()
    entries = [{"matrix": matrix, "fov": 40, "render_time": time} for time in (0.0, 0.75)]
    found = read_camera_path(written(tmp_path, camera_path=[], keyframes=entries, is_cycle=True), None, USUAL)
    assert not found.every_picture and found.closed and found.times == (0.0, 0.75) and found.seconds == 2
    same_view(found.cameras[1])


def test_the_frame_that_nerfstudio_trains_in_is_undone(tmp_path: Path) -> None:
    transform = np.array([[0.0, 1, 0, 3], [-1, 0, 0, 4], [0, 0, 1, 5]])
    own = np.vstack([transform, [0, 0, 0, 1]]) @ POSE
    own[:3, 3] *= 0.25
    entry = {"camera_to_world": own.reshape(-1).tolist(), "fov": 60}
    path = written(tmp_path, camera_path=[entry])
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps({"transform": transform.tolist(), "scale": 0.25})
    )
    same_view(read_camera_path(path, None, USUAL).cameras[0])
    (tmp_path / "dataparser_transforms.json").write_text('{"scale": 0}')
    with refused("file-damaged", "dataparser_transforms.json", kind=InputError):
        read_camera_path(path, None, USUAL)


@pytest.mark.parametrize(
    ("values", "refusal"),
    [
        ({"camera_path": []}, ("pictures-none", "camera_path", "keyframes")),
        ({"camera_path": "orbit"}, ("pictures-none", "camera_path", "keyframes")),
        ({"camera_path": [3]}, ("entry-wrong", "camera_path[0]: is 3", "camera_to_world")),
        ({"camera_path": [{"fov": 50}]}, ("entry-wrong", "camera_to_world is None", "16")),
        ({"camera_path": [{"camera_to_world": [1, 2], "fov": 50}]}, ("entry-wrong", "[1, 2]", "16")),
        ({"camera_path": [{"camera_to_world": [2.0] * 16, "fov": 50}]}, ("pose-not-rigid",)),
        ({"camera_path": [{"camera_to_world": POSE.tolist(), "fov": 180}]}, ("entry-wrong", "fov is 180")),
        (
            {"camera_path": [{"camera_to_world": POSE.tolist(), "fov": "wide"}]},
            ("entry-wrong", "fov is 'wide'"),
        ),
        (
            {"camera_path": [{"camera_to_world": POSE.tolist(), "render_time": t} for t in (0.5, 2)]},
            ("entry-wrong", "render_time is 2"),
        ),
        (
            {"camera_path": [{"camera_to_world": POSE.tolist(), "render_time": t} for t in (0.5, None)]},
            ("entry-missing", "render_time"),
        ),
        ({"camera_type": "equirectangular"}, ("lens-unread", "camera_type is equirectangular")),
        ({"fps": "fast"}, ("entry-wrong", "fps is 'fast'")),
    ],
)
def test_what_is_no_path_is_refused(tmp_path: Path, values: dict, refusal: tuple) -> None:
    with refused(*refusal, kind=InputError):
        read_camera_path(written(tmp_path, **values), None, USUAL)


def test_what_is_no_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    path.write_text("{")
    with refused("file-damaged", path, kind=InputError):
        read_camera_path(path, None, USUAL)
