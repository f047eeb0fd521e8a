"""A moving mesh out of a binary glTF file, by the specification alone: no library at hand reads morph targets."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.formats.gltf import AnimatedMesh
from devrf.capture.srgb import srgb_from_linear

KINDS = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path) -> AnimatedMesh:
    """The first mesh of a file: shapes in its own axes, colours as sRGB."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    value: dict[str, Any] = json.loads(data[20 : 20 + length])

    def array(number: int) -> np.ndarray:
        accessor = value["accessors"][number]
        start, columns = value["bufferViews"][accessor["bufferView"]]["byteOffset"], COLUMNS[accessor["type"]]
        kind = KINDS[accessor["componentType"]]
        flat = np.frombuffer(data, kind, accessor["count"] * columns, 28 + length + start)
        return flat.reshape(-1, columns).astype(np.float64) / (65535 if accessor.get("normalized") else 1)

    (primitive,) = value["meshes"][0]["primitives"]
    vertices = array(primitive["attributes"]["POSITION"])
    shapes = [vertices + array(target["POSITION"]) for target in primitive.get("targets", [])]
    rgb = srgb_from_linear(array(primitive["attributes"]["COLOR_0"])[:, :3])
    faces = array(primitive["indices"]).astype(np.int64).reshape(-1, 3)
    samplers = [animation["samplers"][0]["input"] for animation in value.get("animations", [])]
    times_s = array(samplers[0])[:, 0].tolist() if samplers else []
    turn = np.array(value["nodes"][0]["matrix"]).reshape(4, 4).T[:3, :3]
    return AnimatedMesh(vertices, faces, rgb, shapes, times_s, turn)
