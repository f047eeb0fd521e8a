"""Health rows of the stage `rig`."""

from typing import Any

import numpy as np

from devrf.calibration.rigs.board_route import BoardRig
from devrf.calibration.rigs.bump import Bump
from devrf.calibration.rigs.cross_check import RigCheck
from devrf.calibration.rigs.graph import Link, degree, is_opposed
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale
from devrf.calibration.rigs.scale import AGREEMENT
from devrf.pipelines.health.rows import HealthRow, note, row

GOOD_LINK, WEAK_LINK = 200.0, 50.0  # shared corners and points (caliscope)
LATE_MS = 10.0  # at 1 m/s a centimetre
PRIOR_STDS = 4.0  # a calibration that is missed by more was not what it claimed
BUMP_PX = 0.5  # a lasting movement of the background
ROUTES_DEG, ROUTES_PERCENT = 0.2, 0.5  # between two routes to the same camera; ...
ROUTES_STDS = 3.0  # ... or what their own doubts allow


def sweep_rows(name: str, c: RigCamera) -> list[HealthRow]:
    """How well the sweep supports one camera."""
    d: dict[str, Any] = c.details
    distance, along, across = d.get("median_distance"), d.get("axis_std"), d.get("sideways_std")
    rows = [
        row(
            f"points that {name} shares with the sweep",
            None if c.inliers is None else float(c.inliers),
            warn=100.0,
            fail=30.0,
            remedy=f"Film sweep pictures from near {name}, looking the same way; match exposure and colour.",
        ),
        row(
            f"share of the picture that {name}'s points cover",
            d.get("inlier_area"),
            warn=0.2,
            remedy=f"All points of {name} lie in one corner: film sweep pictures of what it sees elsewhere.",
        ),
    ]
    if d.get("matches"):
        rows.append(
            row(
                f"share of {name}'s matches with the sweep that fit one pose",
                d["verified"] / d["matches"],
                warn=0.25,
                remedy=f"The sweep looks different to {name}: take a few sweep pictures with the same device, or "
                "from beside it, with the same exposure and white balance.",
            )
        )
    if c.position_std is not None and distance:
        rows.append(
            row(
                f"position of {name}, standard deviation",
                100 * c.position_std / distance,
                "% of distance",
                warn_above=0.5,
                remedy=f"Focal length and distance trade off: film a board (capture.board.clips.{name}).",
            )
        )
    if along is not None and across:
        rows.append(
            row(
                f"distance of {name} against its place sideways, ratio of the standard deviations",
                along / across,
                warn_above=10.0,
                remedy=f"Focal length and distance of {name} trade off: fix the focal length by a board "
                f"(capture.board.clips.{name}).",
            )
        )
    return rows


def joint_rows(rig: BoardRig, check: RigCheck | None) -> list[HealthRow]:
    """How well the joint clips support the rig, and what it measures on views that no fit has seen."""
    dropped = ", ".join(f"{name} {frame}" for name, frame in rig.dropped) or "none"
    rows = [
        row(
            "reprojection error of the board rig, robust",
            rig.solution.sigma_px,
            "px",
            warn_above=1.0,
            fail_above=4.0,
            remedy="Move the board slowly and rest it often, use a flat, rigid print, and sync the cameras.",
        ),
        row(
            "time between views that count as one, largest",
            rig.gap_ms[1],
            "ms",
            warn_above=50.0,
            remedy="The cameras do not expose together: move the board slowly, or rest it.",
        ),
        note("board views that do not fit", dropped),
        *_clock_rows(rig),
        *_prior_rows(rig),
    ]
    if rig.shallow:
        rows.append(
            note(
                "focal lengths that keep to their calibration",
                f"{', '.join(rig.shallow)}: the board was seen at one distance only",
            )
        )
    if check is None:
        return [*rows, note("held-out lengths on the board", "too few views to keep some out of the fit")]
    return [
        *rows,
        row(
            "held-out lengths on the board, error of the median",
            check.error_percent,
            "%",
            warn_above=0.5,
            remedy="The pictures fit but the millimetres do not: check square_m, calibrate each camera with a board "
            "of its own (capture.board.clips), and move the joint board nearer and farther.",
        ),
        row(
            "held-out lengths on the board, far against near",
            abs(check.near_to_far_percent),
            "%",
            warn_above=1.0,
            remedy="Lengths depend on the distance: a focal length is wrong. Film the joint board at distances of "
            "one to two, so that it can be refined, or calibrate each camera again.",
        ),
        note(
            "held-out lengths on the board",
            f"{1e3 * float(np.median(check.lengths_m)):.2f} +- {check.spread_mm:.2f} mm (true "
            f"{1e3 * check.true_m:.2f}), {check.rms_px:.2f} px rms, {len(check.lengths_m)} lengths",
        ),
    ]


