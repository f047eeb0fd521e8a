"""What the example's run leaves, taken elsewhere: what moves is where it truly was."""

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.script import centres
from scipy.spatial import KDTree
from tests.conftest import ExampleRun
from tests.make.glb import read_glb

from devrf.calibration.truth import read_truth, similarity
from devrf.capture.formats import read_scene
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.terminal.console import Talk

TIME_S = 1.3  # in mid-motion: half of the points are 0.1 m or more from where they rest
MEDIAN_M = 0.015  # a voxel and a half; measured 0.008


@pytest.mark.full
@pytest.mark.parametrize("whole_run", ["example_run"], indirect=True)
def test_what_moves_is_where_it_was(whole_run: ExampleRun, tmp_path: Path) -> None:
    pytest.importorskip("skimage")
    options = ExportOptions("glb", tmp_path / "out", times=f"{TIME_S}s", device="cpu")
    folder = export(Talk("quiet"), whole_run.run_dir, options)
    facts = json.loads((folder / "export.json").read_text())
    mesh = read_glb(folder / "scene.glb")

    scene, file = read_scene(whole_run.run_dir / "scene"), whole_run.scene.parent / "ground_truth.json"
    truth, thing = read_truth(file), json.loads(file.read_text())["object"]
    true_from_world = similarity(*centres(scene, truth))
    assert np.cbrt(np.linalg.det(true_from_world[:3, :3])) == pytest.approx(1, abs=0.01)  # metres
    points, times = np.array(thing["points_m"]), np.array(thing["times_s"])
    true = np.stack(
        [np.interp(TIME_S, times, course) for course in points.reshape(len(times), -1).T]
    ).reshape(-1, 3)
    for shape, time in ((mesh.vertices, 0.0), (mesh.shapes[0], TIME_S)):
        there = shape @ true_from_world[:3, :3].T + true_from_world[:3, 3]
        thing_then = points[0] if time == 0.0 else true
        assert np.median(KDTree(there).query(thing_then)[0]) < MEDIAN_M
    assert np.median(np.linalg.norm(true - points[0], axis=1)) > 5 * MEDIAN_M  # so that it tells
    assert max(facts["forward_motion"]["median"]) < facts["forward_motion"]["voxel"]
