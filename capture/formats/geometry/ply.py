"""PLY files (Turk 1994, "The PLY Polygon File Format"), binary, little endian: points, 3D Gaussians.

Points carry x, y, z, then normals nx, ny, nz where there are some, and 8-bit sRGB red, green, blue. Gaussians have the
published program's layout, which viewers of 3D Gaussian splatting open, all 32-bit floats: x y z, nx ny nz (zero),
f_dc_0..2 (colour: RGB = 0.5 + SH0 f_dc), opacity (before the sigmoid), scale_0..2 (logarithms of the standard
deviations), rot_0..3 (unit quaternion w x y z).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

TYPES = {"f4": "float", "u1": "uchar"}
SH0 = 0.28209479177387814  # the spherical harmonic of degree 0: 1 / (2 sqrt(pi))
OF_SPLATS = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
)


def write_ply(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    rgb: Float[np.ndarray, "n 3"],
    comments: Sequence[str] = (),
) -> None:
    """Write a point cloud; sRGB colours in [0, 1]."""
    lengths = [*xyz.T, *(() if normals is None else normals.T)]
    names = ["x", "y", "z", "nx", "ny", "nz"][: len(lengths)]
    layout = np.dtype([*((n, "<f4") for n in names), *((n, "u1") for n in ("red", "green", "blue"))])
    vertices = np.empty(len(xyz), layout)
    codes = np.round(255 * rgb.clip(0, 1))
    for name, values in zip(layout.names or (), [*lengths, *codes.T], strict=True):
        vertices[name] = values
    head = [f"property {TYPES[layout[name].str[1:]]} {name}" for name in layout.names or ()]
    _write(path, len(xyz), head, vertices.tobytes(), comments)


@dataclass(frozen=True)
class GaussianVertices:
    """3D Gaussians to be written.

    Attributes:
        xyz: Centres.
        rgb: Colours in [0, 1].
        logits: Opacities before the sigmoid.
        log_scales: Logarithms of the standard deviations.
        quats: Orientations w x y z, of any length but 0.
    """

    xyz: Float[np.ndarray, "n 3"]
    rgb: Float[np.ndarray, "n 3"]
    logits: Float[np.ndarray, " n"]
    log_scales: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]


def write_splat_ply(path: Path, splats: GaussianVertices, comments: Sequence[str] = ()) -> None:
    """Write Gaussians."""
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    colours = (splats.rgb - 0.5) / SH0
    values = [splats.xyz, np.zeros_like(splats.xyz), colours, splats.logits[:, None], splats.log_scales, unit]
    body = np.concatenate(values, axis=1).astype("<f4").tobytes()
    _write(path, len(splats.xyz), [f"property float {name}" for name in OF_SPLATS], body, comments)


def _write(path: Path, count: int, properties: list[str], body: bytes, comments: Sequence[str]) -> None:
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    head += [f"element vertex {count}", *properties, "end_header", ""]
    path.write_bytes("\n".join(head).encode("ascii", "replace") + body)
