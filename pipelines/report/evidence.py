"""The report's page of evidence: why the cameras should be believed, drawn from what calibration measured.

Only what a stage wrote is drawn; what is missing (an older run, another route) is left out.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.pipelines.report.html import absent, link, number, section, table, text
from devrf.pipelines.report.plots import arrows, cell_grid, cloud, ellipses, link_graph, rose
from devrf.pipelines.report.run import RunFolder, at

POSES, RIG, METRICS = "static_poses/static_poses.json", "rig/rig.json", "evaluate/metrics.json"
HEALTH, HELD_OUT = "rig/health.json", "held-out lengths on the board"  # how the rig stage's rows begin
SWEEP_NODE = "sweep"
FEW, WEAK = 50, 200  # shared corners of a link: fewer do not tie cameras, fewer are weak (rig's health rows)
FEW_POINTS, WEAK_POINTS = 30, 100  # the same of shared points of the sweep
STEEPEST_DEG = 60.0  # tilt at the rim of the rose
FEW_VIEWS = "too few views to leave some out"


def evidence_section(run: RunFolder) -> str:
    """Coverage, links, doubts, residuals, held-out views, mappers and the seed."""
    lead = (
        "Why these cameras should be believed, or not. A small error alone proves nothing: look for empty corners, "
        "weak links, long ellipses and residuals with a pattern."
    )
    parts = (_boards, _graph, _doubts, _residuals, _held_out, _mappers, _seed)
    body = "".join(part(run) for part in parts)
    if not body:
        return section("evidence", "Evidence", lead, absent(run.why_absent("rig")))
    return section("evidence", "Evidence", lead, body)


def _boards(run: RunFolder) -> str:
    """Per board calibration: its numbers, where corners were seen, how the board was tilted."""
    rows, drawn = [], []
    for name, board, camera, (file, camera_key, key) in _board_calibrations(run):
        dropped = board.get("dropped")
        rows.append(
            [
                f"<strong>{text(name)}</strong>",
                text(f"{board.get('model', '')} {board.get('terms') or ''}".strip()),
                text(len(board.get("frames") or [])),
                text(len(dropped) if isinstance(dropped, list) else 0),
                number(board.get("rms_px"), "px", 3, file=file, key=f"{key}.rms_px"),
                number(
                    board.get("held_out_rms_px"),
                    "px",
                    3,
                    file=file,
                    key=f"{key}.held_out_rms_px",
                    why=FEW_VIEWS,
                ),
                number(at(board, "std.fx"), "px", 2, file=file, key=f"{key}.std.fx"),
                number(_focal_px(camera), "px", 1, file=file, key=f"{camera_key}.K.0.0"),
            ]
        )
        drawn.append(cell_grid(_grid(board.get("cells")), f"{name}: corners seen"))
        tilts, towards = _row_of(board.get("tilt_deg")), _row_of(board.get("towards_deg"))
        if len(tilts) == len(towards):
            drawn.append(rose(towards, tilts, STEEPEST_DEG, "°", f"{name}: tilt of the board"))
    if not rows:
        return ""
    head = (
        "camera",
        "lens that the board shows",
        "views",
        "dropped",
        "error",
        "error on views left out",
        "std. dev., focal length",
        "focal length in use",
    )
    return (
        f"<h3>Boards</h3>{table(head, rows, numeric=(2, 3, 4, 5, 6, 7))}"
        f'<div class="charts plots">{"".join(drawn)}</div>'
        '<p class="source">An empty corner leaves its distortion a guess; a board never tilted, or always the same '
        "way, leaves the focal length unsure. Everything but the last column is of the board alone; the lens in use "
        "may have been adjusted since, together with the sweep or with other cameras.</p>"
    )


def _graph(run: RunFolder) -> str:
    """Cameras and what ties them: corners seen at once, points shared with each other and with the sweep."""
    cameras = run.cameras(RIG)
    links: list[tuple[str, str, str, str]] = []
    for edge in run.objects(RIG, "graph"):
        a, b = str(edge.get("a")), str(edge.get("b"))
        corners, points = edge.get("corners"), edge.get("points")
        if not ({a, b} <= set(cameras) and isinstance(corners, int) and isinstance(points, int)):
            continue
        words = " + ".join([f"{corners}"] * bool(corners) + [f"{points} pts"] * bool(points))
        if words:
            tied = {_verdict(corners, FEW, WEAK), _verdict(points, FEW_POINTS, WEAK_POINTS)}
            links.append((a, b, words, next(v for v in ("ok", "warn", "fail") if v in tied)))
    if run.object(RIG).get("route", "sweep") == "sweep":
        for name, camera in cameras.items():
            if isinstance(camera.get("inliers"), int):
                count = camera["inliers"]
                links.append((name, SWEEP_NODE, f"{count} pts", _verdict(count, FEW_POINTS, WEAK_POINTS)))
    if not links:
        return ""
    return (
        f"<h3>What ties the cameras</h3>{link_graph(list(cameras), links, SWEEP_NODE)}"
        '<p class="source">Board corners that two cameras saw at one instant, and points (pts) of the sweep that both '
        f"see. Thin and broken links are weak; a red camera hangs loose. Source: {link(RIG)}</p>"
    )


def _doubts(run: RunFolder) -> str:
    """Positions with their standard deviations, from above and from the side."""
    rig = run.object(RIG)
    cameras = {n: c for n, c in run.cameras(RIG).items() if c.get("cam_from_world")}
    known = {name: cov for name, c in cameras.items() if (cov := _position_covariance(c)) is not None}
    if not known:
        return ""
    frame = _plan_axes(run)
    if frame is None:
        return ""
    names = list(known)
    centres = np.array([_centre(cameras[name]) for name in names])
    looks = np.array([np.array(cameras[name]["cam_from_world"])[2, :3] for name in names])
    unit = "m" if at(rig, "scale.metric") else "units"
    drawn = ""
    for axes, title in ((frame[[0, 1]], "From above"), (frame[[0, 2]], "From the side")):
        covariances = np.array([axes @ known[name] @ axes.T for name in names])
        drawn += ellipses(centres @ axes.T, covariances, names, looks @ axes.T, unit, title)
    return (
        f'<h3>How sure the positions are</h3><div class="charts">{drawn}</div>'
        '<p class="source">One standard deviation. An ellipse along the viewing direction says that focal length and '
        f"distance trade off: film a board. Source: {link(RIG)}</p>"
    )


def _residuals(run: RunFolder) -> str:
    """What is left between seen and predicted pixels, as a cloud and by position in the picture."""
    rows = []
    for name, residuals, size, what in _residual_samples(run):
        xy, dxy = residuals[:, :2], residuals[:, 2:]
        rows.append(cloud(dxy, f"{name}: {what}"))
        rows.append(arrows(xy, dxy, size, f"{name}, in the picture"))
    if not rows:
        return ""
    return (
        '<h3>What is left over</h3><p class="source">A round cloud and arrows in all directions are noise. Arrows '
        "that turn or point the same way in a part of the picture are a lens that the model does not hold, or a bent "
        f'board.</p><div class="charts plots">{"".join(rows)}</div>'
    )


def _held_out(run: RunFolder) -> str:
    """Millimetres on board views that no fit has seen: the rig stage's own rows."""
    rows = []
    for n, row in enumerate(run.objects(HEALTH, "rows")):
        check, value = str(row.get("check", "")), row.get("value")
        if check.startswith(HELD_OUT):
            shown = value if isinstance(value, str) else None
            unit = str(row.get("unit", ""))
            cell = text(shown) if shown else number(value, unit, 2, file=HEALTH, key=f"rows.{n}.value")
            rows.append([text(check.removeprefix(HELD_OUT).lstrip(", ") or "measured"), cell])
    head = (HELD_OUT, "")
    return "<h3>In millimetres</h3>" + table(head, rows, source=HEALTH) if rows else ""


