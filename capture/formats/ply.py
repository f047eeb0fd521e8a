"""PLY files (Turk 1994, "The PLY Polygon File Format"): points or triangle meshes, binary, little endian.

Vertices carry x, y, z, then normals nx, ny, nz where there are some, and 8-bit sRGB red, green, blue. `read_ply` reads
back what `write_ply` wrote, for checks.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.errors import CaptureError

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


def read_positions(path: Path) -> Float[np.ndarray, "n 3"]:
    """Positions of the vertices of a file that `write_ply` wrote.

    Raises:
        CaptureError: It is no such file, or is cut off.
    """
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    try:
        count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
        at = lines.index(f"element vertex {count}") + 1
        types = {name: code for code, name in TYPES.items()}
        rows = [line.split() for line in lines[at:] if line.startswith("property") and "list" not in line]
        vertices = np.frombuffer(body, np.dtype([(name, "<" + types[kind]) for _, kind, name in rows]), count)
        return np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    except (StopIteration, ValueError, KeyError) as error:
        raise CaptureError(f"{path}: not the PLY file that was written ({error or 'no vertices'})") from None
