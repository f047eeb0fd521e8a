"""What verified pairs of pictures say, before and beside the model: COLMAP's kinds of pairs, matches that do not
fit, relative turns that contradict the model.

COLMAP calls a pair PLANAR, PANORAMIC or PLANAR_OR_PANORAMIC where a homography explains at least 0.8 as many
matches as an essential or fundamental matrix, and WATERMARK where matches at the border do not move.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.calibration.truth import rotation_angle_deg

STRONG_PAIR = 30  # inliers; pairs with fewer are wrong now and then
TILES = 8  # per side of a picture, for what moves in it
TILE_MATCHES = 8  # a tile with fewer says nothing
TILE_MOVES = 0.5  # of a tile's matches do not fit, ...
USUAL_OUTLIERS = 0.25  # ... and that much more than in the rest of the picture
CONTRADICTS_DEG = 10.0  # GLOMAP's limit for a relative turn against the averaged ones
HOMOGRAPHY = ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")


@dataclass(frozen=True)
class TwoViews:
    """Verified pairs.

    Attributes:
        names: Pictures, sorted [N].
        size: Width, height [N, 2].
        turn: Rotation of `cam_from_world` in the model [N, 3, 3]; NaN for pictures that are not in it.
        pairs: Rows of both pictures [P, 2].
        kinds: COLMAP's kind of each pair [P].
        inliers: Matches that fit [P].
        relative: Rotation of `second_from_first` by the pair alone [P, 3, 3]; NaN where it has none.
        match_pair, match_xy, match_inlier: Every match's pair, pixels in both pictures, whether it fits
            [M], [M, 2, 2], [M].
    """

    names: tuple[str, ...]
    size: Int[np.ndarray, "images 2"]
    turn: Float[np.ndarray, "images 3 3"]
    pairs: Int[np.ndarray, "pairs 2"]
    kinds: tuple[str, ...]
    inliers: Int[np.ndarray, " pairs"]
    relative: Float[np.ndarray, "pairs 3 3"]
    match_pair: Int[np.ndarray, " matches"]
    match_xy: Float[np.ndarray, "matches 2 2"]
    match_inlier: Bool[np.ndarray, " matches"]


def read_two_views(file: Path) -> TwoViews:
    """Read what the worker wrote."""
    with np.load(file) as data:
        arrays = {key: data[key] for key in data.files}
    names, kinds = (tuple(arrays.pop(key).tolist()) for key in ("names", "kinds"))
    return TwoViews(names=names, kinds=kinds, **arrays)


def pair_report(views: TwoViews) -> dict:
    """For `static_poses.json`: shares of kinds, pairs that contradict the model, pictures in which things move."""
    count = max(1, len(views.kinds))
    kinds = Counter(views.kinds)
    moving = moving_tiles(views)
    return {
        "verified": len(views.kinds),
        "kinds": dict(sorted(kinds.items())),
        "homography_share": sum(kinds[k] for k in HOMOGRAPHY) / count,
        "panoramic_share": kinds["PANORAMIC"] / count,
        "watermark_share": kinds["WATERMARK"] / count,
        "contradicting": contradicting_pairs(views),
        "strong": int((views.inliers >= STRONG_PAIR).sum()),
        "moving_tiles": moving,
    }


def contradicting_pairs(views: TwoViews) -> list[dict]:
    """Strong pairs whose own relative turn is far from the model's: repeated texture, merged sides."""
    out = []
    for n, (a, b) in enumerate(views.pairs.tolist()):
        by_model = views.turn[b] @ views.turn[a].T
        if views.inliers[n] < STRONG_PAIR or not np.isfinite(by_model + views.relative[n]).all():
            continue
        deg = rotation_angle_deg(by_model, views.relative[n])
        if deg > CONTRADICTS_DEG:
            names = [views.names[a], views.names[b]]
            out.append({"names": names, "deg": deg, "inliers": int(views.inliers[n])})
    return sorted(out, key=lambda pair: -pair["inliers"])


def moving_tiles(views: TwoViews) -> dict[str, float]:
    """Share of each picture's textured tiles in which most matches do not fit the camera's motion.

    Pictures without such a tile are left out. Matches between neighbours that are wrong by chance spread over
    the picture; those on something that moved stay together.
    """
    strong = (views.inliers >= STRONG_PAIR)[views.match_pair]
    out: dict[str, float] = {}
    sides = []
    for side in (0, 1):
        image = views.pairs[views.match_pair[strong], side]
        sides.append((image, views.match_xy[strong, side], ~views.match_inlier[strong]))
    image, xy, outlier = (np.concatenate(part) for part in zip(*sides, strict=True))
    cell = np.clip(TILES * xy / views.size[image], 0, TILES - 1).astype(np.int64)
    place = (image * TILES + cell[:, 1]) * TILES + cell[:, 0]
    shape, length = (len(views.names), TILES * TILES), len(views.names) * TILES * TILES
    matches = np.bincount(place, minlength=length).reshape(shape)
    outliers = np.bincount(place, weights=outlier, minlength=length).reshape(shape)
    enough = matches >= TILE_MATCHES
    share = outliers / np.maximum(1, matches)
    usual = np.nan_to_num(np.nanmedian(np.where(enough, share, np.nan), axis=1)) if enough.any() else 0.0
    moves = enough & (share > TILE_MOVES) & (share > np.reshape(usual, (-1, 1)) + USUAL_OUTLIERS)
    for name, count, all_ in zip(views.names, moves.sum(1).tolist(), enough.sum(1).tolist(), strict=True):
        if count:
            out[name] = count / all_
    return out