def _mappers(run: RunFolder) -> str:
    """What each mapper made of the sweep, and how far the others are from the one that was kept."""
    poses = run.object(POSES)
    apart = {str(c.get("name")): n for n, c in enumerate(run.objects(POSES, "compared"))}
    rows = []
    for n, attempt in enumerate(run.objects(POSES, "attempts")):
        name, key = str(attempt.get("name", attempt.get("mapper", ""))), f"attempts.{n}"
        sizes = attempt.get("registered")
        models = sizes if isinstance(sizes, list) else [sizes]
        compared = at(poses, "compared")[apart[name]] if name in apart else {}
        angle = compared.get("apart_deg")
        worst = (
            max((v for v in angle.values() if _is_number(v)), default=None)
            if isinstance(angle, dict)
            else angle
        )
        rows.append(
            [
                text(name),
                text(", ".join(str(size) for size in models if size is not None)) or "none",
                number(
                    attempt.get("mean_reprojection_px"),
                    "px",
                    2,
                    file=POSES,
                    key=f"{key}.mean_reprojection_px",
                ),
                number(attempt.get("seconds"), "s", 0, file=POSES, key=f"{key}.seconds"),
                "kept"
                if name == poses.get("mapper")
                else text(f"{worst:.3g}° apart" if _is_number(worst) else ""),
            ]
        )
    head = ("mapper", "registered, by model", "reprojection error", "time", "")
    return "<h3>Mappers</h3>" + table(head, rows, source=POSES, numeric=(2, 3)) if rows else ""


