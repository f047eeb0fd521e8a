"""Fixed cameras from a board that several of them see at once: metric, and without any sweep.

Start: each view's board pose (planar PnP), relative poses of camera pairs from common instants, a spanning
tree over the camera graph. Then one bundle adjustment over cameras, intrinsics and board poses with a robust
loss; views that do not fit are dropped by multical's rule (5 x the 75th percentile) and it runs again. The
cameras run free, so the views of one instant are some milliseconds apart: the board moves on between them
with the velocity that its neighbouring poses show. The world is the first camera's frame, metres.

Symbols: rig = world; T = board poses [instants, 6] (rotation vector, translation) as rig_from_board.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from devrf.calibration.board import BoardSpec, BoardView
from devrf.calibration.bundle import distort_many, loss_value, loss_weight, robust_sigma
from devrf.calibration.intrinsics import Intrinsics, from_vector
from devrf.capture.camera import Camera
from devrf.capture.errors import HealthError
from devrf.capture.progress import Progress, no_progress

MIN_SHARED_POINTS = 50  # of a link between two cameras that is used (caliscope: fewer fail, under 200 warn)
OUTLIER_QUANTILE, OUTLIER_FACTOR = 0.75, 5.0
ROUNDS = 3
JOINT_WIDENING = 3.0
PRINCIPAL_POINT_STD = 0.02  # of the longer side
LM_STEPS = 40
MIN_NOISE_PX = 0.1
STEP = 1e-6
MAX_GAP_S = 0.5  # between instants, for the board's velocity; a longer pause says nothing about it


@dataclass(frozen=True)
class TimedView:
    """A view of the board and its true time, seconds on cam0's clock."""

    view: BoardView
    time_s: float


@dataclass(frozen=True)
class BoardRig:
    """Cameras in metres, in the first camera's frame.

    Attributes:
        cameras: Name -> camera.
        rotation_std_deg, position_std_m: Name -> standard deviation.
        rms_px: Over all inlier corners; sigma_px: robust scale of one coordinate.
        links: (a, b) -> corners that both saw at once.
        dropped: (camera, frame) of the views that did not fit.
        gap_ms: Median and largest time between views that count as one instant.
        corners: Name -> corners that were used.
    """

    cameras: dict[str, Camera]
    rotation_std_deg: dict[str, float]
    position_std_m: dict[str, float]
    rms_px: float
    sigma_px: float
    links: dict[tuple[str, str], int]
    dropped: tuple[tuple[str, int], ...]
    gap_ms: tuple[float, float]
    corners: dict[str, int]


def joint_prior(own: Intrinsics) -> Intrinsics:
    """Prior for intrinsics that come from the joint views themselves, few and seldom near the edges.

    The views' own standard deviations assume a flat board; they are widened, and the principal point is
    drawn towards the centre.
    """
    assert own.std is not None
    std = np.where(own.std > 0, JOINT_WIDENING * own.std, 0.0)
    centre = np.array([own.width / 2, own.height / 2])
    weak = PRINCIPAL_POINT_STD * max(own.width, own.height)
    weight = 1 / std[2:4] ** 2 if (std[2:4] > 0).all() else np.zeros(2)
    mean = (weight * own.vector[2:4] + centre / weak**2) / (weight + 1 / weak**2)
    vector = own.vector
    vector[2:4] = mean
    std[2:4] = 1 / np.sqrt(weight + 1 / weak**2)
    return from_vector(own.width, own.height, vector, std)


