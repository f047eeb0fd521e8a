"""PLY files (Turk 1994, "The PLY Polygon File Format"): points or triangle meshes, binary, little endian.

Vertices carry x, y, z, then normals nx, ny, nz where there are some, and 8-bit sRGB red, green, blue.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

TYPES = {"f4": "float", "u1": "uchar"}
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_ply(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    rgb: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a point cloud, or with faces (vertex numbers, counter-clockwise from outside) a mesh; sRGB in [0, 1]."""
    lengths = [*xyz.T, *(() if normals is None else normals.T)]
    names = ["x", "y", "z", "nx", "ny", "nz"][: len(lengths)]
    layout = np.dtype([*((n, "<f4") for n in names), *((n, "u1") for n in ("red", "green", "blue"))])
    vertices = np.empty(len(xyz), layout)
    codes = np.round(255 * rgb.clip(0, 1))
    for name, values in zip(layout.names or (), [*lengths, *codes.T], strict=True):
        vertices[name] = values
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    head += [f"element vertex {len(xyz)}"]
    head += [f"property {TYPES[layout[name].str[1:]]} {name}" for name in layout.names or ()]
    body = vertices.tobytes()
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(faces), FACE)
        rows["count"], rows["vertices"] = 3, faces
        body += rows.tobytes()
    path.write_bytes("\n".join([*head, "end_header", ""]).encode("ascii", "replace") + body)
