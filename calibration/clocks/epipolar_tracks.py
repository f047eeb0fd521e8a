"""The delay between two clips of calibrated cameras, by points that both saw move.

Points on what moves are followed through a few frames in each clip and found again in the other by their
descriptors. At the right delay every pair of tracks obeys the epipolar constraint; at a trial delay it misses
it by the distance the point moved across the epipolar line meanwhile. The mean Sampson error against the
trial delay has its minimum at the true one (the check of two-view geometry with a time shift: Albl et al.,
CVPR 2017). Cameras must see the same side of the subject; others are compared by `epipolar_motion`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.interpolate import CubicSpline

from devrf.calibration.clocks.epipolar_motion import TimedPictures
from devrf.calibration.features import mutual_matches
from devrf.capture.camera import Camera

AROUND = 2  # frames before and after a moment at which the first camera's track is compared
MOVING_LEVELS = 12.0  # grey levels a pixel changes over the clip: the subject, not the sensor's noise
SIFT_CONTRAST = 0.015  # below OpenCV's 0.04: skin and cloth are plain; wrong ones fail the ratio test
BACK_PX = 0.5  # a track that does not come back to where it started is lost
MIN_WAY_PX = 1.0  # over the whole track; what stands still says nothing of time
RATIO = 0.8  # second best to best descriptor
CUT_PX = 2.0  # errors beyond count as this much: a wrong match
WRONG_SHARE = 0.5  # more wrong matches than this: views too different for descriptors
LAGS_PER_FRAME = 8  # of the trial delays; a parabola interpolates
MIN_MATCHES, MIN_KEYS = 30, 4
LEAST_DEPTH_PX = 0.1  # of the curve: tracks are no better, so a flatter one has its minimum anywhere
STD_FLOOR_FRAMES = 0.02  # tracks are interpolated between frames, and the moments share their calibration
LK = {"winSize": (15, 15), "maxLevel": 2}


@dataclass(frozen=True)
class PointTracks:
    """Points followed through some frames: ideal coordinates [n, t, 2] at file times [t], descriptors [n, d]."""

    time_s: Float[np.ndarray, " t"]
    points: Float[np.ndarray, "n t 2"]
    descriptors: Float[np.ndarray, "n d"]


@dataclass(frozen=True)
class TrackDelay:
    """How two clips lie to each other by the tracks of common points.

    Attributes:
        delay_s: File time in the first clip minus file time in the second, where the error is smallest.
        std_s: Standard deviation of the delay (jackknife over the moments that were compared).
        matches: Number of pairs of tracks.
        lags_s, error_px: Trial delays and mean Sampson error there, pixels, each cut at `CUT_PX` [n].
    """

    delay_s: float
    std_s: float
    matches: int
    lags_s: Float[np.ndarray, " n"]
    error_px: Float[np.ndarray, " n"]


class TrackFinder:
    """Finds tracks in one clip, and remembers them."""

    def __init__(self, pictures: TimedPictures) -> None:
        """Look where the clip moves."""
        self.pictures = pictures
        self.step_s = float(np.median(np.diff(pictures.time_s)))
        self._mask = _moving(pictures.grey)
        self._described: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._found: dict[tuple[int, int], PointTracks | None] = {}
        self._lock = Lock()  # two pairs of cameras that share this one ask side by side

    def near(self, time_s: float) -> int:
        """Index of the picture nearest to a file time."""
        return int(np.argmin(np.abs(self.pictures.time_s - time_s)))

    def at(self, index: int, around: int) -> PointTracks | None:
        """Tracks from `around` frames before a picture to as many after it; None where there are none."""
        key = (index, around)
        with self._lock:
            if key not in self._found:
                self._found[key] = self._track(index, around)
        return self._found[key]

    def _track(self, index: int, around: int) -> PointTracks | None:
        grey, count = self.pictures.grey, len(self.pictures.grey)
        if index not in self._described:
            self._described[index] = _describe(grey[index], self._mask)
        start, descriptors = self._described[index]
        if not len(start):
            return None
        path, whole = {index: start}, np.ones(len(start), dtype=bool)
        for step in (1, -1):
            for at in range(index + step, index + step * (around + 1), step):
                if not 0 <= at < count:
                    break
                path[at], held = _follow(grey[at - step], grey[at], path[at - step])
                whole &= held
        frames = sorted(path)
        points = np.stack([path[f] for f in frames], axis=1)
        whole &= np.linalg.norm(points[:, -1] - points[:, 0], axis=1) > MIN_WAY_PX
        if not whole.any():
            return None
        ideal = _ideal(self.pictures, points[whole])
        return PointTracks(self.pictures.time_s[frames], ideal, descriptors[whole])


def track_delay(
    first: TrackFinder,
    second: TrackFinder,
    moments_s: Sequence[tuple[float, float]],
    around_s: float,
    search_s: float,
) -> TrackDelay | None:
    """Delay between two clips near `around_s`, at most `search_s` from it.

    Args:
        first, second: The clips.
        moments_s: File times in both at which common points are looked for, `around_s` apart.
        around_s, search_s: Where the delay is sought.
    Returns:
        None where too few points are found in both, most are wrong, the error is the same everywhere (they move
        along epipolar lines), or smallest at the end of the search.
    """
    lag_s = min(first.step_s, second.step_s) / LAGS_PER_FRAME
    count = int(np.ceil(search_s / lag_s))
    lags_s = around_s + lag_s * np.arange(-count, count + 1)
    reach = AROUND + int(np.ceil((search_s + first.step_s + AROUND * first.step_s) / second.step_s))
    a, b = first.pictures, second.pictures
    E = essential(a.camera, b.camera)
    focal_px = 0.5 * sum(p.camera.K[0, 0] * p.grey.shape[2] / p.camera.width for p in (a, b))
    errors, keys = [], []
    for key, (first_s, second_s) in enumerate(moments_s):
        p, q = first.at(first.near(first_s), AROUND), second.at(second.near(second_s), reach)
        if p is None or q is None:
            continue
        for i, j in zip(*mutual_matches(p.descriptors, q.descriptors, RATIO), strict=True):
            error = _errors(E, p.time_s, p.points[i], q.time_s, q.points[j], lags_s)
            if error is not None:
                errors.append(np.minimum(focal_px * error, CUT_PX))
                keys.append(key)
    if len(errors) < MIN_MATCHES or len(set(keys)) < MIN_KEYS:
        return None
    floor_s = STD_FLOOR_FRAMES * max(first.step_s, second.step_s)
    found = _minimum(lags_s, np.array(errors), np.array(keys), floor_s)
    if (
        found is None
        or found.error_px.min() > WRONG_SHARE * CUT_PX
        or np.ptp(found.error_px) < LEAST_DEPTH_PX
    ):
        return None
    return found


def essential(a: Camera, b: Camera) -> Float[np.ndarray, "3 3"]:
    """E with x_b^T E x_a = 0 for ideal coordinates of one point (Hartley & Zisserman, Section 9.6)."""
    R = b.cam_from_world[:, :3] @ a.cam_from_world[:, :3].T
    x, y, z = b.cam_from_world[:, 3] - R @ a.cam_from_world[:, 3]
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R


def sampson(
    E: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "*batch 2"], q: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    """Sampson error of ideal coordinates, signed (Hartley & Zisserman, Section 11.4.3), to first order the
    distance of the pair from obeying the epipolar constraint."""
    x, y = (np.concatenate([v, np.ones_like(v[..., :1])], axis=-1) for v in (p, q))
    line_b, line_a = x @ E.T, y @ E
    norm = np.sqrt(np.square(line_a[..., :2]).sum(-1) + np.square(line_b[..., :2]).sum(-1))
    return (y * line_b).sum(-1) / np.maximum(norm, np.finfo(float).tiny)


def _errors(
    E: np.ndarray, p_s: np.ndarray, p: np.ndarray, q_s: np.ndarray, q: np.ndarray, lags_s: np.ndarray
) -> Float[np.ndarray, " n"] | None:
    """Root mean square Sampson error of two tracks at each trial delay; None where the second is too short."""
    at_s = p_s[:, None] - lags_s
    if at_s.min() < q_s[0] or at_s.max() > q_s[-1]:
        return None
    moved = CubicSpline(q_s, q)(at_s)
    error = sampson(E, np.broadcast_to(p[:, None], moved.shape), moved)
    return np.sqrt(np.mean(np.square(error), axis=0))


def _minimum(
    lags_s: Float[np.ndarray, " n"],
    errors: Float[np.ndarray, "m n"],
    keys: Int[np.ndarray, " m"],
    floor_s: float,
) -> TrackDelay | None:
    """Where the mean error is smallest, and how far that moves when single moments are left out."""
    total = errors.sum(axis=0)
    best = _lowest(lags_s, total)
    if best is None:
        return None
    without = [_lowest(lags_s, total - errors[keys == key].sum(axis=0)) for key in np.unique(keys)]
    places = np.array([v for v in without if v is not None])
    if len(places) < len(without):
        return None
    n = len(places)
    spread_s = float(np.sqrt((n - 1) / n * np.square(places - places.mean()).sum()))
    return TrackDelay(best, float(np.hypot(floor_s, spread_s)), len(errors), lags_s, total / len(errors))


def _lowest(lags_s: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]) -> float | None:
    k = int(np.argmin(values))
    if not 0 < k < len(values) - 1:
        return None
    left, mid, right = (float(v) for v in values[k - 1 : k + 2])
    bend = left - 2 * mid + right
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float(lags_s[k] + shift * (lags_s[1] - lags_s[0]))


def _describe(
    grey: UInt8[np.ndarray, "h w"], mask: UInt8[np.ndarray, "h w"]
) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 2] (float32, OpenCV's pixels) and RootSIFT descriptors [n, 128] of unit length."""
    points, descriptors = cv2.SIFT.create(contrastThreshold=SIFT_CONTRAST).detectAndCompute(grey, mask)
    if not len(points):
        return np.zeros((0, 2), np.float32), np.zeros((0, 128))
    share = descriptors.astype(np.float64)
    # RootSIFT: Arandjelovic & Zisserman, CVPR 2012
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-9)
    return np.array([p.pt for p in points], np.float32), np.sqrt(share)