def rig_from_board(
    views: dict[str, list[TimedView]],
    spec: BoardSpec,
    start: dict[str, Intrinsics],
    priors: dict[str, Intrinsics],
    progress: Progress = no_progress,
) -> BoardRig:
    """Calibrate the rig.

    Args:
        views: Camera -> its views, on one clock.
        spec: The settled board.
        start: Camera -> intrinsics to start from.
        priors: Camera -> what is known of its intrinsics apart from these views (`std` says how well).
        progress: Called per round.
    Raises:
        HealthError: Cameras that share no view of the board with the others, by name.
    """
    names = list(views)
    state = _gather(names, views, spec, start, priors)
    links = _links(state)
    _initialise(state, links)
    dropped: list[tuple[str, int]] = []
    for round_number in range(ROUNDS):
        progress(round_number / ROUNDS, f"bundle adjustment, round {round_number + 1}")
        _optimise(state)
        state.noise_px = _common_noise(state)
        _optimise(state)  # once more with the velocities and the noise that the better poses show
        bad = _bad_views(state)
        if not bad.any():
            break
        dropped += [(names[state.view_camera[v]], int(state.view_frame[v])) for v in np.flatnonzero(bad)]
        state.keep(~bad)
        _refuse_disconnected(state, _links(state))
    _optimise(state)
    residual = state.residuals()
    sigma = robust_sigma(residual)
    covariance = _covariance(state, sigma)
    cameras, rotation_std, position_std = {}, {}, {}
    for c, name in enumerate(names):
        k = from_vector(start[name].width, start[name].height, state.intrinsics[c])
        cameras[name] = k.at(state.poses[c])
        block = covariance[6 * c : 6 * c + 6, 6 * c : 6 * c + 6]
        rotation_std[name] = float(np.degrees(np.sqrt(max(np.trace(block[:3, :3]), 0.0))))
        position_std[name] = float(np.sqrt(max(np.trace(block[3:, 3:]), 0.0)))
    return BoardRig(
        cameras=cameras,
        rotation_std_deg=rotation_std,
        position_std_m=position_std,
        rms_px=float(np.sqrt((residual**2).sum(1).mean())),
        sigma_px=sigma,
        links={(names[a], names[b]): n for (a, b), n in _links(state).items()},
        dropped=tuple(dropped),
        gap_ms=_gaps_ms(state),
        corners={name: int((state.view_camera[state.obs_view] == c).sum()) for c, name in enumerate(names)},
    )


class _State:
    """Parameters and observations; a view is one camera's picture of the board at one instant."""

    names: list[str]
    intrinsics: Float[np.ndarray, "cameras 9"]
    prior_mean: Float[np.ndarray, "cameras 9"]
    prior_std: Float[np.ndarray, "cameras 9"]
    one_focal: Bool[np.ndarray, " cameras"]
    poses: Float[np.ndarray, "cameras 3 4"]  # cam_from_rig
    boards: Float[np.ndarray, "instants 3 4"]  # rig_from_board
    spin: Float[np.ndarray, "instants 3"]  # rad/s, in rig axes
    velocity: Float[np.ndarray, "instants 3"]  # m/s
    instant_s: Float[np.ndarray, " instants"]
    view_camera: Int[np.ndarray, " views"]
    view_instant: Int[np.ndarray, " views"]
    view_frame: Int[np.ndarray, " views"]
    view_dt: Float[np.ndarray, " views"]
    view_pose: Float[np.ndarray, "views 3 4"]  # cam_from_board by PnP
    obs_view: Int[np.ndarray, " observations"]
    obs_id: Int[np.ndarray, " observations"]
    obs_xy: Float[np.ndarray, "observations 2"]
    corners: Float[np.ndarray, "corners 3"]
    noise_px: float = 1.0  # weighs the priors against the corners

    def keep(self, views: Bool[np.ndarray, " views"]) -> None:
        """Drop views and their observations; instants without views stay and cost nothing."""
        number = np.cumsum(views) - 1
        inside = views[self.obs_view]
        self.obs_view = number[self.obs_view[inside]]
        self.obs_id, self.obs_xy = self.obs_id[inside], self.obs_xy[inside]
        self.view_camera, self.view_instant = self.view_camera[views], self.view_instant[views]
        self.view_frame, self.view_dt = self.view_frame[views], self.view_dt[views]
        self.view_pose = self.view_pose[views]

    def on_rig(self) -> Float[np.ndarray, "observations 3"]:
        """Corners in the rig's frame at the time of each observation, and nothing else."""
        instant = self.view_instant[self.obs_view]
        dt = self.view_dt[self.obs_view][:, None]
        board = self.boards[instant]
        arm = np.einsum("mij,mj->mi", board[:, :, :3], self.corners[self.obs_id])
        return arm + np.cross(self.spin[instant] * dt, arm) + board[:, :, 3] + self.velocity[instant] * dt

    def in_camera(self) -> Float[np.ndarray, "observations 3"]:
        """The same corners in the camera that saw them."""
        pose = self.poses[self.view_camera[self.obs_view]]
        return np.einsum("mij,mj->mi", pose[:, :, :3], self.on_rig()) + pose[:, :, 3]

    def residuals(self) -> Float[np.ndarray, "observations 2"]:
        """Projection minus observation, pixels."""
        return _project(self.intrinsics[self.view_camera[self.obs_view]], self.in_camera()) - self.obs_xy


