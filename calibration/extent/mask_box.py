"""The boxes of what masks of cameras show: of all in which they agree, and the smallest that still explains them.

On a grid, what projects into every mask that sees it is a visual hull (Laurentini, PAMI 1994): one of all time, and one
of each stretch of time. Where only two cameras look, hardly any mask speaks against it, and the hull reaches far from
what moves: up to the cameras, and beyond. So of what a pixel may look at, at some time, only that counts in which most
cameras agree. Cameras on one side cannot tell a thing from the space behind it either, nor from where lines of sight
past different things cross; so the sides of the box may come in while nearly every pixel of each mask still looks at
some of its hull.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from devrf.calibration.extent.motion_masks import MotionMask
from devrf.capture.camera import Camera

BEYOND = 0.1  # of a picture's width: so far beyond it goes on what its border cuts
# Each search is within the box that the one before left. At first cells are large, and one of which any part may be in
# a mask counts; then its middle has to be. So many cells fill a mean side.
COARSE, FINE = 40, 64
SEARCHES = COARSE, COARSE, FINE, FINE
MAX_MOVING_SHARE = 0.7  # a mask larger than this is an exposure change or a moved camera, not a subject
# Pieces of the hull smaller than this share of the largest are noise and shadows, unless they alone explain this share
# of what changes in so many cameras: those are small movers.
COMPONENT_SHARE, MOVER_SHARE, MOVER_CAMERAS = 0.15, 0.02, 2
MOST_PIECES = 20  # that are asked, the largest first
# Of a camera's mask of all time, so much may look past the box in each stretch of time; in one camera alone, more.
SPARE, ALONE = 0.0025, 0.01
# Of the nearest camera's distance, beyond the last cell that is needed: pixels look at a thing's back and sides through
# what bulges towards the cameras.
BULGE = 0.05
# A camera says nothing of a cell that something stands before: a point of the sweep so many pixels beside its middle,
# nearer by this share and a cell.
BESIDE_PX, BEHIND = 2, 0.05
NOTHING = np.zeros((0, 3))  # stands before anything: cameras are asked of all
REACHES_PX = np.array([1, 2, 4, 8, 12])  # half the side of a cell in a picture, rounded up: few, for speed


class MaskHull:
    """All in which masks agree at some time, without noise and shadows.

    Attributes:
        box: Its corners, in upright world axes [2, 3].
    """

    @classmethod
    def of(
        cls,
        masks: Sequence[MotionMask],
        region: Float[np.ndarray, "2 3"],
        box_from_up: Float[np.ndarray, "3 3"],
        stretches: Sequence[Sequence[MotionMask | None]] = (),
        before: Float[np.ndarray, "p 3"] = NOTHING,
    ) -> "MaskHull | None":
        """The hull of masks, a camera each; None where they contradict each other.

        Args:
            masks: Of all time.
            region: Corners of what is searched, in upright axes.
            box_from_up: Rotation to upright axes.
            stretches: Masks of shorter times: of the same cameras, None where one does not film then.
            before: Points of the sweep that cameras are not asked behind: what moves there they may not show.
        """
        fine = [n for n, mask in enumerate(masks) if 0 < mask.mask.mean() < MAX_MOVING_SHARE]
        fronts, found = {n: _front(masks[n].camera, before) for n in fine}, None
        for count in SEARCHES if len(fine) > 1 else ():
            cells, cell = _grid(region, count)
            found = cls(masks, stretches, fronts, box_from_up, cells, cell)
            if not found._search(coarse=count == COARSE):
                return None
            region = found.box + cell * np.array([[-1.0], [1.0]])
        return found

    def __init__(
        self,
        masks: Sequence[MotionMask],
        stretches: Sequence[Sequence[MotionMask | None]],
        fronts: Mapping[int, Float[np.ndarray, "h w"]],
        box_from_up: Float[np.ndarray, "3 3"],
        cells: Float[np.ndarray, "n 3"],
        cell: float,
    ) -> None:
        """Of cells with this side, by those masks of which it is given how far away something stands."""
        self._masks, self._stretches, self._fine = masks, stretches, list(fronts)
        self._pixels = [float(mask.mask.sum()) for mask in masks]
        self._box_from_up, self._cells, self._cell = box_from_up, cells, cell
        world = cells @ box_from_up
        self._views = [_view(masks[n].camera, world, cell, front) for n, front in fronts.items()]

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """The box of all of it."""
        return np.stack([self._cells.min(0) - self._cell / 2, self._cells.max(0) + self._cell / 2])

    def smallest_box(self) -> Float[np.ndarray, "2 3"]:
        """Corners of the smallest box that still explains what the masks show."""
        every = [self._hull(stretch) for stretch in (self._masks, *self._stretches)]
        hulls = [hull.only(hull.best()) for hull in every if hull is not None]
        low, high = self.box
        middle = (low + high) / 2 @ self._box_from_up
        nearest = min(np.linalg.norm(self._masks[n].camera.centre - middle) for n in self._fine)
        return _drawn_in(low, high, hulls, BULGE * float(nearest))

    def _search(self, coarse: bool) -> bool:
        """Keep cells that belong to the hull; whether there are any."""
        whole = self._hull(self._masks, coarse)
        if whole is None:
            return False
        self._keep(whole.number)
        kept = whole.best()
        for stretch in self._stretches:
            hull = self._hull(stretch, coarse, most_deny=1)
            if hull is not None:
                kept[hull.number[hull.best()]] = True
        number, whole = np.flatnonzero(kept), whole.only(kept)
        self._keep(number[whole.movers()])
        return True

    def _keep(self, number: Int[np.ndarray, " k"]) -> None:
        """Forget other cells than these."""
        kept = np.zeros(len(self._cells), dtype=bool)
        kept[number] = True
        self._cells, self._views = self._cells[kept], [view.only(kept) for view in self._views]

    def _hull(
        self, stretch: Sequence[MotionMask | None], coarse: bool = False, most_deny: int = 0
    ) -> "_Hull | None":
        """What masks of some time agree on; None where that is nothing."""
        some = [
            _Seen(view, mask, self._pixels[n])
            for n, view in zip(self._fine, self._views, strict=True)
            if (mask := stretch[n]) is not None and mask.mask.any()
        ]
        if len(some) < 2:
            return None
        found = _Hull.of(some, self._cells, self._cell, coarse, most_deny)
        return found if len(found.cells) else None


def unexplained(
    masks: Sequence[MotionMask],
    box_from_world: Float[np.ndarray, "4 4"],
    aabb: Float[np.ndarray, "2 3"],
    before: Float[np.ndarray, "p 3"] = NOTHING,
) -> list[Bool[np.ndarray, "h w"]]:
    """Pixels of each mask that look at nothing in the box in which the masks that see it agree.

    `before`: points that cameras are not asked behind.
    """
    scale = float(np.cbrt(np.linalg.det(box_from_world[:3, :3])))
    box_from_up = box_from_world[:3, :3] / scale
    cells, cell = _grid((aabb - box_from_world[:3, 3]) / scale, FINE)
    world = cells @ box_from_up
    seen = [
        _Seen(_view(m.camera, world, cell, _front(m.camera, before)), m, float(m.mask.sum())) for m in masks
    ]
    hull = _Hull.of(seen, cells, cell)
    everything = np.ones(len(hull.cells), dtype=bool)
    out = []
    for mask, seen in zip(masks, hull.seen, strict=True):
        left = mask.moved.copy()
        left[left] = ~seen.explained(everything)
        out.append(left)
    return out


def _grid(region: Float[np.ndarray, "2 3"], count: int) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Middles of cubic cells, so many per mean side, that fill a region; and their side."""
    sides = np.ptp(region, axis=0)
    cell = float(np.cbrt(sides.prod())) / count
    axes = [
        (low + high) / 2 + cell * (np.arange(n) - (n - 1) / 2)
        for low, high, n in zip(*region, np.ceil(sides / cell).astype(int), strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), cell


def _drawn_in(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], hulls: "Sequence[_Hull]", beyond: float
) -> Float[np.ndarray, "2 3"]:
    """The box with each side as far in as the hulls let it, that which gains most first."""
    ends = np.concatenate([-low, high])  # of each side, outwards
    left = list(range(6))
    while left:
        low, high = -ends[:3], ends[3:]
        inward = {
            side: _inward(ends[side], beyond + max(hull.needs(side, low, high) for hull in hulls))
            for side in left
        }
        best = max(left, key=lambda side: (ends[side] - inward[side]) / (high - low)[side % 3])
        ends[best] = inward[best]
        left.remove(best)
    return np.stack([-ends[:3], ends[3:]])