def _clock_rows(rig: BoardRig) -> list[HealthRow]:
    timing, std = rig.solution.problem.timing, rig.solution.delay_std_s
    assert timing is not None
    first = rig.views.names[0]
    rows = []
    for name, delay_s, std_s in zip(rig.views.names[1:], timing.delay_s[1:], std[1:], strict=True):
        rows.append(
            row(
                f"{name}'s clock against {first}'s, by the board's motion: {1e3 * delay_s:+.0f} ms",
                1e3 * abs(float(delay_s)),
                "ms",
                warn_above=max(LATE_MS, 3e3 * float(std_s)),
                remedy="The board's views fit only when the clocks are shifted by this: sync the joint clips (sound, "
                "or true times in capture.timestamps; a table that was used is late by this), or rest the board and "
                "keep only the rests.",
            )
        )
    rows.append(
        row(
            "uneven times of single pictures of the joint clips, standard deviation",
            1e3 * timing.lag_std_s,
            "ms",
            warn_above=LATE_MS,
            remedy="A camera hands out pictures late and unevenly (webcams do): record in the camera, or let the "
            "board rest. The times were allowed for here; moving scenes will suffer.",
        )
    )
    return rows


def _prior_rows(rig: BoardRig) -> list[HealthRow]:
    """Calibrated focal lengths that the joint views contradict."""
    problem, rows = rig.solution.problem, []
    for c, name in enumerate(rig.views.names):
        mean, std = problem.prior_mean[c, 0], problem.prior_std[c, 0]
        if np.isfinite(std):
            found = problem.intrinsics[c, 0]
            rows.append(
                row(
                    f"focal length of {name}, joint views ({found:.0f} px) against its calibration ({mean:.0f} px)",
                    abs(found - mean) / std,
                    "standard deviations",
                    warn_above=PRIOR_STDS,
                    remedy=f"The calibration of {name} is not what it claims: same zoom, focus and stabilisation in "
                    f"all clips? Film capture.board.clips.{name} again.",
                )
            )
    return rows


def graph_rows(graph: tuple[Link, ...], rig: Rig) -> list[HealthRow]:
    """Weak and leaf cameras, and pairs that can never see one board; only where the board alone ties them."""
    rows = []
    for name in rig.cameras:
        own = [link for link in graph if name in (link.a, link.b)]
        best = max(own, key=lambda link: link.shared)
        other = best.b if best.a == name else best.a
        rows.append(
            row(
                f"corners that {name} shares with {other}, its strongest link",
                float(best.shared),
                warn=GOOD_LINK,
                fail=WEAK_LINK,
                remedy=f"Hold the board where {name} and {other} both see it, for longer.",
            )
        )
        tied = degree(name, graph, WEAK_LINK)
        if tied == 1 and len(rig.cameras) > 2:
            rows.append(
                note(
                    f"links of {name}",
                    f"{name} hangs on one link, to {other}",
                    remedy=f"Hold the board where {name} and a camera other than {other} both see it.",
                )
            )
    for link in graph:
        a, b = rig.cameras[link.a].camera, rig.cameras[link.b].camera
        alone = min(degree(n, graph, WEAK_LINK) for n in (link.a, link.b)) < 2
        if link.shared == 0 and is_opposed(a, b):
            rows.append(
                note(
                    f"{link.a} and {link.b}",
                    "face each other: no side of a board is seen by both",
                    remedy="Use a board printed on both sides, or the sweep." if alone else "",
                )
            )
    return rows