def _gather(
    names: list[str],
    views: dict[str, list[TimedView]],
    spec: BoardSpec,
    start: dict[str, Intrinsics],
    priors: dict[str, Intrinsics],
) -> _State:
    s = _State()
    s.names = names
    s.corners = spec.corners
    s.intrinsics = np.array([start[n].vector for n in names])
    s.prior_mean = np.array([priors[n].vector for n in names])
    std = [priors[n].std for n in names]
    s.prior_std = np.array([np.zeros(9) if v is None else v for v in std])
    s.one_focal = np.abs(s.intrinsics[:, 0] - s.intrinsics[:, 1]) < 1e-6 * s.intrinsics[:, 0]
    flat = sorted(
        ((v.time_s, c, v.view) for c, name in enumerate(names) for v in views[name]),
        key=lambda v: (v[0], v[1]),
    )
    times = [[v.time_s for v in views[name]] for name in names if len(views[name]) > 1]
    period = float(np.median(np.concatenate([np.diff(sorted(t)) for t in times]))) if times else 0.1
    instants: list[list[tuple[float, int, BoardView]]] = []
    for t, c, view in flat:  # one instant: at most one view per camera, within half a frame
        if (
            instants
            and t - instants[-1][0][0] < period / 2
            and all(c != other for _, other, _ in instants[-1])
        ):
            instants[-1].append((t, c, view))
        else:
            instants.append([(t, c, view)])
    s.instant_s = np.array([np.mean([t for t, _, _ in group]) for group in instants])
    s.boards = np.tile(np.eye(3, 4), (len(instants), 1, 1))
    s.spin, s.velocity = np.zeros((len(instants), 3)), np.zeros((len(instants), 3))
    s.poses = np.tile(np.eye(3, 4), (len(names), 1, 1))
    rows = [(c, i, view, t - s.instant_s[i]) for i, group in enumerate(instants) for t, c, view in group]
    s.view_camera = np.array([c for c, _, _, _ in rows])
    s.view_instant = np.array([i for _, i, _, _ in rows])
    s.view_frame = np.array([view.frame for _, _, view, _ in rows])
    s.view_dt = np.array([dt for _, _, _, dt in rows])
    s.view_pose = np.array([_board_pose(view, spec, start[names[c]]) for c, _, view, _ in rows])
    s.obs_view = np.repeat(np.arange(len(rows)), [len(view.ids) for _, _, view, _ in rows])
    s.obs_id = np.concatenate([view.ids for _, _, view, _ in rows])
    s.obs_xy = np.concatenate([view.xy for _, _, view, _ in rows])
    return s


def _board_pose(view: BoardView, spec: BoardSpec, k: Intrinsics) -> Float[np.ndarray, "3 4"]:
    """cam_from_board of one view."""
    on_board = spec.corners[view.ids]
    centre = on_board.mean(0)  # IPPE wants the points around the origin
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        on_board - centre, view.xy - 0.5, k.cv_matrix, k.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    best = int(np.argmin(np.asarray(errors).reshape(-1)))
    R = cv2.Rodrigues(rotations[best])[0]
    return np.column_stack([R, np.asarray(translations[best]).reshape(3) - R @ centre])


def _links(s: _State) -> dict[tuple[int, int], int]:
    """Corners that two cameras saw at once, for every pair that shares some."""
    seen: dict[int, dict[int, set[int]]] = {}
    for v in range(len(s.view_camera)):
        seen.setdefault(int(s.view_instant[v]), {})[int(s.view_camera[v])] = set()
    for view, corner in zip(s.obs_view.tolist(), s.obs_id.tolist(), strict=True):
        seen[int(s.view_instant[view])][int(s.view_camera[view])].add(corner)
    links: dict[tuple[int, int], int] = {}
    for cameras in seen.values():
        for a in cameras:
            for b in cameras:
                if a < b:
                    links[a, b] = links.get((a, b), 0) + len(cameras[a] & cameras[b])
    return links


