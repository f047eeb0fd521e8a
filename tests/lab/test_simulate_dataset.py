"""A tiny data set through the real entry point: the published layout, exact truth, resumed and never mixed."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from tests.refused import refused

from devrf.capture.formats import read_dataset
from devrf.capture.scene import load_image
from devrf.capture.system.errors import InputError
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.scenes.simulation import Simulation

SIZE = (48, 40)
TINY = DatasetOptions(static_views=4, static_test_views=2, times=4, test_views_per_time=2, spp=4)
FLOWER = Simulation("flower", 2, 3, SIZE, TINY)
PICTURES = 4 + 2 + 2 + 2 * 4 + 2 + 2 * 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("dataset") / "flower"
    told: list[float] = []
    made = simulate_dataset(out, FLOWER, progress=lambda f, m: told.append(f))
    assert made.scene_yaml == out / "scene.yaml" and made.rendered == PICTURES
    assert told == sorted(told) and told[-1] == pytest.approx(1)
    return out


def _json(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_layout_is_the_published_one(dataset: Path) -> None:
    for part, counts in (("static", (4, 2, 2)), ("dynamic_2views", (8, 2, 8))):
        for split, count in zip(("train", "val", "test"), counts, strict=True):
            meta = _json(dataset / part / f"transforms_{split}.json")
            assert meta["camera_angle_x"] == pytest.approx(2 * np.arctan(48 / 40 * np.tan(0.6911112 / 2)))
            assert len(meta["frames"]) == count == len(list((dataset / part / split).glob("*.png")))
            for frame in meta["frames"]:
                picture = cv2.imread(str(dataset / part / f"{frame['file_path']}.png"), cv2.IMREAD_UNCHANGED)
                assert picture is not None and picture.shape == (40, 48, 4)
                assert np.linalg.norm(np.array(frame["transform_matrix"])[:3, 3]) == pytest.approx(4)
                assert 0.05 < (picture[..., 3] == 255).mean() < 0.7 and picture[0, 0, 3] == 0
    frames = _json(dataset / "dynamic_2views" / "transforms_train.json")["frames"]
    assert [f["time"] for f in frames] == pytest.approx(np.repeat(np.arange(4) / 3, 2))  # time-major
    assert [f["file_path"] for f in frames[:3]] == ["./train/r_000", "./train/r_004", "./train/r_001"]
    assert frames[0]["transform_matrix"] == frames[2]["transform_matrix"]
    test = _json(dataset / "dynamic_2views" / "transforms_test.json")["frames"]
    assert [f["time"] for f in test] == pytest.approx(np.repeat(np.arange(4) / 3, 2))
    assert len({json.dumps(f["transform_matrix"]) for f in test}) == 8
    assert {f["time"] for f in _json(dataset / "static" / "transforms_train.json")["frames"]} == {0.0}


def test_it_is_read_as_a_data_set(dataset: Path) -> None:
    config = yaml.safe_load((dataset / "scene.yaml").read_text(encoding="utf-8"))
    assert config == {"name": "flower", "dataset": {"format": "devrf", "path": "."}}
    scene = read_dataset("devrf", dataset)
    assert len(scene.static) == 6 and len(scene.dynamic) == 16
    assert scene.kind == "inward" and scene.background == "white" and scene.rest_time == 0
    rest = load_image(scene.dynamic[0], 1.0, "white")
    assert rest[0, 0].tolist() == [255, 255, 255]


def test_flow_and_depth_belong_to_the_pictures(dataset: Path) -> None:
    part = dataset / "dynamic_2views"
    frames = _json(part / "transforms_train.json")["frames"]
    assert sorted(f.name for f in (part / "train_flow").iterdir()) == [
        f"{i:03d}_bwd.npz" for i in range(2, 8)
    ]
    assert len(list((part / "train_depth").iterdir())) == 8

    def picture(i: int) -> np.ndarray:
        rgba = cv2.imread(str(part / f"{frames[i]['file_path']}.png"), cv2.IMREAD_UNCHANGED)
        assert rgba is not None
        alpha = rgba[..., 3:].astype(np.float32) / 255
        return rgba[..., :3] * alpha + 255 * (1 - alpha)

    x, y = np.meshgrid(np.arange(48, dtype=np.float32), np.arange(40, dtype=np.float32))
    warped_error, still_error = [], []
    for i in range(2, 8):
        with np.load(part / "train_flow" / f"{i:03d}_bwd.npz") as stored:
            flow, mask = stored["flow"], stored["mask"]
        assert flow.dtype == np.float16 and flow.shape == (40, 48, 2)
        assert mask.dtype == bool and mask.shape == (40, 48)
        with np.load(part / "train_depth" / f"{i:03d}.npz") as stored:
            depth = stored["depth"]
        assert ((depth > 0) >= mask).all() and (depth[depth > 0] > 2.6).all() and depth.max() < 5.4
        before, now = picture(i - 2), picture(i)
        warped = cv2.remap(before, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
        moved = mask & (np.abs(flow).max(-1) > 0.5)
        warped_error.append(np.abs(warped - now)[moved].mean())
        still_error.append(np.abs(before - now)[moved].mean())
    assert np.mean(warped_error) < 0.6 * np.mean(still_error)


def test_same_arguments_same_bytes_and_more_cameras_begin_with_the_same(
    dataset: Path, tmp_path: Path
) -> None:
    simulate_dataset(tmp_path, replace(FLOWER, cameras=1))
    pictures = {file.relative_to(tmp_path): file.read_bytes() for file in tmp_path.rglob("*.png")}
    rooms = {path.parts[:2] for path in pictures}
    assert {("static", "train"), ("dynamic_1views", "train"), ("dynamic_1views", "test")} <= rooms
    for path, content in pictures.items():
        same = Path(*("dynamic_2views" if part == "dynamic_1views" else part for part in path.parts))
        assert content == (dataset / same).read_bytes(), path


def test_interrupted_it_goes_on_and_complete_it_does_nothing(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(dataset, out)
    kept = out / "static" / "train" / "r_000.png"
    kept.write_bytes(b"left alone")
    assert simulate_dataset(out, FLOWER).rendered == 0
    made_by = _json(out / "made_by.json")
    assert made_by["complete"] and made_by["scene"] == "flower" and made_by["seed"] == 3
    (out / "made_by.json").write_text(json.dumps({**made_by, "complete": False}))
    gone = [out / "dynamic_2views" / name for name in ("train/r_006.png", "test/r_003.png")]
    gone.append(out / "dynamic_2views" / "train_flow" / "004_bwd.npz")
    for file in gone:
        file.unlink()
    assert simulate_dataset(out, FLOWER).rendered == 2
    for file in gone[:2]:
        assert file.read_bytes() == (dataset / file.relative_to(out)).read_bytes()
    with np.load(gone[2]) as new, np.load(dataset / gone[2].relative_to(out)) as old:
        np.testing.assert_array_equal(new["flow"], old["flow"])
    assert kept.read_bytes() == b"left alone" and _json(out / "made_by.json")["complete"]


def test_a_folder_that_holds_something_else_is_refused(dataset: Path, tmp_path: Path) -> None:
    with refused("folder-exists", "seed 3", "4", kind=InputError):
        simulate_dataset(dataset, replace(FLOWER, seed=4))
    with refused("folder-exists", "scene flower", "arm", kind=InputError):
        simulate_dataset(dataset, replace(FLOWER, scene="arm"))
    (tmp_path / "mine.txt").write_text("precious")
    with refused("folder-exists", tmp_path, "made_by.json", kind=InputError):
        simulate_dataset(tmp_path, FLOWER)
    assert [f.name for f in tmp_path.iterdir()] == ["mine.txt"]
