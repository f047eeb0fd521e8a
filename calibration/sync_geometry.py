"""Clocks checked by geometry once cameras are known: the epipolar error against trial offset.

Every picture carries its time by the clocks to be checked. Two cameras' pictures of what moves obey the
epipolar constraint where trial times agree; so the error must be smallest at a trial offset of 0, and clearly
so. Cameras that see the same side of the subject are compared by tracks of common points
(`epipolar_tracks`, good to a few hundredths of a frame), the others by the motion in each epipolar plane
(`epipolar_motion`, half a frame).
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.calibration.clock_equations import Clock, Equation, Loop, consistent, loops, solve
from devrf.calibration.epipolar_motion import Flow, TimedPictures, accepted, clip_flow, epipolar_motion_delay
from devrf.calibration.epipolar_tracks import TrackFinder, track_delay
from devrf.capture.progress import Progress, no_progress

SEARCH_FRAMES = 3.0  # around the clocks' own statement; in-camera lags are one to three frames
SEARCH_SIGMAS = 3.0
LARGEST_SEARCH_FRAMES = 6.0
FLAT_FRAMES = 0.5  # a minimum that is not known better than this many frames shows nothing
SHIFT_FRAMES = 0.25  # a minimum farther from 0 than this is no rounding
SHIFT_SIGMAS = 3.0
BETTER = 0.5  # geometry replaces a clock only where its standard deviation is at most half as large


@dataclass(frozen=True)
class PairCheck:
    """Two cameras compared.

    Attributes:
        first, second: Cameras.
        by: Tracks of common points, or the motion in epipolar planes.
        offset_s: Where the error is smallest: what the second camera's times must be raised by.
        std_s: Its standard deviation.
        sharp: Whether the minimum is known to half a frame.
        lags_s, values: The curve [n]: mean error, pixels (tracks), or correlation (planes).
    """

    first: str
    second: str
    by: Literal["tracks", "planes"]
    offset_s: float
    std_s: float
    sharp: bool
    lags_s: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Correction:
    """What geometry says of one clock.

    Attributes:
        offset_s: What must be added to the camera's times, seconds.
        std_s: Its standard deviation.
        sharp: Whether it is known to half a frame.
        shifted: Whether it is not 0 (beyond a quarter of a frame and three standard deviations).
    """

    offset_s: float
    std_s: float
    sharp: bool
    shifted: bool


@dataclass(frozen=True)
class GeometryCheck:
    """The check of all clocks: pairs, corrections of the cameras they reach (not the first), loops, notes."""

    pairs: tuple[PairCheck, ...]
    corrections: dict[str, Correction]
    loops: tuple[Loop, ...]
    notes: tuple[str, ...]


def check_clocks(
    views: Mapping[str, TimedPictures], clocks: Mapping[str, Clock], progress: Progress = no_progress
) -> GeometryCheck:
    """Compare all pairs of cameras.

    Args:
        views: Camera -> camera and pictures, whose times are those of the clocks to be checked.
        clocks: The clocks, for how sure they are.
        progress: Called after each pair.
    """
    names = list(views)
    finders = {name: TrackFinder(view) for name, view in views.items()}
    flows = {name: clip_flow(view) for name, view in views.items()}
    pairs, notes = [], []
    combinations = list(itertools.combinations(names, 2))
    for i, (a, b) in enumerate(combinations):
        progress(i / len(combinations), f"geometry of {a} and {b}")
        unsure_s = float(np.hypot(clocks[a].std_s, clocks[b].std_s))
        found = _compare(a, b, finders, flows, unsure_s)
        if found is None:
            notes.append(f"{a} and {b}: nothing to compare that moves in both")
            continue
        pairs.append(found)
        if not found.sharp:
            notes.append(f"{a} and {b}: not observable, what moves there moves along epipolar lines")
    equations = [Equation(p.first, p.second, p.offset_s, 0.0, p.std_s, "geometry", 1.0) for p in pairs]
    spans = {n: (float(v.time_s[0]), float(v.time_s[-1])) for n, v in views.items()}
    kept, dropped = consistent(spans, equations)
    notes += [f"{e.a} and {e.b}: geometry contradicts the other pairs; dropped" for e in dropped]
    corrections = {}
    if kept:
        solution = solve(spans, kept)
        for name in names[1:]:
            if name in solution.offset_s:
                corrections[name] = _correction(
                    solution.offset_s[name], solution.std_s[name], finders[name].step_s
                )
    return GeometryCheck(tuple(pairs), corrections, tuple(loops(names, kept)), tuple(notes))


def refined(clocks: Mapping[str, Clock], check: GeometryCheck) -> dict[str, Clock]:
    """The clocks that motion or nothing gave, replaced where geometry is sharp and much surer."""
    out = dict(clocks)
    for name, correction in check.corrections.items():
        clock = clocks[name]
        surer = correction.std_s <= BETTER * clock.std_s
        if clock.method in ("motion", "none") and clock.std_s > 0 and correction.sharp and surer:
            out[name] = Clock(
                clock.offset_s + correction.offset_s,
                clock.drift_ppm,
                correction.std_s,
                "geometry",
                max(clock.confidence, 0.9),
                f"epipolar error smallest {1e3 * correction.offset_s:+.1f} ms from the clock by {clock.method}",
            )
    return out


def _compare(
    a: str, b: str, finders: Mapping[str, TrackFinder], flows: Mapping[str, Flow], unsure_s: float
) -> PairCheck | None:
    """The better of tracks and planes; tracks are sought where the clocks say, else where the planes say."""
    step_s = max(finders[a].step_s, finders[b].step_s)
    search_s = step_s * float(
        np.clip(SEARCH_SIGMAS * unsure_s / step_s, SEARCH_FRAMES, LARGEST_SEARCH_FRAMES)
    )
    planes = epipolar_motion_delay(flows[a], flows[b])
    if planes is not None and not accepted(planes):
        planes = None
    centres = [0.0]
    if planes is not None and abs(planes.delay_s) > search_s / 2:
        centres.append(planes.delay_s)
    tracks = [t for c in centres if (t := track_delay(finders[a], finders[b], c, search_s)) is not None]
    best = min(tracks, key=lambda t: float(t.error_px.min()), default=None)
    if best is not None and (planes is None or best.std_s < planes.std_s):
        sharp = best.std_s <= FLAT_FRAMES * step_s
        return PairCheck(a, b, "tracks", best.delay_s, best.std_s, sharp, best.lags_s, best.error_px)
    if planes is None:
        return None
    sharp = planes.std_s <= 2 * FLAT_FRAMES * step_s  # half a frame is its floor, not what it measures
    return PairCheck(a, b, "planes", planes.delay_s, planes.std_s, sharp, planes.lags_s, planes.values)


def _correction(offset_s: float, std_s: float, step_s: float) -> Correction:
    limit_s = max(SHIFT_FRAMES * step_s, SHIFT_SIGMAS * std_s)
    return Correction(offset_s, std_s, std_s <= FLAT_FRAMES * step_s, abs(offset_s) > limit_s)
