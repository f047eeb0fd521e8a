"""Closed textured meshes to build models from: rounded boxes, turned shapes, tubes along bent lines.

Lengths are world units. Every shape is closed (a tube ends in a ring of a thousandth), its faces look
outward, and its texture moves with it. A model is a tuple of parts; a part's vertices are a function of the
time in [0, 1] and its faces never change.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from devrf.lab.simulate.scenes.catalogue import Mesh, Paint, texture

TEXEL = 0.007  # world units; a picture of 400 pixels has about one pixel per texel
AROUND = 48  # vertices of a ring
CORNER = 5  # vertices across a rounded edge, per side of a box
TIP = 1e-3  # last ring of a tube, so that its normals are defined


@dataclass(frozen=True)
class Part:
    """A mesh that moves.

    Attributes:
        rest: The mesh at time 0.
        vertices_at: Its vertices [V, 3] at a time in [0, 1].
    """

    rest: Mesh
    vertices_at: Callable[[float], np.ndarray]

    def at(self, time: float) -> Mesh:
        """The mesh at a time."""
        return replace(self.rest, vertices=self.vertices_at(time))


Model = tuple[Part, ...]
Pose = Float[np.ndarray, "4 4"]
Number = float | int  # type checks at run time do not take an int for a float


def rigid(mesh: Mesh, pose: Callable[[float], Pose] | Pose) -> Part:
    """A part that is moved as a whole: world_from_part at a time, or one that never changes."""

    def vertices_at(time: float) -> np.ndarray:
        world_from_part = pose(time) if callable(pose) else pose
        return mesh.vertices @ world_from_part[:3, :3].T + world_from_part[:3, 3]

    return Part(replace(mesh, vertices=vertices_at(0.0)), vertices_at)


def shift(x: Number, y: Number, z: Number) -> Pose:
    """A translation."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def turn(axis: str | Float[np.ndarray, "3"], angle_deg: Number) -> Pose:
    """A rotation about x, y, z or any axis through the origin, counter-clockwise seen against the axis."""
    n = np.eye(3)["xyz".index(axis)] if isinstance(axis, str) else axis / np.linalg.norm(axis)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    pose = np.eye(4)
    pose[:3, :3] = c * np.eye(3) + s * cross + (1 - c) * np.outer(n, n)
    return pose


def ease(time: Number, start: Number = 0.0, end: Number = 1.0) -> float:
    """From 0 at `start` to 1 at `end`, slowly at both ends."""
    x = float(np.clip((time - start) / (end - start), 0, 1))
    return 0.5 - 0.5 * float(np.cos(np.pi * x))


def skin(
    rng: np.random.Generator, width: Number, height: Number, paint: Paint, coarse: Number = 1.0
) -> np.ndarray:
    """A procedural picture for a surface of about this size; `coarse` enlarges its shapes."""
    rows, columns = (int(np.clip(length / TEXEL, 8, 700)) for length in (height, width))
    return texture(rng, (rows, columns), TEXEL, 1.0, paint=paint, sizes_m=(0.05 * coarse, 0.3 * coarse))


def rounded_box(
    rng: np.random.Generator, size: tuple[Number, Number, Number], paint: Paint, radius: Number = 0.04
) -> Mesh:
    """A box with rounded edges, centred at the origin; each side has its own piece of the texture."""
    half = np.array(size) / 2
    radius = min(radius, 0.99 * float(half.min()))
    longest = 2 * float(half.max())
    arc = np.tan(np.linspace(0, np.pi / 4, CORNER))  # even steps over the eighth of a circle
    vertices, faces, uv = [], [], []
    for side in range(6):
        axis, sign = side % 3, 1 if side < 3 else -1
        a, b = (axis + 1) % 3, (axis + 2) % 3
        if sign < 0:
            a, b = b, a  # so that a, b, outward stay right-handed
        lines = []
        for k in (a, b):
            inner = half[k] - radius
            lines.append(np.concatenate([-inner - radius * arc[::-1], inner + radius * arc]))
        q, p = np.meshgrid(lines[1], lines[0], indexing="ij")
        point = np.empty((p.size, 3))
        point[:, a], point[:, b], point[:, axis] = p.ravel(), q.ravel(), sign * half[axis]
        core = np.clip(point, radius - half, half - radius)
        out = point - core
        vertices.append(core + radius * out / np.linalg.norm(out, axis=1, keepdims=True))
        faces.append(quads(len(lines[1]), len(lines[0])) + sum(len(v) for v in vertices[:-1]))
        cell = np.array([side % 3, side // 3])
        place = np.stack([p.ravel() + half[a], q.ravel() + half[b]], -1) / longest
        uv.append((cell + place) / [3, 2])
    picture = skin(rng, 3 * longest, 2 * longest, paint)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv), picture, smooth=True)