def route_rows(
    differ: dict[str, tuple[float, float]], sweep: dict[str, RigCamera], board: BoardRig, unit: float
) -> tuple[list[HealthRow], bool]:
    """The sweep's cameras against the board's, and whether they are one rig at all.

    Args:
        differ: Name -> degrees, units of the sweep.
        unit: Sweep units per metre.
    """
    rows, same = [], True
    for name, (turn_deg, shift) in differ.items():
        c, n = sweep[name], board.views.names.index(name)
        covariance = board.solution.pose_covariance[n]
        doubt_deg = np.hypot(
            c.rotation_std_deg or 0.0, np.degrees(np.sqrt(max(np.trace(covariance[:3, :3]), 0)))
        )
        doubt = np.hypot(c.position_std or 0.0, unit * np.sqrt(max(np.trace(covariance[3:, 3:]), 0)))
        percent = 100 / max(c.details["median_distance"], 1e-9)
        for what, value, bound, doubt_of in (
            ("turn", turn_deg, ROUTES_DEG, doubt_deg),
            ("place", percent * shift, ROUTES_PERCENT, percent * doubt),
        ):
            warn = max(bound, ROUTES_STDS * float(doubt_of))
            same &= value <= 5 * warn
            rows.append(
                row(
                    f"{what} of {name}, sweep against board",
                    value,
                    "deg" if what == "turn" else "% of distance",
                    warn_above=warn,
                    remedy=f"The two routes to {name} disagree: was it touched between the clips, or is its focal "
                    "length wrong?",
                )
            )
    return rows, same


def bump_row(name: str, bump: Bump | None) -> HealthRow:
    """Whether a fixed camera stayed where it was."""
    check = f"movement of {name}'s background over the clip"
    if bump is None:
        return note(check, "too little texture behind what moves to tell")
    minutes, seconds = divmod(bump.at_s, 60)
    return row(
        check,
        bump.moved_px,
        "px",
        warn_above=BUMP_PX,
        remedy=f"{name} moved at {int(minutes):02d}:{seconds:04.1f} of its clip: use only what was filmed before or "
        "after (capture.range_s), fix the tripod, switch stabilisation off.",
    )


def scale_rows(found: list[Scale], used: Scale, unmeasured_board: bool = False) -> list[HealthRow]:
    """What says how long a unit is, and whether several measures agree; a board may lack no more than a ruler."""
    rows: list[HealthRow] = []
    for n, one in enumerate(found):
        for other in found[n + 1 :]:
            rows.append(
                row(
                    f"scale: {one.source} against {other.source}",
                    100 * abs(other.factor / one.factor - 1),
                    "%",
                    warn_above=100 * AGREEMENT,
                    remedy="Two measures of length disagree: measure the squares and the distance again.",
                )
            )
    if used.metric:
        std = "" if used.std is None else f", +- {100 * used.std:.2f} %"
        return [*rows, note("scale", f"metres: {used.source}{std}")]
    board = (
        "measure a square of the board, put it into capture.board.square_m (and marker_m) and remove metric: false"
        if unmeasured_board
        else "let a board stand in the scene during the sweep (capture.board)"
    )
    remedy = (
        f"Lengths are not metres: {board}, or give calibration.rig.known_distance_m, or calibration.rig.given_unit of "
        "a given calibration."
    )
    return [*rows, note("scale", ARBITRARY.source, remedy=remedy)]
