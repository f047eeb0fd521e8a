"""Views of a board by several cameras: which belong to one instant, who shares what, where to start.

Cameras run free: views are one instant when they lie within half a frame of each other, at most one per
camera. Start values: each view's board pose (planar PnP), relative poses of camera pairs from common
instants, a spanning tree over the camera graph. The world is the first camera's frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.calibration.boards.board_fit import board_pose
from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.intrinsics import Intrinsics
from devrf.capture.system.errors import HealthError

MIN_SHARED_POINTS = 50  # of a link between two cameras that is used (caliscope: fewer fail, under 200 warn)
HOLD = "hold the board where both see it"


@dataclass(frozen=True)
class TimedView:
    """A view of the board and its true time, seconds on cam0's clock."""

    view: BoardView
    time_s: float


@dataclass(frozen=True)
class Views:
    """All views, flat.

    Attributes:
        names: Of the cameras.
        camera, frame, time_s: Of each view [V].
        cam_from_board: By planar PnP [V, 3, 4].
        obs_view, obs_id, obs_xy: Corners [M], [M], [M, 2].
        instant: Of each view [V]; instant_s: middle of each instant [I].
        period_s: Between the pictures of a camera.
    """

    names: tuple[str, ...]
    camera: Int[np.ndarray, " views"]
    frame: Int[np.ndarray, " views"]
    time_s: Float[np.ndarray, " views"]
    cam_from_board: Float[np.ndarray, "views 3 4"]
    obs_view: Int[np.ndarray, " observations"]
    obs_id: Int[np.ndarray, " observations"]
    obs_xy: Float[np.ndarray, "observations 2"]
    instant: Int[np.ndarray, " views"]
    instant_s: Float[np.ndarray, " instants"]
    period_s: float

    def keep(self, good: Bool[np.ndarray, " views"]) -> "Views":
        """Without some views and their corners; instants stay."""
        number, inside = np.cumsum(good) - 1, good[self.obs_view]
        return replace(
            self,
            camera=self.camera[good],
            frame=self.frame[good],
            time_s=self.time_s[good],
            cam_from_board=self.cam_from_board[good],
            obs_view=number[self.obs_view[inside]],
            obs_id=self.obs_id[inside],
            obs_xy=self.obs_xy[inside],
            instant=self.instant[good],
        )

    def regrouped(self, delay_s: Float[np.ndarray, " cameras"]) -> "Views":
        """Instants by the times of clocks that are late by `delay_s`."""
        late = self.time_s + delay_s[self.camera]
        instant, instant_s = _instants(late, self.camera, self.period_s)
        return replace(self, instant=instant, instant_s=instant_s)

    def offset_s(self, delay_s: Float[np.ndarray, " cameras"]) -> Float[np.ndarray, " views"]:
        """Time of each view after its instant's middle."""
        return self.time_s + delay_s[self.camera] - self.instant_s[self.instant]

    def links(self) -> Int[np.ndarray, "cameras cameras"]:
        """Corners that each pair of cameras saw at one instant."""
        corner = self.instant[self.obs_view] * (self.obs_id.max(initial=0) + 1) + self.obs_id
        seen = np.zeros((len(self.names), int(corner.max(initial=0)) + 1), dtype=np.int64)
        seen[self.camera[self.obs_view], corner] = 1
        out = seen @ seen.T
        np.fill_diagonal(out, 0)
        return out


def gather(views: Mapping[str, list[TimedView]], spec: BoardSpec, start: Mapping[str, Intrinsics]) -> Views:
    """Flatten the views of all cameras and group them into instants."""
    names = tuple(views)
    rows = [(c, v) for c, name in enumerate(names) for v in views[name] if _spans_plane(v.view, spec)]
    camera = np.array([c for c, _ in rows], dtype=np.int64)
    time_s = np.array([v.time_s for _, v in rows], dtype=np.float64)
    times = [sorted(v.time_s for v in views[name]) for name in names if len(views[name]) > 1]
    period_s = float(np.median(np.concatenate([np.diff(t) for t in times]))) if times else 0.1
    instant, instant_s = _instants(time_s, camera, period_s)
    return Views(
        names=names,
        camera=camera,
        frame=np.array([v.view.frame for _, v in rows], dtype=np.int64),
        time_s=time_s,
        cam_from_board=np.array(
            [board_pose(spec.corners[v.view.ids], v.view.xy, start[names[c]]) for c, v in rows]
        ).reshape(-1, 3, 4),
        obs_view=np.repeat(np.arange(len(rows)), [len(v.view.ids) for _, v in rows]),
        obs_id=np.concatenate([v.view.ids for _, v in rows]),
        obs_xy=np.concatenate([v.view.xy for _, v in rows]),
        instant=instant,
        instant_s=instant_s,
        period_s=period_s,
    )


