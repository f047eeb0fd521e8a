"""How far two recoveries of the same pictures differ: by two mappers, or by two seeds."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from devrf.calibration.truth import rotation_angle_deg

ROUNDS = 10  # of reweighting; the common turn is found when most pictures agree


def disagreement_deg(
    first: Mapping[str, Float[np.ndarray, "3 4"]], second: Mapping[str, Float[np.ndarray, "3 4"]]
) -> dict[str, float]:
    """Angle between both `cam_from_world` of each picture after the one turn that suits most of them, degrees."""
    names = sorted(set(first) & set(second))
    if not names:
        return {}
    between = np.array([first[n][:, :3].T @ second[n][:, :3] for n in names])  # first world from second world
    weights, turn = np.ones(len(names)), np.eye(3)
    for _ in range(ROUNDS):
        U, _, Vt = np.linalg.svd((weights[:, None, None] * between).sum(0))
        turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        off = np.linalg.norm(between - turn, axis=(1, 2))
        weights = 1 / np.maximum(off, 1e-6)  # least absolute chords: single pictures do not turn all others
    return {n: rotation_angle_deg(b, turn) for n, b in zip(names, between, strict=True)}
