"""Animated meshes as one binary glTF 2.0 file (.glb; Khronos, "glTF 2.0 Specification").

A mesh that changes its shape has one at every key time as a morph target; the animation fades from one to the next,
which moves each vertex along a straight line between key times. One that moves as a whole has a node that turns and
goes; if it stretches, too, that node also scales, along axes to which one inside turns the mesh. Colours are per vertex
and hold the light already, so the material is unlit. glTF counts in metres with y up: the first node turns the meshes'
own axes there.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from devrf.capture.colour.srgb import linear_from_srgb

MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, USHORT, UINT = 5126, 5123, 5125
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
NUMPY = {FLOAT: "<f4", USHORT: "<u2", UINT: "<u4"}
VERTICES, FACES = 34962, 34963  # what a buffer view is for


@dataclass(frozen=True)
class Way:
    """How a mesh moves as a whole: it turns about a point, which goes straight between key times.

    Attributes:
        pivot: The point at rest [3].
        rotations: From rest, at each key time [k, 3, 3].
        places: Of the point then [k, 3].
        stretches: Before it turns: symmetric matrices [k, 3, 3]; None: it is rigid.
    """

    pivot: Float[np.ndarray, "3"]
    rotations: Float[np.ndarray, "k 3 3"]
    places: Float[np.ndarray, "k 3"]
    stretches: Float[np.ndarray, "k 3 3"] | None = None

    def carried(self, rest: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "k v 3"]:
        """Where points that go along are at the key times."""
        linear = self.rotations if self.stretches is None else self.rotations @ self.stretches
        return np.einsum("kij,vj->kvi", linear, rest - self.pivot) + self.places[:, None]


@dataclass(frozen=True)
class GltfMesh:
    """One mesh.

    Attributes:
        name: What it is.
        vertices: At rest [v, 3].
        faces: Vertex numbers, counter-clockwise from outside.
        rgb: sRGB colours in [0, 1].
        shapes: Vertices at each key time, where it changes its shape.
        way: Where it moves as a whole.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    rgb: Float[np.ndarray, "v 3"]
    shapes: Sequence[Float[np.ndarray, "v 3"]] = ()
    way: Way | None = None


def write_glb(
    path: Path,
    meshes: Sequence[GltfMesh],
    times_s: Sequence[float],
    turn: Float[np.ndarray, "3 3"],
    name: str,
    extras: dict[str, Any],
) -> None:
    """Write the file.

    Args:
        path: The file.
        meshes: What is in it.
        times_s: Key times, seconds from the beginning, increasing; empty: nothing moves.
        turn: Rotation from the meshes' axes to glTF's.
        name: Of the whole.
        extras: Kept in the file, under `asset`.
    """
    parts, inner = _Parts(), _inner(meshes)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    root = {
        "name": name,
        "matrix": matrix.T.reshape(-1).tolist(),
        "children": [n + 1 for n in range(len(meshes))],
    }
    value: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "devrf", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            root,
            *(_node(mesh, n, inner[n][0] if n in inner else None) for n, mesh in enumerate(meshes)),
            *({"mesh": n} for n in inner),
        ],
        "meshes": [_mesh(parts, mesh) for mesh in meshes],
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    courses = [(n + 1, *course) for n, mesh in enumerate(meshes) for course in _courses(mesh)]
    courses += [(node, "rotation", _quaternions(_axes(way)[1].mT)) for node, way in inner.values()]
    if courses:
        keys = parts.add(np.array(times_s)[:, None], FLOAT, bounds=True)
        samplers, channels = [], []
        for node, moves, values in courses:
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": moves}})
            samplers.append({"input": keys, "output": parts.add(values, FLOAT), "interpolation": "LINEAR"})
        value["animations"] = [{"name": "motion", "samplers": samplers, "channels": channels}]
    value |= parts.described()
    text = json.dumps(value, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts.data)
    with path.open("wb") as file:
        file.write(struct.pack("<III", MAGIC, 2, 28 + len(text) + len(data)))
        file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", len(data), BIN_CHUNK) + data)


