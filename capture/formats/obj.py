"""Wavefront OBJ meshes with a colour per vertex (`v x y z r g b`, which Blender, MeshLab and trimesh read)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int


def write_obj(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    rgb: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    comments: Sequence[str] = (),
) -> None:
    """Write a mesh; sRGB colours in [0, 1]; faces counter-clockwise from outside, by vertex numbers from 0."""
    with path.open("w", encoding="ascii", errors="replace") as file:
        file.writelines(f"# {text}\n" for text in comments)
        np.savetxt(file, np.concatenate([xyz, rgb], axis=1), "v %.6f %.6f %.6f %.4f %.4f %.4f")
        np.savetxt(file, normals, "vn %.4f %.4f %.4f")
        np.savetxt(file, np.repeat(faces + 1, 2, axis=1), "f %d//%d %d//%d %d//%d")
