"""Smooth camera paths through given views: from training view to training view, or from key frame to key frame.

Between training views a camera moves about what they look at, not along chords, which would cut through the
subject: azimuth, elevation and the logarithm of the distance run on monotone cubic splines (Fritsch & Carlson, SIAM J.
Numer. Anal. 1980), which stay between their knots. Its rotation is that of looking at the target, and the rest of
each view's rotation turned from view to view (`RotationSpline` of scipy). Key frames are taken as they are: their
positions and rotations run on the same kinds of splines. At its knot a view is met exactly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from devrf.capture.camera import Camera
from devrf.capture.errors import InputError
from devrf.capture.scene import Scene
from devrf.reconstruct.film.span import Span, fixed_cameras, wrap
from devrf.reconstruct.pictures import spread, training

MOST_OF_SWEEP = 8  # views of a sweep that a film passes through where there are no fixed cameras
LEAST_STEP = 0.02  # of the way between two views, radians: views at one place need time, too
WRAPPED = 2  # views of a closed path that are repeated before and after it, so that it is smooth there


def views_of(scene: Scene, names: Sequence[str] = ()) -> list[Camera]:
    """The views to pass through.

    Args:
        scene: In the box frame.
        names: Cameras of the moving scene in the order they are met; none: all that are trained on, by azimuth, or
            some of the sweep's pictures where there are none or one.
    Raises:
        InputError: A camera that is not there, or fewer than two different ones.
    """
    if names:
        known = {f.camera_name: f.camera for f in scene.dynamic}
        missing = [name for name in names if name not in known]
        if missing:
            text = f"--path between: no camera {', '.join(missing)}; expected some of {', '.join(known) or 'none'}"
            raise InputError("camera-unknown", text)
        if len(set(names)) < 2:
            text = f"--path between:{','.join(names)}: one camera is named; expected two or more, or none for all"
            raise InputError("cameras-too-few", text)
        return [known[name] for name in names]
    fixed = list(fixed_cameras(scene).values())
    if len(fixed) < 2:
        return [f.camera for f in spread(training(scene.static), MOST_OF_SWEEP)]
    span = Span.of(fixed, scene.aabb)
    order = np.argsort((span.azimuth - span.start + 1e-9) % (2 * np.pi))
    return [fixed[n] for n in order.tolist()]


def between(
    views: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera, closed: bool
) -> list[Camera]:
    """Through two views or more about what they look at, gently begun and ended; at an even pace where closed.

    Args:
        views: In the box frame; only their poses count.
        aabb: Box corners [2, 3].
        count: Number of pictures.
        lens: A camera with the pictures' size and intrinsics.
        closed: From the last view on to the first again.
    """
    span = Span.of(views, aabb)
    centres = np.array([view.centre for view in views])
    azimuth, elevation, distance = span.told(centres)
    places = np.column_stack([azimuth, elevation, np.log(distance)])
    turns = np.array([0.0, 0.0, 0.0])
    if closed:
        ways = wrap(np.diff(np.append(azimuth, azimuth[0])))
        turns[0] = ways.sum()
        places[:, 0] = azimuth[0] + np.append(0, np.cumsum(ways[:-1]))
    else:
        places[:, 0] = azimuth[0] + np.append(0, np.cumsum(wrap(np.diff(azimuth))))
    rest = [
        view.cam_from_world[:, :3] @ span.looking(lens, centre).cam_from_world[:, :3].T
        for view, centre in zip(views, centres, strict=True)
    ]
    steps = np.linalg.norm(np.diff(np.vstack([places, places[:1] + turns]), axis=0), axis=1)
    knots = np.append(0, np.cumsum(np.maximum(steps, LEAST_STEP)))
    phase = np.arange(count) / count if closed else _eased(count)
    at = phase * (knots[-1] if closed else knots[-2])
    told, turned = _splined(knots, places, np.array(rest), turns, at, closed)
    out = []
    for (a, e, d), R in zip(told, turned, strict=True):
        towards = span.looking(lens, span.place(a, e, float(np.exp(d))))
        R = R @ towards.cam_from_world[:, :3]
        out.append(replace(lens, cam_from_world=np.column_stack([R, -R @ towards.centre])))
    return out


def through(
    views: Sequence[Camera], knots: Float[np.ndarray, " n"], at: Float[np.ndarray, " count"]
) -> list[Camera]:
    """Key frames met at `knots` (rising), and what lies between them at `at`; focal lengths are blended."""
    if len(views) == 1:
        return [views[0]] * len(at)
    centres = np.array([view.centre for view in views])
    R = np.array([view.cam_from_world[:, :3] for view in views])
    places, turned = _splined(np.append(knots, knots[-1] + 1), centres, R, np.zeros(3), at, False)
    lenses = PchipInterpolator(knots, np.array([view.K for view in views]))(at)
    return [
        replace(views[0], K=K, cam_from_world=np.column_stack([turn, -turn @ place]))
        for K, turn, place in zip(lenses, turned, places, strict=True)
    ]


def _splined(
    knots: np.ndarray, places: np.ndarray, R: np.ndarray, turns: np.ndarray, at: np.ndarray, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Places [count, 3] and rotations [count, 3, 3] at `at`; the last of `knots` is where a closed path closes."""
    n = len(places)
    which = np.arange(-WRAPPED, n + 1 + WRAPPED) if closed else np.arange(n)
    turn = which // n
    when = knots[which % n] + turn * knots[-1]
    values = places[which % n] + turn[:, None] * turns
    rotations = Rotation.from_matrix(R[which % n])
    return PchipInterpolator(when, values)(at), RotationSpline(when, rotations)(at).as_matrix()


def _eased(count: int) -> Float[np.ndarray, " count"]:
    """From 0 to 1, begun and ended at rest."""
    return 0.5 - 0.5 * np.cos(np.pi * np.linspace(0, 1, count))
