"""A model made by hand whose answers are known: a ball of one colour at the origin that moves along x."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.grids import vertices
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.movers import Movers
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.shell import Shell

AABB = torch.tensor([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]])
RADIUS, TRAVEL, KEYS = 0.45, 0.3, 3
SLOPE = 60.0  # of the raw density at the surface, per unit: opaque within a voxel or two
COLOUR = (0.8, 0.4, 0.2)


def moving_ball(background: str = "white", resolution: int = 40) -> DynamicModel:
    """At time t the ball is at (TRAVEL t, 0, 0); backward and forward motion are exact."""
    canonical = Canonical.new(
        AABB, resolution, resolution, channels=3, mlp_width=4, stepsize=0.5, alpha_init=1e-4, alpha_threshold=1e-3,
        weight_threshold=1e-3, device="cpu", seed=0,
    )  # fmt: skip
    away = vertices(AABB, canonical.shape).norm(dim=-1, keepdim=True)
    canonical.density = (SLOPE * (RADIUS - away) - canonical.shift).contiguous()
    canonical.rebuild_occupancy()
    net = canonical.net.requires_grad_(False)
    weights = list(net.parameters())
    for weight in weights:
        weight.zero_()
    weights[-1].copy_(torch.logit(torch.tensor(COLOUR)))  # the bias of the output
    motion = MotionField.still(AABB, KEYS, 6, t_first=0.0, t_last=1.0, rest_key=0, device="cpu")
    for key in range(KEYS):
        motion.backward[key, ..., 0] = -TRAVEL * key / (KEYS - 1)
        motion.forward[key, ..., 0] = TRAVEL * key / (KEYS - 1)
    shell = None
    if background == "shell":
        shell = Shell.new(AABB, 12, 12, near=0.3, device="cpu")
        shell.rebuild_occupancy()
    return DynamicModel(RestModel(canonical, shell, background, 0.3, 9.0, {}), motion)


def rigid_ball() -> DynamicModel:
    """The same ball as a rigid part that goes as far, and makes a quarter turn about z."""
    rest = moving_ball().rest
    canonical = rest.canonical
    stands = canonical.only(torch.zeros(canonical.shape, dtype=torch.bool))
    labels = (canonical.distance <= 1).to(torch.uint8)
    times = torch.linspace(0, 1, 5)
    turns = Rotation.from_rotvec(np.outer(times.numpy(), [0, 0, np.pi / 2])).as_matrix()
    rotations = torch.from_numpy(turns).float()[:, None]
    shifts = times[:, None, None] * torch.tensor([TRAVEL, 0.0, 0.0])
    movers = Movers(canonical, labels, times, rotations, shifts)
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, KEYS, 0.0)