def _refuse_disconnected(s: _State, links: dict[tuple[int, int], int]) -> list[tuple[int, int]]:
    """The strongest spanning tree from the first camera: (known, new) pairs; refuses what it cannot reach."""
    reached, tree = {0}, []
    while len(reached) < len(s.names):
        options = [
            (n, *((a, b) if a in reached else (b, a)))
            for (a, b), n in links.items()
            if (a in reached) != (b in reached) and n >= MIN_SHARED_POINTS
        ]
        if not options:
            lost = [name for c, name in enumerate(s.names) if c not in reached]
            best = max((n for (a, b), n in links.items() if (a in reached) != (b in reached)), default=0)
            raise HealthError(
                f"{', '.join(lost)} share{'s' if len(lost) == 1 else ''} no view of the board with "
                f"{', '.join(s.names[c] for c in sorted(reached))}: {best} corners seen at once, need "
                f"{MIN_SHARED_POINTS} (200 are good); hold the board where both see it, or use the sweep"
            )
        _, known, new = max(options)
        tree.append((known, new))
        reached.add(new)
    return tree


def _initialise(s: _State, links: dict[tuple[int, int], int]) -> None:
    """Cameras along the spanning tree, then every instant's board from the camera that sees most of it."""
    for known, new in _refuse_disconnected(s, links):
        relative = []
        for i in np.unique(s.view_instant):
            a = np.flatnonzero((s.view_instant == i) & (s.view_camera == known))
            b = np.flatnonzero((s.view_instant == i) & (s.view_camera == new))
            if len(a) and len(b):
                relative.append(_compose(s.view_pose[b[0]], _inverse(s.view_pose[a[0]])))
        s.poses[new] = _compose(_medoid(relative), s.poses[known])
    count = np.bincount(s.obs_view, minlength=len(s.view_camera))
    for i in range(len(s.boards)):
        views = np.flatnonzero(s.view_instant == i)
        v = views[np.argmax(count[views])]
        s.boards[i] = _compose(_inverse(s.poses[s.view_camera[v]]), s.view_pose[v])


def _medoid(poses: list[np.ndarray]) -> np.ndarray:
    """The pose closest to all others (rotation angle plus relative distance): planar PnP flips drop out."""
    R = np.array([p[:, :3] for p in poses])
    t = np.array([p[:, 3] for p in poses])
    angle = np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1) / 2, -1, 1))
    scale = max(float(np.median(np.linalg.norm(t, axis=1))), 1e-9)
    distance = np.linalg.norm(t[:, None] - t[None], axis=2) / scale
    return poses[int(np.argmin((angle + distance).sum(1)))]


def _set_velocities(s: _State) -> None:
    """Spin and velocity of the board at every instant from its neighbours in time, zero at pauses."""
    n = len(s.boards)
    s.spin, s.velocity = np.zeros((n, 3)), np.zeros((n, 3))
    seen = np.unique(s.view_instant)
    for before, here, after in zip(seen[:-2], seen[1:-1], seen[2:], strict=True):
        dt = s.instant_s[after] - s.instant_s[before]
        if dt < MAX_GAP_S:
            s.velocity[here] = (s.boards[after, :, 3] - s.boards[before, :, 3]) / dt
            turn = s.boards[after, :, :3] @ s.boards[before, :, :3].T
            s.spin[here] = cv2.Rodrigues(turn)[0].reshape(3) / dt


