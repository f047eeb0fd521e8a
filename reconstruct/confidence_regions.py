"""Which parts of the subject are known worst, in every direction that the sweep looked from.

The model is rendered, small, from a few places of the sweep at a few times, as nobody may have filmed it. What is seen
in the box is sorted by where it rests into a coarse grid; where things move only what moves is taken. Directions are
named as one camera sees them: a crew stands behind a camera, not in a coordinate system.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.confidence import Confidence
from devrf.reconstruct.error_causes import surface_of
from devrf.reconstruct.evidence import SOLID, witness_scale
from devrf.reconstruct.pictures import spread, training

CELLS = 4  # along each axis of what is there
DIRECTIONS = 4  # of the sweep
TIMES = (1 / 3, 2 / 3)  # of the clip, where something moves
FEWEST = 0.005  # of all points: a cell with less is the rim of others
MOVED_PX = 1.0  # of the training size, from which a point moves
LEAST_MOVING = 0.02  # of the points, to be the subject: the box is made around what moves, less is stray
LOW_DB = 18.0  # expected PSNR, below which test views are doubted, too
OUTER = 1 / 3  # of the extent at either end is called left, right, ...; between is the middle


@dataclass(frozen=True)
class Region:
    """A cell of the grid.

    Attributes:
        where: In words, as `as_seen_by` sees it.
        share: Of the subject's pixels.
        expected_rms: Grey levels.
        low: Share of its pixels that are expected to be worse than `LOW_DB`.
        cameras: Mean number of moving cameras that see it at a time, or of pictures of the sweep (`moves` false).
    """

    where: str
    share: float
    expected_rms: float
    low: float
    cameras: float


def weakest_regions(scene: Scene, confidence: Confidence) -> dict[str, Any]:
    """All regions, the worst first, and what holds for the whole subject.

    Args:
        scene: In any frame.
        confidence: Of the model.
    Returns:
        `as_seen_by`: name of a camera; `moves`: whether only what moves was taken; `low_above`: grey levels that count
        as low confidence; `low_share` of the subject (None where nothing of it is seen); `unseen_share`: of what moves,
        what no moving camera sees at that time (None where not only what moves was taken); `regions`.
    """
    scene = scene.in_box_frame()
    found = _Points(scene, confidence)
    name, reference = _reference(scene)
    low_above = 10 ** (-LOW_DB / 20)
    known = {"as_seen_by": name, "moves": found.moves, "low_above": 255 * low_above}
    if not len(found.expected):
        return {**known, "low_share": None, "unseen_share": None, "regions": []}
    cells = _cells(found.at_rest)
    words = _Words(reference, found.at_rest)
    regions = []
    for cell in np.unique(cells):
        here = cells == cell
        if here.mean() < FEWEST:
            continue
        expected = found.expected[here]
        regions.append(
            Region(
                where=words(found.at_rest[here].mean(axis=0)),
                share=float(here.mean()),
                expected_rms=255 * float(np.sqrt((expected**2).mean())),
                low=float((expected > low_above).mean()),
                cameras=float(found.cameras[here].mean()),
            )
        )
    regions.sort(key=lambda region: -region.expected_rms)
    low_share = float((found.expected > low_above).mean())
    unseen_share = float((found.cameras == 0).mean()) if found.moves else None
    return {
        **known,
        "low_share": low_share,
        "unseen_share": unseen_share,
        "regions": [asdict(region) for region in regions],
    }


class _Points:
    """What the small pictures show: where it rests, its expected error, who sees it.

    Attributes:
        at_rest: In the box frame [n, 3].
        expected: Root of the expected squared error [n].
        cameras: How many moving cameras see it, or pictures of the sweep where not only what moves was taken [n].
        moves: Whether only what moves was taken.
    """

    def __init__(self, scene: Scene, confidence: Confidence) -> None:
        evidence = confidence.evidence
        parts = []
        for frame in spread(training(scene.static), DIRECTIONS):
            scale = witness_scale(frame.camera, scene.image_scale)
            camera = frame.camera.scaled(scale)
            for time in TIMES if evidence.fixed else (None,):
                layers = confidence.render(camera, time)
                surface = surface_of(evidence, camera, time, layers)
                expected = confidence.expected_of(surface, camera, layers)
                expected = expected[np.ix_(surface.rows, surface.columns)].reshape(-1)
                moved_px = surface.moved * camera.K[0, 0] * scene.image_scale / scale / surface.distance
                in_motion, at_rest = (surface.motion or surface.rest).count, surface.rest.count
                solid = surface.opacity.reshape(-1) > SOLID
                columns = (surface.places.at_rest, expected, in_motion, at_rest, moved_px > MOVED_PX)
                parts.append([column[solid] for column in columns])
        places, expected, in_motion, at_rest, moving = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        self.moves = len(moving) > 0 and bool(moving.mean() >= LEAST_MOVING)
        kept = moving if self.moves else slice(None)
        self.at_rest, self.expected = places[kept], expected[kept]
        self.cameras = (in_motion if self.moves else at_rest)[kept]


class _Words:
    """Names of places as a camera sees them."""

    def __init__(self, camera: Camera, points: Float[np.ndarray, "n 3"]) -> None:
        self._axes = camera.cam_from_world[:, :3] * [[1], [-1], [1]]  # right, up, away
        along = points @ self._axes.T
        self._low, self._high = np.percentile(along, [2, 98], axis=0)

    def __call__(self, point: Float[np.ndarray, "3"]) -> str:
        share = (self._axes @ point - self._low) / np.maximum(self._high - self._low, 1e-9)
        names = (("left", "right"), ("low", "high"), ("front", "back"))
        said = [
            pair[int(x > 0.5)] for x, pair in zip(share, names, strict=True) if not OUTER <= x <= 1 - OUTER
        ]
        return ", ".join(said) or "middle"


def _reference(scene: Scene) -> tuple[str, Camera]:
    """The camera that directions are named after: the first of the moving scene, else the sweep's first."""
    frames: Sequence[PosedFrame] = training(scene.dynamic) or training(scene.static)
    first = min(frames, key=lambda f: (f.camera_name, f.index))
    return ("the first sweep picture" if first.time is None else first.camera_name), first.camera


def _cells(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Number of the cell of each point, of a grid over what is there."""
    low, high = np.percentile(points, [1, 99], axis=0)
    at = np.clip((points - low) / np.maximum(high - low, 1e-9) * CELLS, 0, CELLS - 1).astype(int)
    return at @ np.array([CELLS * CELLS, CELLS, 1])
