"""Surfaces of a ball whose place, size and colour are known: as meshes, as views, as point clouds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.make.models import COLOUR, RADIUS, TRAVEL, moving_ball, planes
from tests.reconstruct.conftest import around, look_at
from tests.refused import refused

from devrf.capture.camera import Camera
from devrf.capture.system.errors import ReconstructError
from devrf.pipelines.export.mesh import marching_cubes
from devrf.reconstruct.fields.canonical import seen_with
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.geometry.cloud import point_cloud
from devrf.reconstruct.geometry.field import Field, field_at
from devrf.reconstruct.geometry.mesh_surface import (
    apart,
    coloured,
    moved,
    normals_of,
    rested,
    resting,
    surface_of,
)
from devrf.reconstruct.geometry.seen import SeenView, agreed, look, solid
from devrf.reconstruct.rendering.model import DynamicModel

pytest.importorskip("skimage")
LEVEL = 0.5


@pytest.fixture(scope="module")
def model() -> DynamicModel:
    return moving_ball()


def views_of(model: DynamicModel, time: float | None, cameras: int = 6) -> list[SeenView]:
    return [look(model, look_at(eye).scaled(2.0), time) for eye in around(cameras, 0.1, 0.4)]


@pytest.mark.parametrize("time", [None, 0.0, 0.75])
def test_the_surface_of_a_ball(model: DynamicModel, time: float | None) -> None:
    field = field_at(model, time)
    found = surface_of(field, LEVEL, marching_cubes)
    centre = np.array([TRAVEL * (time or 0.0), 0, 0])
    radius = np.linalg.norm(found.vertices - centre, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.5 * field.voxel
    outward = (normals_of(found.vertices, found.faces) * (found.vertices - centre)).sum(1) / radius
    assert outward.min() > 0.95 and found.crumbs == 0
    np.testing.assert_allclose(rested(found, field), found.vertices - centre, atol=1e-5)


def test_the_mesh_at_rest_is_moved_to_where_it_is_found(model: DynamicModel) -> None:
    field = field_at(model, 0.6)
    base = surface_of(field.at_rest(), LEVEL, marching_cubes)
    there = moved(base, field)
    np.testing.assert_allclose(
        there - base.vertices, np.tile([0.6 * TRAVEL, 0, 0], (len(there), 1)), atol=1e-5
    )
    again = surface_of(field, LEVEL, marching_cubes)
    assert np.quantile(apart(there, again.vertices), 0.95) < field.voxel
    elsewhere = np.quantile(apart(base.vertices, again.vertices), 0.95)
    # the poles of its way; the equator hardly differs
    assert elsewhere == pytest.approx(0.6 * TRAVEL, rel=0.1)


def test_nothing_that_solid_is_said(model: DynamicModel) -> None:
    thin = field_at(model, None)
    canonical = seen_with(thin.canonical, 0.5, 1e-3, 1e-3)
    canonical.density = canonical.density.clamp(max=-2.0 - canonical.shift)
    with refused("model-without-surface", "level 0.5", "--level", kind=ReconstructError):
        surface_of(Field(canonical), LEVEL, marching_cubes)


def test_crumbs_are_left_out(model: DynamicModel) -> None:
    canonical = seen_with(field_at(model, None).canonical, 0.5, 1e-3, 1e-3)
    canonical.density = canonical.density.clone()
    canonical.density[2, 2, 2] = 20.0
    canonical.rebuild_occupancy()
    found = surface_of(Field(canonical), LEVEL, marching_cubes)
    assert found.crumbs == 1 and np.linalg.norm(found.vertices, axis=1).max() < 1.1 * RADIUS


def test_the_plane_behind_everything_is_no_surface() -> None:
    canonical = planes()
    canonical.density[:] = -20.0
    canonical.density[8:16, 6:12, 10:14] = 20.0
    canonical.density[:, :, -1] = 20.0
    canonical.rebuild_occupancy()
    model = DynamicModel(RestModel(canonical, None, "black", 1.0, 100.0, {}))
    found = surface_of(field_at(solid(model), None), LEVEL, marching_cubes)
    assert canonical.ndc is not None and solid(moving_ball()).rest.canonical.ndc is None
    z = canonical.ndc.to_world(torch.tensor([[0.0, 0.0, -1 + 2 * n / 31] for n in (9, 14)]))[:, 2]
    assert z[0] < found.vertices[:, 2].min() and found.vertices[:, 2].max() < z[1]
    middle = found.vertices.mean(0)
    outward = normals_of(found.vertices, found.faces) * (found.vertices - middle)
    assert outward.sum(1).min() > 0  # a frustum keeps its outside
    camera = Camera(48, 36, np.array([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]), np.eye(3, 4))
    view, whole = look(solid(model), camera, None), look(model, camera, None)
    assert np.isfinite(whole.points).all() and np.nanmax(view.points[..., 2]) < z[1]
    assert (model.rest.canonical.density[:, :, -1] == 20.0).all()  # not changed


@pytest.mark.parametrize("time", [None, 1.0])
def test_views_and_their_cloud(model: DynamicModel, time: float | None) -> None:
    views = views_of(model, time)
    centre = np.array([TRAVEL * (time or 0.0), 0, 0])
    cloud = point_cloud(views)
    away = cloud.xyz - centre
    assert len(cloud.xyz) > 300
    assert np.abs(np.linalg.norm(away, axis=1) - RADIUS).max() < model.rest.canonical.voxel
    facing = (cloud.normals * away).sum(1) / np.linalg.norm(away, axis=1)
    assert np.median(facing) > 0.98 and facing.min() > 0.5
    np.testing.assert_allclose(cloud.rgb, np.tile(COLOUR, (len(cloud.rgb), 1)), atol=0.03)


def test_a_point_in_the_air_is_voted_out(model: DynamicModel) -> None:
    views = views_of(model, None)
    view = views[0]
    row, column = np.argwhere(agreed(views, 0))[20]
    wrong = view.points.copy()
    wrong[row, column] += 0.5 * (view.camera.centre - wrong[row, column])  # others see through there
    found = agreed([replace(view, points=wrong), *views[1:]], 0)
    assert not found[row, column] and found.sum() == agreed(views, 0).sum() - 1
    assert not agreed(views[:1], 0).any()  # one view alone proves nothing


def test_colours_are_those_that_are_seen_or_else_the_field_s(model: DynamicModel) -> None:
    field = field_at(model, 0.5)
    found = surface_of(field, LEVEL, marching_cubes)
    views = views_of(resting(model), None)
    np.testing.assert_allclose(coloured(views, found, field), np.tile(COLOUR, (len(found.x), 1)), atol=0.03)
    blue = [
        replace(view, picture=np.zeros_like(view.picture) + np.array([0, 0, 1], np.float32))
        for view in views[:1]
    ]
    rgb = coloured(blue, found, field)
    eye = views[0].camera.centre
    side = (rested(found, field) @ eye) / (np.linalg.norm(eye) * RADIUS)  # cosine to the camera
    np.testing.assert_allclose(rgb[side > 0.6], np.tile([0, 0, 1], ((side > 0.6).sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(rgb[side < 0], np.tile(COLOUR, ((side < 0).sum(), 1)), atol=0.03)


def test_the_scene_at_rest_in_the_colours_of_motion(model: DynamicModel) -> None:
    assert resting(model).rest is model.rest and resting(model).motion is None
    with_shell = moving_ball("shell")
    with_shell.in_motion = moving_ball().rest  # it is stored without surroundings
    still = resting(with_shell).rest
    assert still.canonical is with_shell.in_motion.canonical and still.shell is with_shell.rest.shell
