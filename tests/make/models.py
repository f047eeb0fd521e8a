"""Models made by hand whose answers are known, and random ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from devrf.capture.camera import Camera
from devrf.reconstruct.fields.canonical import Canonical, new_canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.contracted_background import Shell, grey
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import Movers
from devrf.reconstruct.fields.ndc import CUBE, Ndc
from devrf.reconstruct.kernels.background import Contraction
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.model import DynamicModel

UNIT_BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
AABB = torch.tensor([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]])  # of the moving ball and of the moving parts
RADIUS, TRAVEL, KEYS = 0.45, 0.3, 3
SLOPE = 60.0  # of the raw density at the surface, per unit: opaque within a voxel or two
COLOUR = (0.8, 0.4, 0.2)
NDC = Ndc(0.6, 0.45)
SURE = {"channels": 3, "mlp_width": 4, "alpha_init": 1e-4, "alpha_threshold": 1e-3, "weight_threshold": 1e-3}


def canonical(
    aabb: torch.Tensor, resolution: float = 16, final: float | None = None, **special: Any
) -> Canonical:
    """A scene at rest of which nothing is known yet; `special`: other numbers than the usual ones."""
    usual = {"channels": 4, "mlp_width": 8, "alpha_init": 1e-2, "ndc": None} | special
    alpha_init, ndc = usual.pop("alpha_init"), usual.pop("ndc")
    options = CanonicalOptions(resolution=final or resolution, iterations=0, rays=0, **usual)  # type: ignore[arg-type]
    return new_canonical(aabb, resolution, options, alpha_init, "cpu", ndc)


def planes(count: int = 32, seed: int = 0) -> Canonical:
    """The same in normalised device coordinates."""
    thin = {"channels": 9, "mlp_width": 16, "alpha_threshold": 1e-6, "weight_threshold": 1e-6}
    return canonical(CUBE, 24, planes=count, ndc=NDC, seed=seed, **thin)


def still(aabb: torch.Tensor, keys: int, resolution: int) -> MotionField:
    """Nothing moves from time 0, that of the rest, to time 1."""
    return MotionField.still(aabb, keys, resolution, (0.0, 1.0), 0, "cpu")


def straight(aabb: torch.Tensor, travel: Any, keys: int = 2, resolution: int = 4) -> MotionField:
    """Everything moves straight along `travel`, backward and forward exactly."""
    motion = still(aabb, keys, resolution)
    for key in range(keys):
        way = torch.as_tensor(travel, dtype=torch.float32) * key / (keys - 1)
        motion.forward[key] += way
        motion.backward[key] -= way
    return motion


def random_model(background: str = "shell", deferred: bool = False, seed: int = 0) -> DynamicModel:
    """A model of random numbers, without forward motion."""
    g = torch.Generator().manual_seed(seed)
    at_rest = canonical(UNIT_BOX, deferred=deferred)
    at_rest.density += 3 * torch.randn(at_rest.density.shape, generator=g)
    at_rest.features += torch.randn(at_rest.features.shape, generator=g)
    at_rest.rebuild_occupancy()
    at_rest.net.requires_grad_(False)
    shell = None
    if background == "shell":
        shell = Shell(UNIT_BOX, grey(12), 12, near=0.3, contraction=Contraction(8.5, 6.0)).begun()
        shell.grid += torch.randn(shell.grid.shape, generator=g)
        shell.rebuild_occupancy()
    motion = still(UNIT_BOX, 3, 5)
    motion.backward[1:] += 0.1 * torch.randn(motion.backward[1:].shape, generator=g)
    return DynamicModel(RestModel(at_rest, shell, background, 0.3, 9.0, {}), motion)


def before_random_model() -> Camera:
    """A camera that sees all of it."""
    pose = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3.0]])
    return Camera(20, 16, np.array([[25, 0, 10], [0, 25, 8], [0, 0, 1.0]]), pose)


# --- a ball of one colour at the origin that moves along x ---


def moving_ball(background: str = "white", resolution: int = 40) -> DynamicModel:
    """At time t the ball is at (TRAVEL t, 0, 0); backward and forward motion are exact."""
    ball = canonical(AABB, resolution, **SURE)
    away = vertices(AABB, ball.shape).norm(dim=-1, keepdim=True)
    ball.density = (SLOPE * (RADIUS - away) - ball.shift).contiguous()
    ball.rebuild_occupancy()
    weights = list(ball.net.requires_grad_(False).parameters())
    for weight in weights:
        weight.zero_()
    weights[-1].copy_(torch.logit(torch.tensor(COLOUR)))  # the bias of the output
    shell = None
    if background == "shell":
        shell = Shell(AABB, grey(12), 12, near=0.3).begun()
    motion = straight(AABB, [TRAVEL, 0, 0], KEYS, 6)
    return DynamicModel(RestModel(ball, shell, background, 0.3, 9.0, {}), motion)


def rigid_ball() -> DynamicModel:
    """The same ball as a rigid part that goes as far, and makes a quarter turn about z."""
    rest = moving_ball().rest
    ball = rest.canonical
    stands = ball.only(torch.zeros(ball.shape, dtype=torch.bool))
    labels = (ball.distance <= 1).to(torch.uint8)
    times = torch.linspace(0, 1, 5)
    turns = Rotation.from_rotvec(np.outer(times.numpy(), [0, 0, np.pi / 2])).as_matrix()
    shifts = times[:, None, None] * torch.tensor([TRAVEL, 0.0, 0.0])
    movers = Movers(ball, labels, times, torch.from_numpy(turns).float()[:, None], shifts)
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, KEYS, 0.0)


# --- a red stick that turns, a green ball that slides on a blue slab ---

STICK, BALL, SLAB = 0, 1, 2  # the order of their colours
CENTRES = np.array([[-0.4, 0.1, 0.4], [0.4, 0.0, -0.25], [0.4, 0.05, -0.6]])
SIZES = np.array(
    [[0.4, 0.13, 0.13], [0.24, 0.24, 0.24], [0.4, 0.6, 0.1]]
)  # half axes; half sides of the slab
MOMENTS, PARTS_KEYS, REST = 9, 5, 0.375  # the moment at rest is none of the key times
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
    model = canonical(AABB, resolution, **SURE)
    places = vertices(AABB, model.shape).double().numpy()
    away = torch.from_numpy(np.stack([outside(n, places, REST) for n in range(3)])).float()
    nearest = away.argmin(0)
    model.features = torch.nn.functional.one_hot(nearest, 3).float()
    model.density = (SLOPE * -away.amin(0)[..., None] - model.shift).contiguous()
    model.rebuild_occupancy()
    weights = model.net.requires_grad_(False).state_dict()
    for weight in weights.values():
        weight.zero_()
    for layer in ("features", "hidden", "out"):
        weights[f"{layer}.weight"][:3, :3] = torch.eye(3)
    weights["out.weight"] *= 6
    weights["out.bias"] -= 3
    labels = torch.where((model.distance <= 1) & (nearest != SLAB), nearest + 1, 0).to(torch.uint8)
    times = torch.linspace(0, 1, MOMENTS)
    rotations, shifts = (np.stack(x) for x in zip(*map(motion_at, times.tolist()), strict=True))
    own, stands = model.only(labels > 0), model.only(labels == 0)
    movers = Movers(
        own,
        labels,
        times,
        torch.from_numpy(rotations[:, :2]).float(),
        torch.from_numpy(shifts[:, :2]).float(),
    )
    rest = RestModel(model, None, "white", 0.3, 9.0, {})
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, PARTS_KEYS, REST)