def turned(rng: np.random.Generator, paint: Paint, *profiles: list[tuple[Number, Number]]) -> Mesh:
    """A shape turned about z. Each profile is a smooth line of (radius, z); where two profiles meet there is
    an edge. Together they lead from the axis below, outside, to the axis above."""
    turns = np.linspace(0, 2 * np.pi, AROUND + 1)
    lengths = [np.linalg.norm(np.diff(np.array(p), axis=0), axis=1) for p in profiles]
    total = float(sum(length.sum() for length in lengths))
    vertices, faces, uv, done = [], [], [], 0.0
    for profile, length in zip(profiles, lengths, strict=True):
        r, z = np.array(profile, dtype=np.float64).T[:, :, None]
        r = np.maximum(r, TIP)
        ring = np.stack([r * np.cos(turns), r * np.sin(turns), z + 0 * turns], -1)
        faces.append(quads(len(profile), AROUND + 1) + sum(len(v) for v in vertices))
        vertices.append(ring.reshape(-1, 3))
        v = (done + np.concatenate([[0.0], np.cumsum(length)])) / total
        uv.append(np.stack(np.meshgrid(turns / (2 * np.pi), v), -1).reshape(-1, 2))
        done += float(length.sum())
    girth = 2 * np.pi * max(r for profile in profiles for r, _ in profile)
    picture = skin(rng, girth, total, paint)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv), picture, smooth=True)


def cylinder(
    rng: np.random.Generator, paint: Paint, radius: Number, low: Number, high: Number, bevel: Number = 0.02
) -> Mesh:
    """A cylinder about z with bevelled edges."""
    b = min(bevel, radius / 2, (high - low) / 3)
    corners = [
        (0, low),
        (radius - b, low),
        (radius, low + b),
        (radius, high - b),
        (radius - b, high),
        (0, high),
    ]
    return turned(rng, paint, *([p, q] for p, q in zip(corners[:-1], corners[1:], strict=True)))


def ball(rng: np.random.Generator, paint: Paint, radius: Number) -> Mesh:
    """A ball about the origin."""
    rise = np.linspace(-np.pi / 2, 0, 9)
    low = [(radius * np.cos(a), radius * np.sin(a)) for a in rise]
    profile = low + [(r, -z) for r, z in low[-2::-1]]
    return turned(rng, paint, [(float(r), float(z)) for r, z in profile])


def tube_mesh(
    rng: np.random.Generator, rings: Float[np.ndarray, "n around 3"], paint: Paint, coarse: Number = 1.0
) -> Mesh:
    """A mesh for `tube` as it is at rest."""
    n, around, _ = rings.shape
    length = float(np.linalg.norm(np.diff(rings.mean(1), axis=0), axis=1).sum())
    girth = float(np.linalg.norm(np.diff(rings, axis=1), axis=2).sum(1).max())
    uv = np.stack(np.meshgrid(np.linspace(0, 1, around), np.linspace(0, 1, n)), -1).reshape(-1, 2)
    picture = skin(rng, girth, length, paint, coarse)
    return Mesh(rings.reshape(-1, 3), quads(n, around), uv, picture, smooth=True)


def tube(
    spine: Float[np.ndarray, "n 3"],
    side: Float[np.ndarray, "n 3"],
    other: Float[np.ndarray, "n 3"],
    a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, " n"],
    around: int = 24,
) -> Float[np.ndarray, "n around 3"]:
    """Rings along a line: half axes `a` along `side` and `b` along `other`; side x other points along it."""
    turns = np.linspace(0, 2 * np.pi, around)[None, :, None]
    a, b = (np.maximum(x, TIP)[:, None, None] for x in (a, b))
    return spine[:, None] + a * np.cos(turns) * side[:, None] + b * np.sin(turns) * other[:, None]


def bent(
    length: Number, angle: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """A line from the origin in the x-z plane whose direction leans from z to x by `angle` (radians).

    Returns:
        The line, and the two directions across it for `tube`: in the plane, and along y.
    """
    along = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    steps = length / (len(angle) - 1) * (along[1:] + along[:-1]) / 2
    spine = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    side = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1)
    return spine, side, np.tile([0.0, 1.0, 0.0], (len(angle), 1))


def quads(rows: int, columns: int) -> np.ndarray:
    """Faces of a grid of vertices, row by row."""
    n = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