class _View(NamedTuple):
    """Cells in a camera's picture, small as its mask.

    Attributes:
        cells: Their numbers.
        pixel, reach: Where each is, and half the side of its square.
        hidden: Whether something stands before it.
        beyond, edge: Cells a little beyond the picture, and the pixel of its border next to each.
    """

    cells: Int[np.ndarray, " k"]
    pixel: Int[np.ndarray, " k"]
    reach: Int[np.ndarray, " k"]
    hidden: Bool[np.ndarray, " k"]
    beyond: Int[np.ndarray, " m"]
    edge: Int[np.ndarray, " m"]

    def only(self, kept: Bool[np.ndarray, " n"]) -> "_View":
        """Some of the cells, which are numbered anew."""
        number, mine, out = np.cumsum(kept) - 1, kept[self.cells], kept[self.beyond]
        seen = number[self.cells[mine]], self.pixel[mine], self.reach[mine], self.hidden[mine]
        return _View(*seen, number[self.beyond[out]], self.edge[out])


@dataclass(frozen=True)
class _Seen:
    """Cells of a hull in one camera's picture, and the mask.

    Attributes:
        view: The cells.
        mask: Of some time.
        pixels: Of the camera's mask of all time.
    """

    view: _View
    mask: MotionMask
    pixels: float

    @property
    def moved(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that move."""
        return self.mask.moved

    def lowest(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "h w"]:
        """Of the hull's cells the lowest value that each pixel looks at; infinite where there is none."""
        out = np.full(self.moved.shape, np.inf)
        for reach in np.unique(self.view.reach).tolist():
            mine, middle = self.view.reach == reach, np.full(self.moved.size, np.inf)
            np.minimum.at(middle, self.view.pixel[mine], values[self.view.cells[mine]])
            middle = middle.reshape(self.moved.shape)
            around = ndimage.minimum_filter(middle, size=2 * reach + 1, mode="constant", cval=np.inf)
            out = np.minimum(out, around)
        return out

    def explained(self, cells: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " m"]:
        """Whether each pixel that moves looks at some of the cells."""
        return np.isfinite(self.lowest(np.where(cells, 0.0, np.inf))[self.moved])


@dataclass(frozen=True)
class _Hull:
    """What projects into all masks that see it, of at least two.

    Attributes:
        cells: Its cells, in upright axes [n, 3], and their side.
        number: Of each cell among those that were asked.
        cameras: How many show each, and those in which a silhouette is cut by the border next to it.
        whole: Whether all that see it do.
        seen: The cells in each camera.
    """

    cells: Float[np.ndarray, "n 3"]
    cell: float
    number: Int[np.ndarray, " n"]
    cameras: Int[np.ndarray, " n"]
    whole: Bool[np.ndarray, " n"]
    seen: "Sequence[_Seen]"

    @classmethod
    def of(
        cls,
        seen: "Sequence[_Seen]",
        cells: Float[np.ndarray, "n 3"],
        cell: float,
        coarse: bool = False,
        most_deny: int = 0,
    ) -> "_Hull":
        """Ask masks of cells, in upright axes.

        Args:
            coarse: Any part of a cell may be in a mask.
            most_deny: Masks that may not show a cell that more show.
        """
        agree, deny, cut = np.zeros((3, len(cells)), dtype=int)
        for one in seen:
            view, mask = one.view, one.mask.mask
            away = np.asarray(ndimage.distance_transform_cdt(~mask, "chessboard")).ravel()
            shows = away[view.pixel] <= (view.reach if coarse else 0)
            agree[view.cells] += shows
            deny[view.cells] += ~shows & ~view.hidden
            cut[view.beyond] += mask.ravel()[view.edge]
        kept = (agree >= 2 + deny) & (deny <= most_deny)
        return cls(cells, cell, np.arange(len(cells)), agree + cut, deny == 0, seen).only(kept)

    def only(self, kept: Bool[np.ndarray, " n"]) -> "_Hull":
        """Some of its cells."""
        seen = [replace(one, view=one.view.only(kept)) for one in self.seen]
        of_cells = {name: getattr(self, name)[kept] for name in ("cells", "number", "cameras", "whole")}
        return replace(self, **of_cells, seen=seen)

    def best(self) -> Bool[np.ndarray, " n"]:
        """Cells that all cameras show that see them, and of those that some pixel looks at none is shown by more."""
        out = np.zeros(len(self.cells), dtype=bool)
        for seen in self.seen:
            most = -seen.lowest(-self.cameras.astype(float))
            cells, pixel = seen.view.cells, seen.view.pixel
            out[cells] |= self.cameras[cells] >= most.ravel()[pixel]
        return out & self.whole

    @cached_property
    def _known(self) -> list[int]:
        """Pixels of each mask that look at some of the cells."""
        every = np.ones(len(self.cells), dtype=bool)
        return [int(seen.explained(every).sum()) for seen in self.seen]

    def movers(self) -> Bool[np.ndarray, " k"]:
        """Cells of the pieces that are large, or alone explain what moves in some cameras; the largest go first."""
        place = np.round((self.cells - self.cells.min(0)) / self.cell).astype(int)
        volume = np.zeros(place.max(0) + 1, dtype=bool)
        volume[tuple(place.T)] = True
        labels = np.empty(volume.shape, dtype=np.int32)
        ndimage.label(volume, structure=np.ones((3, 3, 3)), output=labels)
        piece = labels[tuple(place.T)]
        sizes = np.bincount(piece)
        kept = np.zeros(len(piece), dtype=bool)
        before = [np.zeros(int(seen.moved.sum()), dtype=bool) for seen in self.seen]
        for number in np.argsort(-sizes)[:MOST_PIECES]:
            mine = piece == number
            shown = [seen.explained(mine) for seen in self.seen]
            alone = sum(
                (now & ~then).sum() >= MOVER_SHARE * seen.pixels
                for seen, now, then in zip(self.seen, shown, before, strict=True)
            )
            if mine.any() and (sizes[number] >= COMPONENT_SHARE * sizes.max() or alone >= MOVER_CAMERAS):
                kept |= mine
                before = [now | then for now, then in zip(shown, before, strict=True)]
        return kept

    def needs(self, side: int, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> float:
        """How far out a side of the box (three low ones, three high ones) has to be at least.

        Each camera's pixels, but for those that may be spared, still look at some of the hull then.
        """
        outward = self.cells[:, side % 3] * (1 if side >= 3 else -1)
        inside = ((self.cells >= low) & (self.cells <= high)).all(1)
        outward, needed = np.where(inside, outward, np.inf), []
        for seen, known in zip(self.seen, self._known, strict=True):
            ends = np.sort(seen.lowest(outward)[seen.moved])
            ends = ends[np.isfinite(ends)]
            gone = known - len(ends)
            needed.append([_end(ends, int(share * seen.pixels) - gone) for share in (SPARE, ALONE)])
        common, alone = np.sort(needed, axis=0).T
        return float(max(common[-2], alone[-1]))


def _end(ends: Float[np.ndarray, " n"], may_go: int) -> float:
    """The end of what is left of rising ends if so many may go."""
    return np.inf if may_go < 0 else -np.inf if may_go >= len(ends) else float(ends[-1 - may_go])


def _inward(end: float, needed: float) -> float:
    """Where a side goes; where nothing needs it, no pixel speaks for any place (light alone changes), and it stays."""
    return min(end, needed) if np.isfinite(needed) else end


def _front(camera: Camera, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "h w"]:
    """Depth of the nearest point beside each pixel, infinite where there is none."""
    at, depth = camera.project(points), (points - camera.centre) @ camera.cam_from_world[2, :3]
    inside = (depth > 0) & (at >= 0).all(1) & (at < [camera.width, camera.height]).all(1)
    front = np.full((camera.height, camera.width), np.inf)
    x, y = at[inside].astype(int).T
    np.minimum.at(front, (y, x), depth[inside])
    return ndimage.minimum_filter(front, size=2 * BESIDE_PX + 1, mode="constant", cval=np.inf)


def _view(
    camera: Camera, world: Float[np.ndarray, "n 3"], cell: float, front: Float[np.ndarray, "h w"]
) -> _View:
    """Where a camera sees cells of which these are the middles."""
    at, size = camera.project(world), np.array([camera.width, camera.height])
    inside = (at >= 0).all(1) & (at < size).all(1)
    around = ~inside & (np.abs(at - size / 2) < size / 2 + BEYOND * camera.width).all(1)
    cells, beyond = np.flatnonzero(inside), np.flatnonzero(around)
    pixel = at[cells].astype(int) @ np.array([1, camera.width])
    edge = at[beyond].clip(0, size - 1).astype(int) @ [1, camera.width]
    depth = (world[cells] - camera.centre) @ camera.cam_from_world[2, :3]
    half_px = 0.5 * cell * camera.K[0, 0] / depth
    reach = REACHES_PX[np.searchsorted(REACHES_PX[:-1], half_px)]
    hidden = depth > (1 + BEHIND) * np.take(front, pixel) + cell
    return _View(cells, pixel, reach, hidden, beyond, edge)
