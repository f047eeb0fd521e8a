"""An animated mesh as one binary glTF 2.0 file (.glb; Khronos, "glTF 2.0 Specification").

One mesh, whose shape at every key time is a morph target; the animation fades from one to the next, which moves each
vertex along a straight line between key times. Colours are per vertex and hold the light already, so the material is
unlit. glTF counts in metres with y up: the node turns the mesh's own axes there.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.srgb import linear_from_srgb

MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, USHORT, UINT = 5126, 5123, 5125
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
NUMPY = {FLOAT: "<f4", USHORT: "<u2", UINT: "<u4"}
VERTICES, FACES = 34962, 34963  # what a buffer view is for


@dataclass(frozen=True)
class AnimatedMesh:
    """What is written.

    Attributes:
        vertices: At rest [v, 3].
        faces: Vertex numbers, counter-clockwise from outside.
        rgb: sRGB colours in [0, 1].
        shapes: Vertices at each key time; empty: nothing moves.
        times_s: Key times, seconds from the beginning, increasing.
        turn: Rotation from the vertices' axes to glTF's.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    rgb: Float[np.ndarray, "v 3"]
    shapes: list[Float[np.ndarray, "v 3"]]
    times_s: list[float]
    turn: Float[np.ndarray, "3 3"]


def write_glb(path: Path, mesh: AnimatedMesh, name: str, extras: dict[str, Any]) -> None:
    """Write the file; `extras` are kept in it, under `asset`."""
    parts = _Parts()
    colours = np.concatenate(
        [linear_from_srgb(mesh.rgb), np.ones((len(mesh.rgb), 1))], axis=1
    )  # glTF's colours are linear light
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": parts.add(mesh.vertices, FLOAT, VERTICES, bounds=True),
            "COLOR_0": parts.add(np.round(65535 * colours.clip(0, 1)), USHORT, VERTICES, normalized=True),
        },
        "indices": parts.add(mesh.faces.reshape(-1, 1), UINT, FACES),
        "material": 0,
    }
    shape: dict[str, Any] = {"primitives": [primitive], "name": name}
    turn = np.eye(4)
    turn[:3, :3] = mesh.turn
    value: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "devrf", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name, "matrix": turn.T.reshape(-1).tolist()}],
        "meshes": [shape],
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    if mesh.shapes:
        moves = [parts.add(s - mesh.vertices, FLOAT, VERTICES, bounds=True) for s in mesh.shapes]
        primitive["targets"] = [{"POSITION": move} for move in moves]
        weights = np.eye(len(mesh.shapes))  # at each key time one shape alone
        shape["weights"] = weights[0].tolist()
        sampler = {
            "input": parts.add(np.array(mesh.times_s)[:, None], FLOAT, bounds=True),
            "output": parts.add(weights.reshape(-1, 1), FLOAT),
            "interpolation": "LINEAR",
        }
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        value["animations"] = [{"name": "motion", "samplers": [sampler], "channels": [channel]}]
    value |= parts.described()
    text = json.dumps(value, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts.data)
    with path.open("wb") as file:
        file.write(struct.pack("<III", MAGIC, 2, 28 + len(text) + len(data)))
        file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", len(data), BIN_CHUNK) + data)


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
