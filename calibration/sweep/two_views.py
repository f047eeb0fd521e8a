"""What pairs of pictures say, beside the model: COLMAP's kinds of pairs, and matches that do not fit the model.

COLMAP calls a pair PLANAR, PANORAMIC or PLANAR_OR_PANORAMIC where a homography explains at least 0.8 as many
matches as an essential or fundamental matrix, and WATERMARK where matches at the border do not move.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.capture.camera import Camera, undistort
from devrf.capture.system.arrays import read_npz

FITS_PX = 4.0  # from the epipolar line: COLMAP's own bound for an inlier of a pair
STRONG_PAIR = 100  # inliers; COLMAP begins a model with such a pair, so it can decide where things are
# Of a pair's inliers do not fit the model: the pair agrees with itself, not with the others.
CONTRADICTS = 0.5
TRUE_PAIR, TRUE_MATCHES = 0.7, 30  # of a pair's matches fit the model: its others are not wrong by chance
NEIGHBOURS = 2  # pictures of a film so near to each other show the same place
TILES = 8  # per side of a picture, for what moves in it
TILE_MATCHES = 8  # a tile with fewer says nothing
TILE_MOVES = 0.5  # of a tile's matches do not fit
HOMOGRAPHY = ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")


@dataclass(frozen=True)
class TwoViews:
    """Verified pairs.

    Attributes:
        names: Pictures, sorted [N].
        pairs: Rows of both pictures [P, 2].
        kinds: COLMAP's kind of each pair [P].
        match_pair, match_xy, match_inlier: Every match's pair, pixels in both pictures, whether it fits the
            pair's own geometry [M], [M, 2, 2], [M].
    """

    names: tuple[str, ...]
    pairs: Int[np.ndarray, "pairs 2"]
    kinds: tuple[str, ...]
    match_pair: Int[np.ndarray, " matches"]
    match_xy: Float[np.ndarray, "matches 2 2"]
    match_inlier: Bool[np.ndarray, " matches"]


def read_two_views(file: Path) -> TwoViews:
    """Read what the worker wrote."""
    arrays = read_npz(file, text=True)
    names, kinds = (tuple(arrays.pop(key).tolist()) for key in ("names", "kinds"))
    return TwoViews(names=names, kinds=kinds, **arrays)


def kinds_report(views: TwoViews) -> dict[str, Any]:
    """How many pairs were verified, and shares of COLMAP's kinds."""
    kinds, count = Counter(views.kinds), max(1, len(views.kinds))
    return {
        "verified": len(views.kinds),
        "kinds": dict(sorted(kinds.items())),
        "homography_share": sum(kinds[kind] for kind in HOMOGRAPHY) / count,
        "watermark_share": kinds["WATERMARK"] / count,
    }


