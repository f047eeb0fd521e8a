"""3D Gaussians as the PLY file that viewers of 3D Gaussian splatting open (the published program's layout).

Per vertex, all 32-bit floats: x y z, nx ny nz (zero), f_dc_0..2 (colour: RGB = 0.5 + SH0 f_dc), opacity (before the
sigmoid), scale_0..2 (logarithms of the standard deviations), rot_0..3 (unit quaternion w x y z).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

SH0 = 0.28209479177387814  # the spherical harmonic of degree 0: 1 / (2 sqrt(pi))
NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{k}" for k in range(3)),
    "opacity",
    *(f"scale_{k}" for k in range(3)),
    *(f"rot_{k}" for k in range(4)),
)


def write_splat_ply(
    path: Path,
    xyz: Float[np.ndarray, "n 3"],
    rgb: Float[np.ndarray, "n 3"],
    logits: Float[np.ndarray, " n"],
    log_scales: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    comments: Sequence[str] = (),
) -> None:
    """Write Gaussians; colours in [0, 1], quaternions w x y z of any length but 0."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    values = [xyz, np.zeros_like(xyz), (rgb - 0.5) / SH0, logits[:, None], log_scales, unit]
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    head += [f"element vertex {len(xyz)}", *(f"property float {name}" for name in NAMES), "end_header", ""]
    body = np.concatenate(values, axis=1).astype("<f4").tobytes()
    path.write_bytes("\n".join(head).encode("ascii", "replace") + body)
