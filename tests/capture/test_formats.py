"""Scenes written and read back, and data sets of other programs."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.make.scenes import scene_of
from tests.refused import refused

from devrf.capture.camera import Camera
from devrf.capture.formats import FLIP_YZ, read_dataset, read_scene, read_transforms, write_scene
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.errors import CaptureError


@pytest.fixture
def scene(tmp_path) -> Scene:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((30, 40, 3), np.uint8))
    R = cv2.Rodrigues(np.array([0.3, -0.2, 0.9]))[0]
    K = np.array([[55.0, 0, 21.25], [0, 54.0, 14.5], [0, 0, 1]])
    lens = np.array([-0.1, 0.02, 0.001, -0.002, 0.003])
    camera = Camera(40, 30, K, np.column_stack([R, [0.1, 0.2, 3.0]]), lens)
    still = PosedFrame(tmp_path / "a.png", camera, "static", 0, None, None, "test")
    moving = replace(still, camera_name="cam0", index=7, time_s=1.23456789, time=0.1, split="train")
    box = np.array([[-1, -0.5, -1], [1, 0.5, 1.0]])
    times = {"t0_s": 1.0, "t1_s": 3.0}
    return scene_of((still,), (moving,), 2.0, aabb=box, **times, image_scale=0.5, metric=True)


def test_a_scene_comes_back_as_it_was(scene, tmp_path):
    write_scene(tmp_path / "scene", scene)
    back = read_scene(tmp_path / "scene")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    for ours, theirs in zip(scene.frames, back.frames, strict=True):
        np.testing.assert_allclose(theirs.camera.project(points), ours.camera.project(points), atol=1e-9)
        assert (theirs.camera_name, theirs.index, theirs.time_s, theirs.time, theirs.split) == (
            ours.camera_name,
            ours.index,
            ours.time_s,
            ours.time,
            ours.split,
        )
        assert theirs.path == ours.path.resolve()
    for name in ("near", "far", "kind", "background", "t0_s", "t1_s", "rest_time", "image_scale", "metric"):
        assert getattr(back, name) == getattr(scene, name)
    np.testing.assert_array_equal(back.aabb, scene.aabb)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        # of another length
        ("box_from_world", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, True, 0], [0, 0, 0, 1.0]]),
        ("box_from_world", [[0] * 4] * 4),
        ("box_from_world", [[1, 0], [0, 1]]),
        ("box_from_world", None),
        ("box", {"min": [0, 0, 0], "max": [0, 0, 0]}),
        ("near", "close"),
        ("t0_s", [1]),
        ("rest_time", {}),
        ("background", 7),
        ("ndc", []),
    ],
)
def test_a_scene_that_was_changed_is_damaged(scene, tmp_path, key, value):
    write_scene(tmp_path / "scene", scene)
    file = tmp_path / "scene/scene.json"
    content = json.loads(file.read_text())
    if key == "box_from_world" and value and value[0] == [1, 0, 0, 0]:
        value = (np.array(value) * [[2], [2], [1], [1]]).tolist()
    file.write_text(json.dumps(content | {key: value}))
    with refused("file-damaged", file, kind=CaptureError):
        read_scene(tmp_path / "scene")


def test_the_file_has_opengl_axes(scene, tmp_path):
    write_scene(tmp_path / "scene", scene)
    entry = json.loads((tmp_path / "scene/static/transforms.json").read_text())["frames"][0]
    looks = -np.array(entry["transform_matrix"])[:3, 2]  # OpenGL cameras look along their own -z
    np.testing.assert_allclose(looks, scene.static[0].camera.cam_from_world[2, :3], atol=1e-12)


def test_the_box_frame_keeps_pixels(scene):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    boxed = points @ scene.box_from_world[:3, :3].T + scene.box_from_world[:3, 3]
    np.testing.assert_allclose(
        scene.in_box_frame().static[0].camera.project(boxed),
        scene.static[0].camera.project(points),
        atol=1e-9,
    )


def test_nerfstudio_files_of_others_with_global_intrinsics(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((30, 40, 3), np.uint8))
    meta = {
        "camera_model": "OPENCV",
        "fl_x": 50.0,
        "fl_y": 51.0,
        "cx": 20.0,
        "cy": 15.0,
        "w": 40,
        "h": 30,
        "k1": -0.1,
        "frames": [{"file_path": "a.jpg", "transform_matrix": FLIP_YZ.tolist()}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    (frame,) = read_transforms(tmp_path / "transforms.json")
    assert frame.camera.K[1, 1] == 51 and frame.camera.distortion[0] == -0.1 and frame.time is None
    np.testing.assert_allclose(frame.camera.cam_from_world, np.eye(4)[:3], atol=1e-12)


def test_published_layout(data_dir):
    scene = read_dataset("devrf", data_dir / "devrf_cloth", frame_stride=5)
    assert scene.background == "white" and scene.rest_time == 0.0 and scene.kind == "inward"
    assert [sum(f.split == s for f in scene.static) for s in ("train", "test")] == [100, 10]
    train = [f for f in scene.dynamic if f.split == "train"]
    assert {f.camera_name for f in train} == {"view1", "view2", "view3", "view4"} and len(train) == 40
    assert len({f.time for f in scene.dynamic}) == 10 and sum(f.split == "test" for f in scene.dynamic) == 20
    assert [f.index for f in train if f.camera_name == "view1"] == list(range(0, 50, 5))
    centre = np.linalg.inv(scene.box_from_world)[:3, 3]
    pixels = np.stack([f.camera.project(centre) for f in scene.frames])
    assert np.abs(pixels - 200).max() < 60  # every camera looks at the middle of the box


def test_blender_without_a_test_split_holds_out(data_dir):
    scene = read_dataset("blender", data_dir / "lego_blender_400", holdout_every=8)
    assert [sum(f.split == s for f in scene.static) for s in ("train", "test")] == [87, 13]


def test_a_folder_of_another_layout_says_what_was_expected(tmp_path):
    with refused("folder-missing", "dynamic_4views", kind=CaptureError):
        read_dataset("devrf", tmp_path)
