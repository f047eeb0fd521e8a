"""What was exported is read back and held against what was meant, in pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.errors import CaptureError
from devrf.capture.scene import Scene

LARGEST_MISS_PX = 0.2
POINTS = 200


@dataclass(frozen=True)
class RoundTrip:
    """What came of it.

    Attributes:
        points: How many points were projected.
        cameras: Into how many cameras.
        worst_px: Largest distance between where the two see a point.
    """

    points: int
    cameras: int
    worst_px: float

    def said(self, whose: str) -> str:
        """In words; `whose`: what was read back."""
        return (
            f"checked on writing: {self.points} points, projected by way of {whose} as read back, lie within "
            f"{self.worst_px:.2g} px of where {self.cameras} cameras of the scene see them (allowed: "
            f"{LARGEST_MISS_PX:g} px)"
        )


def of_cameras(scene: Scene, pairs: Sequence[tuple[Camera, Camera]], where: str) -> RoundTrip:
    """Points of the scene's box in cameras as they were meant and as they were read back.

    Args:
        scene: In the world of the cameras.
        pairs: Meant, read back.
        where: Names the export in the message.
    Raises:
        CaptureError: They differ by more than `LARGEST_MISS_PX`.
    """
    rng = np.random.default_rng(0)
    points = _from_box(scene, rng.uniform(scene.aabb[0], scene.aabb[1], (POINTS, 3)))
    return of_rig(points, pairs, where)


def of_rig(points: Float[np.ndarray, "n 3"], pairs: Sequence[tuple[Camera, Camera]], where: str) -> RoundTrip:
    """The same of points that are given, in the world of the cameras."""
    worst = max((_apart(a.project(points), b.project(points)) for a, b in pairs), default=np.inf)
    return _judged(RoundTrip(len(points), len(pairs), worst), where)


def of_points(
    scene: Scene, meant: Float[np.ndarray, "n 3"], again: Float[np.ndarray, "n 3"], where: str
) -> RoundTrip:
    """Points that were read back in the world, seen by the scene's cameras, against the box frame's.

    Args:
        scene: In the world.
        meant: In the box frame.
        again: The same points, as they stand in the file.
        where: Names the export in the message.
    Raises:
        CaptureError: Their number is another, or they differ by more than `LARGEST_MISS_PX`.
    """
    if len(meant) != len(again):
        raise CaptureError(f"{where}: {len(meant)} points were written, {len(again)} are read back")
    some = np.linspace(0, len(meant) - 1, min(POINTS, len(meant))).astype(int)
    cameras = [f.camera for f in scene.frames[:: max(1, len(scene.frames) // POINTS)]]
    worst = max(
        _apart(c.moved(scene.box_from_world).project(meant[some]), c.project(again[some])) for c in cameras
    )
    return _judged(RoundTrip(len(some), len(cameras), worst), where)


def _from_box(scene: Scene, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    matrix = np.linalg.inv(scene.box_from_world)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _apart(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> float:
    """Largest distance; infinite where only one of them sees a point."""
    seen = np.isfinite(a).all(-1)
    if (seen != np.isfinite(b).all(-1)).any():
        return float("inf")
    return float(np.linalg.norm(a[seen] - b[seen], axis=1).max(initial=0.0))


def _judged(found: RoundTrip, where: str) -> RoundTrip:
    if found.worst_px <= LARGEST_MISS_PX:
        return found
    raise CaptureError(
        f"{where}: read back, points lie {found.worst_px:.3g} px from where they were (allowed: {LARGEST_MISS_PX:g} "
        "px); nothing is left there; please report this with the scene folder of the run"
    )
