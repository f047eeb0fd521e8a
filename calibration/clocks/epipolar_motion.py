"""The delay between two clips of calibrated cameras, by what moves in each epipolar plane.

Two cameras span a pencil of planes around the line between their centres. A point lies in one of these
planes, whichever camera looks, and so both cameras see it turn around that line at the same angle and rate:
the epipolar constraint. Each picture is reduced to the flow across the planes, plane by plane, once for
each sense of turning. These courses are compared at every trial delay. No point has to be found again in the
other view, so cameras that see a subject from opposite sides can be compared too; but what one of them
does not see shifts the peak, so half a frame is the best accuracy to be claimed.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d

from devrf.calibration.clocks.motion import MIN_OVERLAP_STEPS, MotionDelay, course_delay
from devrf.capture.camera import Camera

FLOW_SIDE_PX = 320  # of the longer side: a limb still covers a few pixels, and a frame takes 10 ms
MIN_FLOW_PX = 0.3  # a frame; below it is noise
MIN_MOVING_PX = 200  # over the whole clip: fewer are noise
PLANES = 48  # over what moves: a limb fills several
PLANE_BLUR = 0.7  # standard deviation, planes
SPAN_QUANTILES = (0.01, 0.99)
# The angle of a plane changes by more than this per pixel only at the epipole and where it wraps.
FOLD_RAD = 0.2
ACCEPT_CORRELATION = 0.4  # views from opposite sides of a person: 0.45 to 0.8 at the right delay
ACCEPT_MARGIN = 0.1  # as for motion energies


@dataclass(frozen=True)
class TimedPictures:
    """What a calibrated camera saw: grey pictures [n, h, w] and their file times [n], seconds."""

    camera: Camera
    grey: UInt8[np.ndarray, "n h w"]
    time_s: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Flow:
    """Flow between successive pictures [n, h, w, 2], pixels of `camera`'s size, at the times midway [n]."""

    camera: Camera
    flow: Float[np.ndarray, "n h w 2"]
    time_s: Float[np.ndarray, " n"]


def clip_flow(pictures: TimedPictures) -> Flow:
    """Dense flow of a clip at a small size."""
    h, w = pictures.grey.shape[1:]
    small = pictures.camera.scaled(min(1.0, FLOW_SIDE_PX / max(h, w)) * w / pictures.camera.width)
    size = (small.width, small.height)
    grey = [cv2.resize(g, size, interpolation=cv2.INTER_AREA) for g in pictures.grey]
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    start = np.zeros((*size[::-1], 2), np.float32)
    flow = [estimator.calc(a, b, start.copy()) for a, b in zip(grey[:-1], grey[1:], strict=True)]
    middle_s = (pictures.time_s[1:] + pictures.time_s[:-1]) / 2
    return Flow(small, np.array(flow).reshape(-1, *size[::-1], 2), middle_s)


def epipolar_motion_delay(first: Flow, second: Flow) -> MotionDelay | None:
    """Delay (file time in the first clip minus file time in the second) by the motion in each epipolar plane.

    Returns:
        None where a clip is too short, nothing moves across the planes, or the views share no plane.
    """
    if min(len(first.time_s), len(second.time_s)) < MIN_OVERLAP_STEPS:
        return None
    axes = _pencil(first.camera, second.camera)
    if axes is None:
        return None
    turns = [_turning(view, *axes) for view in (first, second)]
    spans = [np.quantile(angle, SPAN_QUANTILES) for angle, _, _ in turns if len(angle) >= MIN_MOVING_PX]
    if len(spans) < 2:
        return None
    low, high = max(s[0] for s in spans), min(s[1] for s in spans)
    if low >= high:
        return None
    courses = []
    for view, (angle, rate, frame) in zip((first, second), turns, strict=True):
        plane = np.floor((angle - low) / (high - low) * PLANES).astype(int)
        inside = (plane >= 0) & (plane < PLANES)
        cell = frame[inside] * PLANES + plane[inside]
        size = len(view.time_s) * PLANES
        senses = [np.bincount(cell, np.maximum(sign * rate[inside], 0), size) for sign in (1, -1)]
        course = [gaussian_filter1d(c.reshape(-1, PLANES), PLANE_BLUR, axis=1) for c in senses]
        courses.append(np.concatenate(course, axis=1))
    return course_delay(first.time_s, courses[0], second.time_s, courses[1])


def accepted(found: MotionDelay) -> bool:
    """Whether a delay found by the motion in epipolar planes stands out enough to be believed."""
    return found.correlation >= ACCEPT_CORRELATION and found.margin >= ACCEPT_MARGIN


def _pencil(a: Camera, b: Camera) -> tuple[np.ndarray, np.ndarray] | None:
    """Two world axes [3] across the line between two cameras, the first one where both look; None if they
    stand at one place."""
    line = b.centre - a.centre
    length = np.linalg.norm(line)
    if length < 1e-9:
        return None
    line /= length
    view = a.cam_from_world[2, :3] + b.cam_from_world[2, :3]
    across = view - (view @ line) * line
    if np.linalg.norm(across) < 0.2:  # they look at each other: the line's other sides are as good
        up = -a.cam_from_world[1, :3]
        across = up - (up @ line) * line
    across /= np.linalg.norm(across)
    return across, np.cross(line, across)


def _turning(view: Flow, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle of the epipolar plane (rad), rate of turning (rad per s) and picture of all moving pixels."""
    camera = view.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.directions(np.stack([u, v], axis=-1))
    angle = np.arctan2(rays @ y, rays @ x)
    down, right = np.gradient(angle)
    step_s = np.median(np.diff(view.time_s))
    rate = (view.flow[..., 0] * right + view.flow[..., 1] * down) / step_s
    moving = np.hypot(view.flow[..., 0], view.flow[..., 1]) > MIN_FLOW_PX
    moving &= np.hypot(down, right) < FOLD_RAD
    frame, row, column = np.nonzero(moving)
    return angle[row, column], rate[frame, row, column], frame
