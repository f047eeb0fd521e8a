"""Stage `scene` on data sets of others: turned axes, stray points, cameras neither around nor one way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.judged import judged, named

from devrf.calibration.clocks.spans import span_of
from devrf.calibration.extent.bounds import scene_bounds
from devrf.capture.camera import Camera
from devrf.capture.formats import write_dataset
from devrf.capture.formats.colmap.colmap_model import ModelImage, read_model, write_model
from devrf.capture.formats.parts.files import read_json, write_json
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.progress import no_progress
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.scene import scene_stage as stage
from devrf.pipelines.stages.scene.captured_scene import unused, without_single_pictures


def rows_of(dataset_format: str, folder: Path) -> dict[str, HealthRow]:
    """The rows of stage `scene` on a data set."""
    config = SceneConfig.model_validate(
        {"name": "x", "dataset": {"format": dataset_format, "path": str(folder / "data")}}
    )
    out = folder / f"scene{len(list(folder.glob('scene*')))}"
    out.mkdir()
    context = StageContext(config, folder, folder, out, no_progress, "cpu")
    stage.run(context)
    return named(context.health)


def test_turned_axes_of_poses_are_seen(odd_scene: Scene, tmp_path: Path) -> None:
    """A transforms.json with OpenCV's axes in it."""
    check = "poses-turned cameras that look away from where their view axes meet"
    write_dataset("nerfstudio", odd_scene, tmp_path / "data")
    assert rows_of("nerfstudio", tmp_path)[check].verdict == "ok"
    path = tmp_path / "data" / "transforms.json"
    meta = read_json(path)
    for entry in meta["frames"]:
        entry["transform_matrix"] = (np.array(entry["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist()
    write_json(path, meta)
    row = rows_of("nerfstudio", tmp_path)[check]
    assert (row.verdict, row.value) == ("warn", 100) and row.remedy


def test_turned_poses_of_a_sparse_model_are_seen(odd_scene: Scene, tmp_path: Path) -> None:
    """40 points in all of 6 pictures; then the poses turned."""

    def row(turn: bool) -> HealthRow:
        scene = replace(odd_scene, dynamic=(), rest_time=None)
        write_dataset("colmap", scene, tmp_path / "data")
        if turn:
            folder = tmp_path / "data" / "sparse" / "0"
            model = read_model(folder)
            write_model(folder, replace(model, images={n: turned(i) for n, i in model.images.items()}))
        return rows_of("colmap", tmp_path)["poses-turned sightings of sparse points behind their cameras"]

    assert row(False).verdict == "ok"
    assert (row(True).verdict, row(True).value) == ("warn", 100) and row(True).remedy


def test_a_data_set_with_fixed_cameras_is_asked_whether_its_sweep_came_near(
    odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pictures at rest as they are, from 4 m, and from 34 m; the fixed cameras stand 4 m away."""
    assert odd_scene.dynamic and odd_scene.points is not None
    away = tuple(
        replace(f, camera=replace(f.camera, cam_from_world=f.camera.cam_from_world + 30 * np.eye(3, 4, 3)))
        for f in odd_scene.static
    )
    for static, verdict in ((odd_scene.static, "ok"), (away, "warn")):
        scene = replace(odd_scene, static=static)
        monkeypatch.setattr(stage, "configured_dataset", lambda *args, scene=scene: scene)
        row = rows_of("colmap", tmp_path)["box-not-swept"]
        assert row.verdict == verdict and bool(row.remedy) == (verdict == "warn")


def turned(image: ModelImage) -> ModelImage:
    """Half a turn about the camera's x axis."""
    w, x, y, z = image.quat_wxyz
    turn = {"quat_wxyz": np.array([-x, w, -z, y]), "translation": image.translation * [1, -1, -1]}
    return replace(image, **turn)


def test_clips_of_other_lengths_are_named() -> None:
    """A camera that films when no two others do is left out by name; a short clip is used as far as it goes."""
    camera = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(3, 4))
    filmed = {"cam0": (0.0, 5.0), "cam1": (1.0, 4.0), "short": (2.0, 2.2), "late": (6.0, 8.0)}
    assert span_of(list(filmed.values())) == (1.0, 4.0)
    used = [
        PosedFrame(Path("p.png"), camera, name, n, t, 0.0, "train")
        for name, (begin, end) in filmed.items()
        for n, t in enumerate(np.arange(begin, end, 0.1))
        if 1.0 <= t <= 4.0
    ]
    (row,) = judge(unused(list(filmed), [], used))
    assert (row.about, row.verdict) == ("late", "warn") and "late" in row.remedy
    assert unused(["cam0", "cam1", "short"], [], used) == []


def moving(**counts: int) -> tuple[PosedFrame, ...]:
    """So many pictures of each camera; those of `test` are not trained on."""
    camera = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(3, 4))
    return tuple(
        PosedFrame(Path("p.png"), camera, name, n, n / 10, n / 10, "test" if name == "test" else "train")
        for name, count in counts.items()
        for n in range(count)
    )


@pytest.mark.parametrize(
    ("filmed", "left", "verdict", "named"),
    [
        ({"cam0": 9, "cam1": 9}, {"cam0", "cam1"}, "ok", ""),
        ({"cam0": 9, "cam1": 9, "short": 1, "test": 1}, {"cam0", "cam1", "test"}, "ok", ""),
        ({"cam0": 9, "cam1": 9, "short": 3}, {"cam0", "cam1", "short"}, "warn", "short 3"),
        ({"cam0": 9, "short": 1}, {"cam0", "short"}, "fail", "short 1"),
        ({"only": 9, "test": 1}, {"only", "test"}, "ok", ""),
        ({"only": 1}, {"only"}, "fail", "only 1"),
    ],
)
def test_a_camera_of_one_picture_ends_the_run_only_where_too_few_are_left(
    odd_scene: Scene, filmed: dict[str, int], left: set[str], verdict: str, named: str
) -> None:
    used = without_single_pictures(moving(**filmed))
    assert {frame.camera_name for frame in used} == left
    gone = [name for name in filmed if name not in left]
    assert [m.about for m in unused(list(filmed), [], used)] == gone
    bounds = scene_bounds([frame.camera for frame in odd_scene.static], [], np.zeros((0, 3)), np.zeros(0))
    row = judged(stage.health(bounds, replace(odd_scene, dynamic=used)))["scene-few-frames"]
    assert row.verdict == verdict and named in row.remedy and "cam0" not in row.remedy