def spanning_tree(seen: Views) -> list[tuple[int, int]]:
    """The strongest spanning tree from the first camera: (known, new) pairs.

    Raises:
        HealthError: Cameras that cannot be reached, by name.
    """
    links, names = seen.links(), seen.names
    reached, tree = {0}, []
    while len(reached) < len(names):
        lost = [c for c in range(len(names)) if c not in reached]
        best, known, new = max((int(links[a, b]), a, b) for a in reached for b in lost)
        if best < MIN_SHARED_POINTS:
            apart, rest = ([names[c] for c in some] for some in (lost, sorted(reached)))
            remedy = f"{HOLD}, put a camera between them, use the sweep, or go on without it"
            raise HealthError("rig-unlinked-camera", f"{_unlinked(apart, rest, best)}; {remedy}")
        tree.append((known, new))
        reached.add(new)
    return tree


def untied(seen: Views) -> dict[str, str]:
    """Cameras that the board does not tie to the largest group of those that it ties together: name -> why."""
    from scipy.sparse.csgraph import connected_components

    links = seen.links()
    group = connected_components(links >= MIN_SHARED_POINTS, directed=False)[1]
    tied = group == np.bincount(group).argmax()
    rest = [name for name, in_it in zip(seen.names, tied, strict=True) if in_it]
    return {
        seen.names[
            c
        ]: f"{_unlinked([seen.names[c]], rest, int(links[c, tied].max()))}; {HOLD}, or use the sweep"
        for c in np.flatnonzero(~tied)
    }


def _unlinked(apart: list[str], rest: list[str], shared: int) -> str:
    verb = "shares" if len(apart) == 1 else "share"
    need = f"{shared} corners seen at once, need {MIN_SHARED_POINTS} (200 are good)"
    return f"{', '.join(apart)} {verb} no view of the board with {', '.join(rest)}: {need}"


def start_poses(seen: Views, tree: list[tuple[int, int]]) -> Float[np.ndarray, "cameras 3 4"]:
    """Cameras along the spanning tree, the first one at the origin."""
    poses = np.tile(np.eye(3, 4), (len(seen.names), 1, 1))
    for known, new in tree:
        relative = []
        for i in np.unique(seen.instant):
            a = np.flatnonzero((seen.instant == i) & (seen.camera == known))
            b = np.flatnonzero((seen.instant == i) & (seen.camera == new))
            if len(a) and len(b):
                relative.append(compose(seen.cam_from_board[b[0]], inverse(seen.cam_from_board[a[0]])))
        poses[new] = compose(_medoid(relative), poses[known])
    return poses


def start_boards(seen: Views, poses: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "instants 3 4"]:
    """Every instant's board from the camera that sees most of it."""
    boards = np.tile(np.eye(3, 4), (len(seen.instant_s), 1, 1))
    count = np.bincount(seen.obs_view, minlength=len(seen.camera))
    for v in np.argsort(count, kind="stable"):  # the view that sees most comes last and stays
        boards[seen.instant[v]] = compose(inverse(poses[seen.camera[v]]), seen.cam_from_board[v])
    return boards


def compose(a: Float[np.ndarray, "3 4"], b: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """a after b."""
    return np.column_stack([a[:, :3] @ b[:, :3], a[:, :3] @ b[:, 3] + a[:, 3]])


def inverse(a: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
    """Of a rigid transform."""
    return np.column_stack([a[:, :3].T, -a[:, :3].T @ a[:, 3]])


def _spans_plane(view: BoardView, spec: BoardSpec) -> bool:
    """Whether the corners seen fix a pose: those of one row, and one more, do not.

    The second singular value of a row of n and one corner beside it is sqrt(n / (n + 1)) squares, of a row and two
    it is more than one square.
    """
    on_board = spec.corners[view.ids, :2]
    return bool(np.linalg.svd(on_board - on_board.mean(0), compute_uv=False)[1] > spec.square_m)


def _instants(
    time_s: Float[np.ndarray, " views"], camera: Int[np.ndarray, " views"], period_s: float
) -> tuple[Int[np.ndarray, " views"], Float[np.ndarray, " instants"]]:
    """One instant: at most one view per camera, within half a frame of the first."""
    groups: list[list[int]] = []
    for v in np.lexsort((camera, time_s)):
        group = groups[-1] if groups else []
        if group and time_s[v] - time_s[group[0]] < period_s / 2 and camera[v] not in camera[group]:
            group.append(v)
        else:
            groups.append([v])
    instant = np.zeros(len(time_s), dtype=np.int64)
    for i, group in enumerate(groups):
        instant[group] = i
    return instant, np.array([time_s[group].mean() for group in groups])


def _medoid(poses: list[np.ndarray]) -> Float[np.ndarray, "3 4"]:
    """The pose closest to all others (rotation angle plus relative distance): planar PnP flips drop out."""
    R = np.array([p[:, :3] for p in poses])
    t = np.array([p[:, 3] for p in poses])
    angle = np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1) / 2, -1, 1))
    scale = max(float(np.median(np.linalg.norm(t, axis=1))), 1e-9)
    distance = np.linalg.norm(t[:, None] - t[None], axis=2) / scale
    return poses[int(np.argmin((angle + distance).sum(1)))]