def against_model(views: TwoViews, cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Pairs and places in pictures that contradict the model.

    Args:
        views: The pairs.
        cameras: The model's cameras by picture.
    Returns:
        `strong_pairs`: how many pairs with `STRONG_PAIR` inliers are between registered pictures;
        `contradicting`: those whose inliers do not fit the model (repeated texture, merged sides);
        `moving`: by picture, the share of its textured tiles whose matches do not fit in pairs that fit as a
        whole: what moves stays together, what is wrong by chance does not. Pictures without are left out.
    """
    off = epipolar_px(views, cameras)
    known = np.isfinite(off)
    fits = off <= FITS_PX
    count = len(views.pairs)
    of_all, of_inliers = (np.bincount(views.match_pair[known & m], minlength=count)
                          for m in (np.ones(len(off), dtype=bool), views.match_inlier))  # fmt: skip
    fit_all, fit_inliers = (np.bincount(views.match_pair[fits & m], minlength=count)
                            for m in (np.ones(len(off), dtype=bool), views.match_inlier))  # fmt: skip
    strong = of_inliers >= STRONG_PAIR
    wrong = strong & (fit_inliers < CONTRADICTS * of_inliers)
    true = (fit_all >= TRUE_MATCHES) & (fit_all > TRUE_PAIR * of_all)
    used = known & true[views.match_pair]
    contradicting = [
        {"names": [views.names[a], views.names[b]], "inliers": int(of_inliers[n]), "fit": int(fit_inliers[n])}
        for n, (a, b) in enumerate(views.pairs.tolist())
        if wrong[n]
    ]
    return {
        "strong_pairs": int(strong.sum()),
        "contradicting": sorted(contradicting, key=lambda pair: -pair["inliers"]),
        "moving": _moving(views, cameras, used, ~fits),
    }


def torn_apart(names: Sequence[str], contradicting: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Neighbours of a film among the pairs that contradict the model: there it follows a repeated texture instead.

    Args:
        names: Pictures of the film, in order.
        contradicting: As `against_model` has them.
    """
    row = {name: n for n, name in enumerate(names)}
    found = (pair["names"] for pair in contradicting)
    return sorted(pair for pair in found if abs(row[pair[0]] - row[pair[1]]) <= NEIGHBOURS)


def epipolar_px(views: TwoViews, cameras: Mapping[str, Camera]) -> Float[np.ndarray, " matches"]:
    """Sampson distance of every match from the model's epipolar geometry, pixels; NaN where a picture is not in it.

    A point at rest, seen by two cameras of the model, is as near as the model's own reprojection error,
    however short the way between the cameras (Hartley & Zisserman, 2nd ed., 11.4.3).
    """
    off = np.full(len(views.match_pair), np.nan)
    order = np.argsort(views.match_pair, kind="stable")
    ends = np.searchsorted(views.match_pair[order], np.arange(len(views.pairs) + 1))
    for n, (a, b) in enumerate(views.pairs.tolist()):
        first, second = cameras.get(views.names[a]), cameras.get(views.names[b])
        mine = order[ends[n] : ends[n + 1]]
        if first is None or second is None or not len(mine):
            continue
        x, y = (_normalised(c, views.match_xy[mine, k]) for k, c in enumerate((first, second)))
        R = second.cam_from_world[:, :3] @ first.cam_from_world[:, :3].T
        t = second.cam_from_world[:, 3] - R @ first.cam_from_world[:, 3]
        E = np.cross(np.eye(3), t / max(float(np.linalg.norm(t)), 1e-12)) @ R
        to, back = x @ E.T, y @ E
        across = np.sqrt((to[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
        focal = (first.K[0, 0] + second.K[0, 0]) / 2
        off[mine] = focal * np.abs((y * to).sum(1)) / np.maximum(across, 1e-12)
    return off


def _moving(
    views: TwoViews, cameras: Mapping[str, Camera], used: np.ndarray, wrong: np.ndarray
) -> dict[str, float]:
    matches = np.zeros((len(views.names), TILES * TILES))
    outliers = np.zeros_like(matches)
    for side in (0, 1):
        image = views.pairs[views.match_pair[used], side]
        size = np.array([[c.width, c.height] if (c := cameras.get(n)) else [1, 1] for n in views.names])
        cell = np.clip(TILES * views.match_xy[used, side] / size[image], 0, TILES - 1).astype(np.int64)
        tile = cell[:, 1] * TILES + cell[:, 0]
        np.add.at(matches, (image, tile), 1)
        np.add.at(outliers, (image, tile), wrong[used])
    enough = matches >= TILE_MATCHES
    moves = enough & (outliers > TILE_MOVES * matches)
    counts = zip(views.names, moves.sum(1).tolist(), enough.sum(1).tolist(), strict=True)
    return {name: count / textured for name, count, textured in counts if count}


def _normalised(camera: Camera, xy: np.ndarray) -> np.ndarray:
    x = (xy - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    return np.column_stack([undistort(x, camera.distortion, camera.model), np.ones(len(x))])
