"""A block that stands on a floor: its lower face is hidden at rest, and is its own."""

import numpy as np
import pytest
import torch
from tests.make import models
from tests.reconstruct.conftest import look_at

from devrf.reconstruct.fields.canonical import EMPTY, Canonical, occupied_in
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.geometry.seen import SeenView
from devrf.reconstruct.tracking.hidden import fill, hidden_at_rest, labels_of_hidden

HALF = 0.4  # of the block's side; it stands on the floor, whose z is 0
BLOCK = np.array([[-HALF, -HALF, 0], [HALF, HALF, 2 * HALF]])


def view(eye: np.ndarray) -> SeenView:
    """Where rays of a camera meet the block, or the floor; nothing above the horizon."""
    camera = look_at(eye)
    y, x = np.mgrid[: camera.height, : camera.width]
    d = camera.directions(np.stack([x + 0.5, y + 0.5], -1).astype(float))
    with np.errstate(divide="ignore"):
        slabs = (BLOCK[:, None, None] - camera.centre) / d
        near, far = slabs.min(0).max(-1), slabs.max(0).min(-1)
        floor = -camera.centre[2] / d[..., 2]
    away = np.where((near < far) & (near > 0), near, np.where(floor > 0, floor, np.nan))
    points, black = camera.centre + away[..., None] * d, np.zeros_like(d, dtype=np.float32)
    return SeenView(camera, black, points, d, np.isfinite(away))


@pytest.fixture(scope="module")
def views() -> list[SeenView]:
    around = np.linspace(0, 2 * np.pi, 9)[:-1]
    return [view(np.array([2.5 * np.cos(a), 2.5 * np.sin(a), 1.5])) for a in around]


@pytest.fixture
def canonical() -> Canonical:
    model = models.canonical(torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 1.5]]), 40, **models.SURE)
    model.density[:] = EMPTY
    return model


def inside(canonical: Canonical, margin: float) -> torch.Tensor:
    """Vertices of the block, so much smaller (or larger) on every side."""
    places = vertices(canonical.aabb, canonical.shape)
    lo, hi = torch.from_numpy(BLOCK + margin * np.array([[1.0], [-1.0]])).float()
    return ((places > lo) & (places < hi)).all(-1)


def test_what_no_view_looks_through_is_hidden(views: list[SeenView], canonical: Canonical) -> None:
    hidden = hidden_at_rest(views, canonical)
    z = vertices(canonical.aabb, canonical.shape)[..., 2]
    assert hidden[inside(canonical, 0.06)].all() and hidden[z < -0.06].all()
    # Before the block, nearer than a voxel and a half.
    skin = inside(canonical, -0.07) & ~inside(canonical, 0) & (z > 0.1)
    assert skin.sum() > 500 and float(hidden[skin].float().mean()) < 0.05
    air = (z > 0.05) & ~inside(canonical, -0.05)
    seen = np.concatenate([v.points[v.kept] for v in views])
    reach = torch.from_numpy(np.abs(seen).max(0)).float()  # what no picture shows is hidden, too
    air &= (vertices(canonical.aabb, canonical.shape).abs() < reach).all(-1)
    assert float(hidden[air].float().mean()) < 0.02


def test_hidden_inside_a_part_is_its_own(canonical: Canonical) -> None:
    rng = np.random.default_rng(0)
    faces = rng.uniform(BLOCK[0], BLOCK[1], (600, 3))
    # No point lies on the lower face.
    faces[:150, 2], faces[150:300, 0], faces[300:450, 0] = 2 * HALF, -HALF, HALF
    faces[450:, 1] = np.where(np.arange(150) % 2, -HALF, HALF)
    flat = rng.uniform(-0.9, -0.6, (50, 3)) * [1, 1, 0]
    xyz, labels = np.concatenate([faces, flat]), np.repeat([1, 0], [600, 50])
    everywhere = torch.ones(canonical.shape, dtype=torch.bool)
    found = labels_of_hidden(canonical, everywhere, xyz, labels)
    assert (found[inside(canonical, 0.05)] == 2).all() and not found[~inside(canonical, -0.01)].any()
    assert not labels_of_hidden(canonical, ~everywhere, xyz, labels).any()


def test_what_is_filled_is_opaque_in_the_colours_next_to_it(canonical: Canonical) -> None:
    places = vertices(canonical.aabb, canonical.shape)
    block, left = inside(canonical, 0.0), places[..., 0] < 0
    shown = block & (places[..., 2] > 0.3)
    filled = block & ~shown
    canonical.features[shown & left, 0], canonical.features[shown & ~left, 1] = 1.0, 1.0
    before = canonical.features.clone()
    own = canonical.only(shown)
    fill(own, shown, torch.zeros_like(filled))
    assert own.features is canonical.features and not occupied_in(own)[inside(canonical, 0.1) & filled].any()
    fill(own, shown, filled)
    middle = inside(canonical, 0.06) & filled
    assert float(own.alpha(places[middle]).min()) > 0.45
    assert (own.features[filled & left, 0] == 1).all() and (own.features[filled & ~left, 1] == 1).all()
    assert torch.equal(canonical.features, before) and (canonical.density == EMPTY).all()
