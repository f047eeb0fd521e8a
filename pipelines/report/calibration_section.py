"""How well cameras are known, for the report: what ties them, what boards showed, and what is left over.

Only what a stage wrote is drawn; what is missing (an older run, another route) is left out.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from devrf.pipelines.report.run_reader import RunFolder, at, is_number, table_of
from devrf.pipelines.report.space import RIG, plans
from devrf.pipelines.report.svg_charts import LINES, WIDE, Chart, draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSES = "static_poses/static_poses.json"
HELD_OUT = "board-lengths"  # code of health
FEW, WEAK = 50, 200  # shared corners of a link: fewer do not tie cameras, fewer are weak (rig's health rows)
FEW_POINTS, WEAK_POINTS = 30, 100  # the same of shared points of the sweep
MAX_DOTS = 200  # more only make the page heavy
SECTORS = 8  # of directions in which a board leans


def calibration(run: RunFolder) -> dict[str, Any]:
    """Plans, links, boards, residuals, and lengths on boards that no fit has seen."""
    drawn, remark = plans(run)
    lengths = [(n, r) for n, r in enumerate(run.health("rig")) if r.get("code") == HELD_OUT]
    return {
        "plans": drawn,
        "remark": remark,
        "links": list(_links(run)),
        "boards": list(_boards(run)),
        "left_over": list(_residuals(run)),
        "held_out": lengths,
    }


def _boards(run: RunFolder) -> Iterator[dict[str, Any]]:
    """What each board calibration left, and where it stands; the sweep's device first."""
    ids = [str(s.get("camera_id")) for s in run.objects(POSES, "start") if s.get("source") == "board"]
    known = next((n for n in ids if n in run.cameras(POSES)), "")  # none of its pictures may be in the model
    places = [("sweep", POSES, known, ["board"])]
    places += [(name, RIG, name, ["cameras", name, "details", "board"]) for name in run.cameras(RIG)]
    for name, file, camera, key in places:
        left = run.object(file, *key)
        if not left:
            continue
        cells, tilts = table_of(left.get("cells")), table_of([left.get("tilt_deg"), left.get("towards_deg")])
        sectors = 0 if tilts is None else len({int(t % 360 * SECTORS / 360) for t in tilts[1]})
        yield {
            "name": name,
            "left": left,
            "file": file,
            "camera": camera,
            "key": key,
            "cells": [] if cells is None else cells.tolist(),
            "most": 1 if cells is None else max(cells.max(), 1),
            "tilt": ""
            if tilts is None
            else f"{tilts[0].min():.0f} to {tilts[0].max():.0f}°, {sectors} of {SECTORS}",
        }


def _links(run: RunFolder) -> Iterator[dict[str, Any]]:
    """What ties cameras: corners seen at one instant, points shared with each other and with the sweep."""
    cameras = run.cameras(RIG)
    found = [(e.get("a"), e.get("b"), e.get("corners"), e.get("points")) for e in run.objects(RIG, "graph")]
    if run.object(RIG).get("route", "sweep") == "sweep":
        found += [(name, "sweep", 0, camera.get("inliers")) for name, camera in cameras.items()]
    for a, b, corners, points in found:
        if a in cameras and (b in cameras or b == "sweep") and is_number(corners) and is_number(points):
            firm = corners >= WEAK or points >= WEAK_POINTS
            tied = corners >= FEW or points >= FEW_POINTS
            verdict = "ok" if firm else "warn" if tied else "fail"
            yield {"names": f"{a} and {b}", "corners": corners, "points": points, "verdict": verdict}


def _residuals(run: RunFolder) -> Iterator[Chart]:
    """What is left between seen and predicted pixels, of boards and of the rig."""
    found = [(b["name"], "board corners", b["left"], b["file"], b["camera"]) for b in _boards(run)]
    found += [(name, "in the rig", at(c, "details"), RIG, name) for name, c in run.cameras(RIG).items()]
    for name, what, left, file, camera in found:
        rows = table_of(at(left, "residuals"), 4)
        width, height = (run.at(file, "cameras", camera, side) for side in ("width", "height"))
        if rows is not None and is_number(width) and is_number(height) and min(width, height) > 0:
            yield _residual_chart(rows[:MAX_DOTS], float(width), float(height), f"{name}: {what}")


def _residual_chart(rows: Float[np.ndarray, "n 4"], width: float, height: float, title: str) -> Chart:
    """Rows x, y, dx, dy in pixels (y down): differences around zero, and where in the picture they were, magnified."""
    xy, dxy = rows[:, :2], rows[:, 2:]
    grow = float(f"{0.05 * width / max(np.percentile(np.linalg.norm(dxy, axis=1), 90), 1e-6):.0e}")

    def paint(figure: "Figure") -> None:
        cloud, picture = figure.subplots(1, 2, width_ratios=(1, width / height))
        reach = 1.1 * float(np.percentile(np.abs(dxy), 99)) or 1.0
        cloud.plot(*dxy.T, ".", color=LINES[0], alpha=0.6)
        cloud.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", xlabel="px")
        ends = np.stack([xy, xy + grow * dxy, np.full_like(xy, np.nan)], axis=1).reshape(-1, 2)
        picture.plot(*ends.T, color=LINES[0], linewidth=1)
        picture.plot(*xy.T, ".", color=LINES[0], markersize=3)
        picture.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
        picture.set(xlabel=f"in the picture, {grow:g} times larger")

    return draw(paint, WIDE, title, f"{title}: {len(rows)} differences")