def _follow(
    before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"], points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Points in the next picture, and which of them come back from there."""
    p = points[:, None]
    forth, found, _ = cv2.calcOpticalFlowPyrLK(before, after, p, p.copy(), **LK)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, forth, p.copy(), **LK)
    held = (found[:, 0] > 0) & (again[:, 0] > 0) & (np.linalg.norm(back - p, axis=2)[:, 0] < BACK_PX)
    return forth[:, 0], held


def _ideal(pictures: TimedPictures, points: Float[np.ndarray, "n t 2"]) -> Float[np.ndarray, "n t 2"]:
    """Pixels of the pictures (OpenCV's, first centre at 0) as coordinates on the plane at depth 1."""
    camera, (h, w) = pictures.camera, pictures.grey.shape[1:]
    rays = camera.directions((points + 0.5) * [camera.width / w, camera.height / h])
    rays = rays @ camera.cam_from_world[:, :3].T
    return rays[..., :2] / rays[..., 2:]


def _moving(grey: UInt8[np.ndarray, "n h w"]) -> UInt8[np.ndarray, "h w"]:
    """Where the clip changes (255), a little widened."""
    change = (grey.max(axis=0) - grey.min(axis=0)).astype(np.float32)
    mask = (cv2.GaussianBlur(change, (0, 0), 2.0) > MOVING_LEVELS).astype(np.uint8) * 255
    return cv2.dilate(mask, np.ones((5, 5), np.uint8))
