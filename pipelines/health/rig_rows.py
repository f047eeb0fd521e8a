"""What the stage `rig` measures of its cameras: what ties them, where two routes disagree, how long a unit is."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from devrf.calibration.rigs.board_route import BoardRig
from devrf.calibration.rigs.bump import Bump
from devrf.calibration.rigs.cross_check import RigCheck
from devrf.calibration.rigs.graph import Link, degree, is_opposed
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale
from devrf.calibration.rigs.scale import AGREEMENT
from devrf.capture.measure import Measure

WEAK_LINK = 50.0  # shared corners and points (caliscope)
LATE_MS = 10.0  # at 1 m/s a centimetre
ROUTES_DEG, ROUTES_PERCENT = 0.2, 0.5  # between two routes to the same camera; ...
ROUTES_STDS = 3.0  # ... or what their own doubts allow
APART = 5.0  # times that: not one rig


def sweep_measures(name: str, c: RigCamera) -> Iterator[Measure]:
    """How well the sweep supports one camera."""
    d, distance = c.details, c.details.get("median_distance")
    yield Measure("camera-points", c.inliers, name)
    yield Measure("camera-points-crowded", d.get("inlier_area"), name)
    if d.get("matches"):
        yield Measure("camera-matches", d["verified"] / d["matches"], name)
    if c.position_std is not None and distance:
        yield Measure("camera-position", 100 * c.position_std / distance, name)


def joint_measures(rig: BoardRig, check: RigCheck | None) -> Iterator[Measure]:
    """How well the joint clips support the rig, and what it measures on views that no fit has seen."""
    yield Measure("board-rig-error", rig.solution.sigma_px)
    timing, std = rig.solution.problem.timing, rig.solution.delay_std_s
    assert timing is not None
    first, *others = rig.views.names
    for name, delay_s, std_s in zip(others, timing.delay_s[1:], std[1:], strict=True):
        facts = {"delay_ms": 1e3 * float(delay_s), "first": first}
        warn = max(LATE_MS, 3e3 * float(std_s))
        yield Measure("clocks-disagree", 1e3 * abs(float(delay_s)), name, "board", facts, warn=warn)
    if check is not None:
        yield Measure("board-lengths", check.error_percent)


def graph_measures(graph: tuple[Link, ...], rig: Rig) -> Iterator[Measure]:
    """The strongest link of each camera, and cameras that hang on one; only where the board alone ties them."""
    for name in rig.cameras:
        own = [link for link in graph if name in (link.a, link.b)]
        best = max(own, key=lambda link: link.shared)
        other = best.b if best.a == name else best.a
        yield Measure("rig-link", best.shared, name, facts={"other": other})
        if degree(name, graph, WEAK_LINK) == 1 and len(rig.cameras) > 2:
            opposite = [link.b if link.a == name else link.a for link in own if _is_opposed(link, rig)]
            faces = f"; {' and '.join(opposite)} faces it: use a board printed on both sides, or the sweep"
            facts = {"other": other, "faces": faces if opposite else ""}
            yield Measure("rig-link", f"hangs on one, to {other}", name, "single", facts)


def _is_opposed(link: Link, rig: Rig) -> bool:
    """Whether no side of a board is seen by both."""
    return link.shared == 0 and is_opposed(rig.cameras[link.a].camera, rig.cameras[link.b].camera)


def route_measures(
    differ: dict[str, tuple[float, float]], sweep: dict[str, RigCamera], board: BoardRig, unit: float
) -> tuple[list[Measure], bool]:
    """The sweep's cameras against the board's, and whether they are one rig at all.

    Args:
        differ: Name -> degrees, units of the sweep.
        unit: Sweep units per metre.
    """
    found, same = [], True
    for name, (turn_deg, shift) in differ.items():
        c, n = sweep[name], board.views.names.index(name)
        covariance = board.solution.pose_covariance[n]
        doubt_deg = np.hypot(
            c.rotation_std_deg or 0.0, np.degrees(np.sqrt(max(np.trace(covariance[:3, :3]), 0)))
        )
        doubt = np.hypot(c.position_std or 0.0, unit * np.sqrt(max(np.trace(covariance[3:, 3:]), 0)))
        percent = 100 / max(c.details["median_distance"], 1e-9)
        for what, value, bound, doubt_of in (
            ("rotation, degrees", turn_deg, ROUTES_DEG, doubt_deg),
            ("position, % of distance", percent * shift, ROUTES_PERCENT, percent * doubt),
        ):
            warn = max(bound, ROUTES_STDS * float(doubt_of))
            same &= value <= APART * warn
            found.append(Measure("rig-routes", value, f"{name}, {what}", facts={"name": name}, warn=warn))
    return found, same


def bump_measures(name: str, bump: Bump | None) -> list[Measure]:
    """Whether a fixed camera stayed where it was; nothing where too little texture tells."""
    if bump is None:
        return []
    minutes, seconds = divmod(bump.at_s, 60)
    return [
        Measure("camera-bumped", bump.moved_px, name, facts={"at": f"{int(minutes):02d}:{seconds:04.1f}"})
    ]


def scale_measures(found: list[Scale], used: Scale, unmeasured_board: bool = False) -> Iterator[Measure]:
    """What says how long a unit is, and whether several measures agree; a board may lack no more than a ruler."""
    for one, other in combinations(found, 2):
        apart = abs(other.factor / one.factor - 1)
        if apart > AGREEMENT:
            yield Measure(
                "scale", f"{one.source} against {other.source}: {100 * apart:.2g} % apart", why="differ"
            )
    if used.metric:
        std = "" if used.std is None else f", +- {100 * used.std:.2f} %"
        yield Measure("scale", f"metres: {used.source}{std}", found="ok")
    else:
        yield Measure("scale", ARBITRARY.source, why="board" if unmeasured_board else "none")
