"""What sparse points say about space: free along lines of sight, a surface at their ends."""

from dataclasses import replace

import numpy as np
import torch

from devrf.capture.scene import Scene, SparsePoints
from devrf.reconstruct.adapt.carving import carve, trained_lines
from devrf.reconstruct.kernels.background import Contraction, contract

AABB = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
SIZE, REACH = 41, Contraction(6.0)


def _at(grid: torch.Tensor, point: list[float]) -> bool:
    index = ((contract(torch.tensor(point), REACH) + 2) / 4 * (SIZE - 1)).round().long().tolist()
    return bool(grid[index[0], index[1], index[2]])


def test_a_wall_seen_through_the_box() -> None:
    """Cameras on one side see a wall on the other."""
    g = torch.Generator().manual_seed(0)
    ends = torch.rand(4000, 3, generator=g) * torch.tensor([0.0, 4, 4]) + torch.tensor([3.0, -2, -2])
    starts = torch.rand(4000, 3, generator=g) * torch.tensor([0.0, 1, 1]) + torch.tensor([-2.0, -0.5, -0.5])
    free, surface = carve(starts, ends, AABB, SIZE, 0.1, REACH)
    assert not (free & surface).any()
    assert _at(free, [0.0, 0, 0]) and _at(free, [2.0, 0.3, -0.3])
    assert _at(surface, [3.0, 0.0, 0.0]) and _at(surface, [3.0, 1.0, -1.0])
    for unseen in ([4.5, 0.0, 0.0], [0.0, 3.0, 0.0], [-3.0, 0.0, 0.0]):
        assert not _at(free, unseen) and not _at(surface, unseen)


def test_one_wrong_match_carves_nothing() -> None:
    free, surface = carve(torch.tensor([[-2.0, 0, 0]]), torch.tensor([[3.0, 0, 0]]), AABB, SIZE, 0.1, REACH)
    assert not free.any() and _at(surface, [3.0, 0, 0])


def test_held_out_pictures_give_no_lines(ball) -> None:
    scene: Scene = ball.scene
    assert trained_lines(scene) is None
    frames = np.arange(len(scene.static))
    points = SparsePoints(np.zeros((1, 3)), np.zeros_like(frames), frames)
    lines = trained_lines(replace(scene, points=points))
    assert lines is not None
    centres = {tuple(np.round(f.camera.centre, 4)) for f in scene.static if f.split == "train"}
    assert {tuple(np.round(c, 4)) for c in lines[0].double().numpy()} == centres