def _seed(run: RunFolder) -> str:
    seed = run.object(METRICS).get("seed")
    if seed is None:
        return ""
    return f"<p>Seed of every random draw: {number(seed, '', 0, file=METRICS, key='seed')}.</p>"


def _board_calibrations(
    run: RunFolder,
) -> Iterator[tuple[str, dict[str, Any], dict[str, Any], tuple[str, str, str]]]:
    """(name, what its board calibration left, the camera, (file, key of the camera, key of the calibration)); the
    sweep's device first."""
    board, cameras = run.object(POSES).get("board"), run.cameras(POSES)
    if isinstance(board, dict):
        ids = [str(s.get("camera_id")) for s in run.objects(POSES, "start") if s.get("source") == "board"]
        known = next((n for n in ids if n in cameras), "")  # none of its pictures may be in the model
        yield SWEEP_NODE, board, cameras.get(known, {}), (POSES, f"cameras.{known}", "board")
    for name, camera in run.cameras(RIG).items():
        board = at(camera, "details.board")
        if isinstance(board, dict):
            yield name, board, camera, (RIG, f"cameras.{name}", f"cameras.{name}.details.board")


def _residual_samples(run: RunFolder) -> Iterator[tuple[str, Float[np.ndarray, "n 4"], tuple[int, int], str]]:
    """(camera, rows x, y, dx, dy, picture size, of what)."""
    for name, board, camera, _ in _board_calibrations(run):
        sample = _table_of(board.get("residuals"), 4)
        if sample is not None and min(_size(camera)) > 0:
            yield name, sample, _size(camera), "board corners"
    for name, camera in run.cameras(RIG).items():
        sample = _table_of(at(camera, "details.residuals"), 4)
        if sample is not None and min(_size(camera)) > 0:
            yield name, sample, _size(camera), "in the rig"


def _position_covariance(camera: dict[str, Any]) -> Float[np.ndarray, "3 3"] | None:
    """Of the centre, in the world: as measured, else of its parts along and across the view, else a ball."""
    full = _table_of(at(camera, "details.position_covariance"), 3)
    if full is not None and len(full) == 3:
        return full
    along, across = at(camera, "details.axis_std"), at(camera, "details.sideways_std")
    view = np.array(camera["cam_from_world"])[2, :3]
    if _is_number(along) and _is_number(across):
        return across**2 * np.eye(3) + (along**2 - across**2) * np.outer(view, view)
    std = at(camera, "std.position")
    return std**2 * np.eye(3) if _is_number(std) else None


def _plan_axes(run: RunFolder) -> Float[np.ndarray, "3 3"] | None:
    """Right, forward and up of a plan of the rig: up is what the cameras hold as up, right is where it is widest."""
    poses = [np.array(c["cam_from_world"]) for c in run.cameras(RIG).values() if c.get("cam_from_world")]
    if len(poses) < 2:
        return None
    up = -np.mean([T[1, :3] for T in poses], axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    centres = np.array([-T[:, :3].T @ T[:, 3] for T in poses])
    flat = centres - centres.mean(0)
    flat = flat - np.outer(flat @ up, up)
    right = np.linalg.svd(flat)[2][0]
    right = right - (right @ up) * up
    if np.linalg.norm(right) < 1e-6:
        return None
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _centre(camera: dict[str, Any]) -> Float[np.ndarray, "3"]:
    T = np.array(camera["cam_from_world"], dtype=np.float64)
    return -T[:, :3].T @ T[:, 3]


def _verdict(count: int, few: int, weak: int) -> str:
    return "fail" if count < few else "warn" if count < weak else "ok"


def _size(camera: dict[str, Any]) -> tuple[int, int]:
    if not _numbers(camera, "width", "height"):
        return 0, 0
    return int(camera["width"]), int(camera["height"])


def _focal_px(camera: dict[str, Any]) -> float | None:
    K = _table_of(camera.get("K"), 3)
    return None if K is None or len(K) != 3 else float(K[0, 0])


def _row_of(value: object) -> list[float]:
    """A list of finite numbers; empty for anything else."""
    if not isinstance(value, list) or not all(_is_number(v) for v in value):
        return []
    return [float(v) for v in value]


def _grid(value: object) -> list[list[float]]:
    """Rows of counts; empty for anything else."""
    counts = _table_of(value, None)
    return [] if counts is None else counts.tolist()


def _table_of(value: object, columns: int | None) -> Float[np.ndarray, "n m"] | None:
    """Rows of finite numbers; None for anything else."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    good = found.ndim == 2 and found.size > 0 and np.isfinite(found).all()
    return found if good and columns in (None, found.shape[1]) else None


def _numbers(value: dict[str, Any], *keys: str) -> bool:
    return all(_is_number(value.get(key)) for key in keys)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
