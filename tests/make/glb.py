"""Moving meshes out of a binary glTF file, by the specification alone: no library at hand reads morph targets."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from devrf.capture.colour.srgb import srgb_from_linear

KINDS = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class ReadMesh:
    """All meshes of a file as one, in the axes of its first node: at rest and at each key time; colours as sRGB."""

    vertices: np.ndarray
    faces: np.ndarray
    rgb: np.ndarray
    shapes: list[np.ndarray]
    times_s: list[float]
    turn: np.ndarray
    names: list[str]


def read_glb(path: Path) -> ReadMesh:
    """Everything that is shown, at the key times."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    value: dict[str, Any] = json.loads(data[20 : 20 + length])

    def array(number: int) -> np.ndarray:
        accessor = value["accessors"][number]
        start, columns = value["bufferViews"][accessor["bufferView"]]["byteOffset"], COLUMNS[accessor["type"]]
        kind = KINDS[accessor["componentType"]]
        flat = np.frombuffer(data, kind, accessor["count"] * columns, 28 + length + start)
        return flat.reshape(-1, columns).astype(np.float64) / (65535 if accessor.get("normalized") else 1)

    (animation,) = value.get("animations", [{"samplers": [], "channels": []}])
    samplers = animation["samplers"]
    times_s = array(samplers[0]["input"])[:, 0].tolist() if samplers else []
    courses = {
        (channel["target"]["node"], channel["target"]["path"]): array(samplers[channel["sampler"]]["output"])
        for channel in animation["channels"]
    }
    root = value["nodes"][0]
    vertices, faces, rgb, shapes = [], [], [], [[] for _ in times_s]
    for number in root["children"]:
        node = value["nodes"][number]
        (inner,) = node.get("children", [None])
        (primitive,) = value["meshes"][(node if inner is None else value["nodes"][inner])["mesh"]][
            "primitives"
        ]
        own = array(primitive["attributes"]["POSITION"])
        place = np.array(node.get("translation", [0.0, 0.0, 0.0]))
        faces.append(array(primitive["indices"]).astype(np.int64).reshape(-1, 3) + sum(map(len, vertices)))
        rgb.append(srgb_from_linear(array(primitive["attributes"]["COLOR_0"])[:, :3]))
        vertices.append(own + place)
        targets = [own + array(target["POSITION"]) for target in primitive.get("targets", [])]
        for k, shape in enumerate(shapes):
            now = targets[k] if targets else own
            if inner is not None:
                now = now @ Rotation.from_quat(courses[inner, "rotation"][k]).as_matrix().T
                now = now * courses[number, "scale"][k]
            if (number, "rotation") in courses:
                now = now @ Rotation.from_quat(courses[number, "rotation"][k]).as_matrix().T
            shape.append(now + courses.get((number, "translation"), np.tile(place, (k + 1, 1)))[k])
    turn = np.array(root["matrix"]).reshape(4, 4).T[:3, :3]
    names = [value["nodes"][number]["name"] for number in root["children"]]
    joined = [np.concatenate(shape) for shape in shapes]
    whole = np.concatenate(vertices), np.concatenate(faces), np.concatenate(rgb)
    return ReadMesh(*whole, joined, times_s, turn, names)