def _inner(meshes: Sequence[GltfMesh]) -> dict[int, tuple[int, Way]]:
    """Of meshes that stretch, by their numbers: the node inside theirs, which comes after all others, and the way."""
    soft = [(n, way) for n, mesh in enumerate(meshes) if (way := mesh.way) and way.stretches is not None]
    return {n: (1 + len(meshes) + k, way) for k, (n, way) in enumerate(soft)}


def _node(mesh: GltfMesh, number: int, inner: int | None) -> dict[str, Any]:
    held: dict[str, Any] = {"mesh": number} if inner is None else {"children": [inner]}
    node = held | {"name": mesh.name}
    return node if mesh.way is None else node | {"translation": mesh.way.pivot.tolist()}


def _mesh(parts: "_Parts", mesh: GltfMesh) -> dict[str, Any]:
    # glTF's colours are linear light
    colours = np.concatenate([linear_from_srgb(mesh.rgb), np.ones((len(mesh.rgb), 1))], axis=1)
    vertices = mesh.vertices if mesh.way is None else mesh.vertices - mesh.way.pivot
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": parts.add(vertices, FLOAT, VERTICES, bounds=True),
            "COLOR_0": parts.add(np.round(65535 * colours.clip(0, 1)), USHORT, VERTICES, normalized=True),
        },
        "indices": parts.add(mesh.faces.reshape(-1, 1), UINT, FACES),
        "material": 0,
    }
    shape: dict[str, Any] = {"primitives": [primitive], "name": mesh.name}
    if mesh.shapes:
        moves = [parts.add(s - mesh.vertices, FLOAT, VERTICES, bounds=True) for s in mesh.shapes]
        primitive["targets"] = [{"POSITION": move} for move in moves]
        shape["weights"] = np.eye(len(moves))[0].tolist()
    return shape


def _courses(mesh: GltfMesh) -> Iterator[tuple[str, np.ndarray]]:
    """What of a mesh's node changes, and its values at the key times."""
    if mesh.shapes:
        yield "weights", np.eye(len(mesh.shapes)).reshape(-1, 1)  # at each key time one shape alone
    if mesh.way is not None:
        lengths, axes = _axes(mesh.way)
        yield "rotation", _quaternions(mesh.way.rotations @ axes)
        yield "translation", mesh.way.places
        if mesh.way.stretches is not None:
            yield "scale", lengths


def _quaternions(rotations: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 4"]:
    quaternions = Rotation.from_matrix(rotations).as_quat()
    away = (quaternions[1:] * quaternions[:-1]).sum(1) < 0  # q and -q are one rotation: take the nearer
    quaternions[1:] *= np.where(np.cumsum(away) % 2, -1.0, 1.0)[:, None]
    return quaternions


def _axes(way: Way) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Lengths along the axes of stretches, and these as columns of rotations that turn little from key to key."""
    keys = len(way.rotations)
    lengths, axes = np.ones((keys, 3)), np.tile(np.eye(3), (keys, 1, 1))
    if way.stretches is None:
        return lengths, axes
    before = np.eye(3)
    for k, (values, vectors) in enumerate(zip(*np.linalg.eigh(way.stretches), strict=True)):
        order = linear_sum_assignment(-np.abs(before.T @ vectors))[1]
        turned = vectors[:, order] * np.where((before * vectors[:, order]).sum(0) < 0, -1.0, 1.0)
        if np.linalg.det(turned) < 0:  # a mirror image: turn the axis that agrees least
            turned[:, (before * turned).sum(0).argmin()] *= -1
        lengths[k], axes[k], before = values[order], turned, turned
    return lengths, axes


class _Parts:
    """Arrays of a file, one behind the other, and what its JSON says of them."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.size = 0

    def add(
        self,
        values: np.ndarray,
        kind: int,
        target: int | None = None,
        *,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Add rows of numbers; returns the accessor's number."""
        rows = np.ascontiguousarray(values.astype(NUMPY[kind]))
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view | ({"target": target} if target is not None else {}))
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(rows),
            "type": KINDS[rows.shape[1]],
        }
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor | ({"normalized": True} if normalized else {}))
        pad = -rows.nbytes % 4
        self.data.append(rows.tobytes() + b"\0" * pad)
        self.size += rows.nbytes + pad
        return len(self.accessors) - 1

    def described(self) -> dict[str, Any]:
        return {
            "buffers": [{"byteLength": self.size}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