def _optimise(s: _State) -> None:
    """Levenberg-Marquardt over camera poses (the first is held), intrinsics, board poses; soft-L1 at 1 px."""
    _set_velocities(s)
    damping, cost = 1e-4, _cost(s)
    for _ in range(LM_STEPS):
        J, r = _system(s)
        H, g = (J.T @ J).tocsc(), J.T @ r
        diagonal = H.diagonal()
        saved = (s.poses.copy(), s.intrinsics.copy(), s.boards.copy())
        new_cost = np.inf
        while damping < 1e8:
            step = sp.linalg.spsolve(H + sp.diags(damping * diagonal + 1e-12), -g)
            _move(s, step)
            new_cost = _cost(s)
            if new_cost < cost:
                break
            s.poses, s.intrinsics, s.boards = (part.copy() for part in saved)
            damping *= 8
        if not new_cost < cost:
            return
        gain, cost = cost - new_cost, new_cost
        damping = max(damping / 8, 1e-9)
        if gain < 1e-7 * cost:
            return


def _system(s: _State) -> tuple[sp.csr_matrix, Float[np.ndarray, " rows"]]:
    """Weighted Jacobian and residuals, the priors last. Columns: poses, intrinsics, boards."""
    camera, instant = s.view_camera[s.obs_view], s.view_instant[s.obs_view]
    x, k = s.in_camera(), s.intrinsics[camera]
    residual = _project(k, x) - s.obs_xy
    d_x = np.stack([_central(lambda y: _project(k, y), x, a, np.abs(x[:, 2])) for a in range(3)], axis=2)
    d_k = np.stack(
        [_central(lambda y: _project(y, x), k, i, np.maximum(np.abs(k[:, i]), 1)) for i in range(9)], 2
    )
    one = s.one_focal[camera]
    d_k[one, :, 0] += d_k[one, :, 1] * (k[one, 1] / k[one, 0])[:, None]
    on_rig, R = s.on_rig(), s.poses[camera][:, :, :3]
    arm = on_rig - s.boards[instant][:, :, 3]
    d_pose = np.concatenate([d_x @ _minus_cross(x), d_x], axis=2)
    d_board = np.concatenate([d_x @ R @ _minus_cross(arm), d_x @ R], axis=2)
    C, M = len(s.poses), len(residual)
    columns = np.concatenate(
        [6 * camera[:, None] + np.arange(6), 6 * C + 9 * camera[:, None] + np.arange(9),
         15 * C + 6 * instant[:, None] + np.arange(6)], axis=1,
    )  # fmt: skip
    values = np.concatenate([d_pose, d_k, d_board], axis=2)
    values[~_free(s)[columns][:, None, :].repeat(2, axis=1)] = 0.0
    weight = np.sqrt(loss_weight((residual**2).sum(1), "soft_l1"))
    values *= weight[:, None, None]
    rows = np.arange(2 * M).reshape(M, 2, 1).repeat(21, axis=2)
    size = 15 * C + 6 * len(s.boards)
    J = sp.csr_matrix(
        (values.reshape(-1), (rows.reshape(-1), columns[:, None, :].repeat(2, axis=1).reshape(-1))),
        shape=(2 * M, size),
    )
    has_prior = np.isfinite(s.prior_std) & (s.prior_std > 0)
    c, i = np.nonzero(has_prior)
    scale = 1 / s.prior_std[c, i]
    prior = sp.csr_matrix((scale, (np.arange(len(c)), 6 * C + 9 * c + i)), shape=(len(c), size))
    prior_residual = (s.intrinsics[c, i] - s.prior_mean[c, i]) * scale
    J = sp.vstack([J, s.noise_px * prior])
    return sp.csr_matrix(J), np.concatenate(
        [(residual * weight[:, None]).reshape(-1), s.noise_px * prior_residual]
    )


def _free(s: _State) -> Bool[np.ndarray, " parameters"]:
    pose = np.ones((len(s.poses), 6), dtype=bool)
    pose[0] = False
    intrinsics = s.prior_std > 0
    intrinsics[s.one_focal, 1] = False
    return np.concatenate([pose.reshape(-1), intrinsics.reshape(-1), np.ones(6 * len(s.boards), dtype=bool)])


