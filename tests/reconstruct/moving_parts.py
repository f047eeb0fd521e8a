"""A model made by hand whose answers are known: a red stick that turns, a green ball that slides on a blue slab."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from tests.reconstruct.moving_ball import AABB, SLOPE

from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.grids import vertices
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.movers import Movers
from devrf.reconstruct.rest_model import RestModel

STICK, BALL, SLAB = 0, 1, 2  # the order of their colours
CENTRES = np.array([[-0.4, 0.1, 0.4], [0.4, 0.0, -0.25], [0.4, 0.05, -0.6]])
SIZES = np.array(
    [[0.4, 0.13, 0.13], [0.24, 0.24, 0.24], [0.4, 0.6, 0.1]]
)  # half axes; half sides of the slab
MOMENTS, KEYS, REST = 9, 5, 0.375  # the moment at rest is none of the key times
TURN = np.pi / 2  # of the stick about z, from time 0 to time 1
SLIDE = np.array([0.0, 0.6, 0.0])  # of the ball, from time 0 to time 1


def motion_at(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and shifts of the stick, the ball and the slab at a time: x at rest is at R x + t."""
    turn = Rotation.from_rotvec([0, 0, TURN * (time - REST)]).as_matrix()
    rotations = np.stack([turn, np.eye(3), np.eye(3)])
    return rotations, np.stack([CENTRES[0] - turn @ CENTRES[0], SLIDE * (time - REST), np.zeros(3)])


def outside(thing: int, points: np.ndarray, time: float) -> np.ndarray:
    """How far points lie outside of the surface of a thing at a time (negative: inside), to first order."""
    rotations, shifts = motion_at(time)
    away = np.abs((points - shifts[thing]) @ rotations[thing] - CENTRES[thing])
    if thing == SLAB:
        beyond = away - SIZES[thing]
        return np.linalg.norm(beyond.clip(min=0), axis=-1) + beyond.max(-1).clip(max=0)
    scaled = np.linalg.norm(away / SIZES[thing], axis=-1)
    return scaled * (scaled - 1) / np.linalg.norm(away / SIZES[thing] ** 2, axis=-1).clip(min=1e-6)


def moving_parts(resolution: int = 40) -> DynamicModel:
    """The stick is part 1, the ball part 2."""
    canonical = Canonical.new(
        AABB, resolution, resolution, channels=3, mlp_width=4, stepsize=0.5, alpha_init=1e-4, alpha_threshold=1e-3,
        weight_threshold=1e-3, device="cpu", seed=0,
    )  # fmt: skip
    places = vertices(AABB, canonical.shape).double().numpy()
    away = torch.from_numpy(np.stack([outside(n, places, REST) for n in range(3)])).float()
    nearest = away.argmin(0)
    canonical.features = torch.nn.functional.one_hot(nearest, 3).float()
    canonical.density = (SLOPE * -away.amin(0)[..., None] - canonical.shift).contiguous()
    canonical.rebuild_occupancy()
    weights = canonical.net.requires_grad_(False).state_dict()
    for weight in weights.values():
        weight.zero_()
    for layer in ("features", "hidden", "out"):
        weights[f"{layer}.weight"][:3, :3] = torch.eye(3)
    weights["out.weight"] *= 6
    weights["out.bias"] -= 3
    labels = torch.where((canonical.distance <= 1) & (nearest != SLAB), nearest + 1, 0).to(torch.uint8)
    times = torch.linspace(0, 1, MOMENTS)
    rotations, shifts = (np.stack(x) for x in zip(*map(motion_at, times.tolist()), strict=True))
    own, stands = canonical.only(labels > 0), canonical.only(labels == 0)
    movers = Movers(
        own,
        labels,
        times,
        torch.from_numpy(rotations[:, :2]).float(),
        torch.from_numpy(shifts[:, :2]).float(),
    )
    rest = RestModel(canonical, None, "white", 0.3, 9.0, {})
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, KEYS, REST)
