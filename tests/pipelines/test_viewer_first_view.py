"""From where a page of the viewer looks first: as far away as nothing stands in between."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.make.models import moving_ball
from tests.pipelines.trained_run import write_trained

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene, SparsePoints
from devrf.pipelines.viewer.views import BACK, first_camera


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    run = write_trained(tmp_path, model=moving_ball(resolution=16)).parent / "run"
    return read_scene(run / "scene").in_box_frame()


def with_point(scene: Scene, xyz: np.ndarray) -> Scene:
    return replace(scene, points=SparsePoints(xyz[None], np.zeros(0, np.int64), np.zeros(0, np.int64)))


def test_it_goes_back_as_far_as_nothing_stands_before_it(scene: Scene) -> None:
    free = first_camera(replace(scene, points=None))
    ahead, target = free.cam_from_world[2, :3], scene.aabb.mean(axis=0)
    away = np.linalg.norm(target - free.centre)
    between = first_camera(with_point(scene, free.centre + 0.02 * away * ahead))
    assert np.linalg.norm(between.centre - free.centre) == pytest.approx(
        (BACK[0] - BACK[1]) / BACK[0] * away, rel=0.05
    )
    for xyz in (free.centre - 0.1 * ahead, free.centre + 0.6 * away * ahead):  # behind it; not much nearer
        np.testing.assert_allclose(first_camera(with_point(scene, xyz)).centre, free.centre)
    beside = with_point(scene, free.centre + 0.3 * away * ahead)  # on the way of all
    assert np.linalg.norm(first_camera(beside).centre - free.centre) > np.linalg.norm(
        between.centre - free.centre
    )