def _move(s: _State, step: Float[np.ndarray, " parameters"]) -> None:
    C = len(s.poses)
    step = np.where(_free(s), step, 0.0)
    for c, d in enumerate(step[: 6 * C].reshape(-1, 6)):
        s.poses[c] = cv2.Rodrigues(d[:3])[0] @ s.poses[c]
        s.poses[c, :, 3] += d[3:]
    ratio = s.intrinsics[:, 1] / s.intrinsics[:, 0]
    s.intrinsics = s.intrinsics + step[6 * C : 15 * C].reshape(-1, 9)
    s.intrinsics[s.one_focal, 1] = (ratio * s.intrinsics[:, 0])[s.one_focal]
    for i, d in enumerate(step[15 * C :].reshape(-1, 6)):
        s.boards[i, :, :3] = cv2.Rodrigues(d[:3])[0] @ s.boards[i, :, :3]
        s.boards[i, :, 3] += d[3:]


def _cost(s: _State) -> float:
    has_prior = np.isfinite(s.prior_std) & (s.prior_std > 0)
    deviation = (s.intrinsics - s.prior_mean)[has_prior] / s.prior_std[has_prior]
    squared = (s.residuals() ** 2).sum(1)
    return float(loss_value(squared, "soft_l1").sum() + s.noise_px**2 * (deviation**2).sum())


def _common_noise(s: _State) -> float:
    """Noise of an observation for weighing priors: a view's corners err together.

    The views of one instant are not quite simultaneous and the print is not quite flat, so the corners of a view
    share their error: n of them are worth one, and the noise of each counts sqrt(n) times.
    """
    per_view = len(s.obs_view) / max(len(np.unique(s.obs_view)), 1)
    return max(robust_sigma(s.residuals()), MIN_NOISE_PX) * float(np.sqrt(per_view))


def _bad_views(s: _State) -> Bool[np.ndarray, " views"]:
    squared = (s.residuals() ** 2).sum(1)
    count = np.maximum(np.bincount(s.obs_view, minlength=len(s.view_camera)), 1)
    rms = np.sqrt(np.bincount(s.obs_view, squared, len(s.view_camera)) / count)
    return rms > OUTLIER_FACTOR * max(float(np.quantile(rms, OUTLIER_QUANTILE)), 0.2)


def _covariance(s: _State, sigma: float) -> Float[np.ndarray, "n n"]:
    """Of camera poses and intrinsics, boards marginalised out."""
    J, _ = _system(s)
    free = _free(s)
    H = (J.T @ J).toarray()
    n = 15 * len(s.poses)
    boards = np.arange(n, len(H))
    V = H[np.ix_(boards, boards)] + 1e-9 * np.eye(len(boards))
    S = H[:n, :n] - H[:n, n:] @ np.linalg.solve(V, H[n:, :n])
    out, keep = np.zeros((n, n)), np.flatnonzero(free[:n])
    out[np.ix_(keep, keep)] = np.linalg.pinv(S[np.ix_(keep, keep)], hermitian=True) * sigma**2
    return out


def _gaps_ms(s: _State) -> tuple[float, float]:
    gaps = [
        float(np.ptp(s.view_dt[s.view_instant == i]))
        for i in np.unique(s.view_instant)
        if (s.view_instant == i).sum() > 1
    ]
    return (1e3 * float(np.median(gaps)), 1e3 * max(gaps)) if gaps else (0.0, 0.0)


def _project(k: Float[np.ndarray, "n 9"], x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    return distort_many(x[:, :2] / np.maximum(x[:, 2:], 1e-6), k[:, 4:]) * k[:, :2] + k[:, 2:4]


def _central(f, x: np.ndarray, column: int, scale: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    ahead, behind = x.copy(), x.copy()
    ahead[:, column] += STEP * scale
    behind[:, column] -= STEP * scale
    return (f(ahead) - f(behind)) / (2 * STEP * scale)[:, None]


def _minus_cross(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """-[x]_x, the derivative of exp(w) x by w at 0."""
    out = np.zeros((len(x), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = x[:, 2], -x[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -x[:, 2], x[:, 0]
    out[:, 2, 0], out[:, 2, 1] = x[:, 1], -x[:, 0]
    return out


def _compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.column_stack([a[:, :3] @ b[:, :3], a[:, :3] @ b[:, 3] + a[:, 3]])


def _inverse(a: np.ndarray) -> np.ndarray:
    return np.column_stack([a[:, :3].T, -a[:, :3].T @ a[:, 3]])
