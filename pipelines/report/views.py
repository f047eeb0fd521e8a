"""The report's views: true and rendered pictures under a slider, where they differ, and PSNR over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import absent, link, number, section, text
from devrf.pipelines.report.pictures import ERROR_FULL_SCALE, error_picture, picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder, as_float, at, evenly, fewer
from devrf.pipelines.report.slider import frames, pane, slider

METRICS = "evaluate/metrics.json"
KINDS = ("true", "rendered", "error", "rest")
VIEW_WIDTH, BESIDE_WIDTH = 720, 400  # of the two pictures under the slider, and of those beside it
MAX_MOVING, MAX_STATIC = 12, 8  # frames inside the page; the others stay in evaluate/
LEAD = (
    "Pictures that training never saw. Left of the border is the true picture, right of it the rendered one; "
    "drag the border, or use the arrow keys. Beside it: where they differ, and the scene rendered as if nothing moved."
)


@dataclass(frozen=True)
class View:
    """One test view: its place in `per_view` of evaluate/metrics.json, and the entry there."""

    place: int
    row: dict[str, Any]


def views_section(run: RunFolder) -> str:
    """Test views over time and held-out sweep pictures."""
    metrics = run.object(METRICS)
    if not metrics:
        return section("views", "Views", LEAD, absent(run.why_absent("evaluate")))
    moving, static = collect_views(metrics)
    body = ""
    if moving:
        some = _some(moving, fewer(MAX_MOVING, run.room))
        body += f"<h3>Test views over time</h3>{_over_time(moving)}{_viewer(run, some, len(moving))}"
    if static:
        some = _some(static, fewer(MAX_STATIC, run.room))
        body += f"<h3>Held-out sweep pictures</h3>{_viewer(run, some, len(static))}"
    return section("views", "Views", LEAD, body or absent("evaluate/metrics.json lists no test views."))


def collect_views(metrics: dict[str, Any]) -> tuple[list[View], list[View]]:
    """Views of the moving scene, by camera and time, and of the scene at rest."""
    rows = metrics.get("per_view")
    rows = rows if isinstance(rows, list) else []
    views = [View(n, row) for n, row in enumerate(rows) if isinstance(row, dict)]
    moving = [v for v in views if v.row.get("time") is not None]
    moving.sort(key=lambda v: (str(v.row.get("camera")), v.row["time"]))
    return moving, [v for v in views if v.row.get("time") is None]


def _some(views: Sequence[View], count: int) -> list[View]:
    """A few views, those with all pictures first (evaluate keeps error and rest for some)."""
    full = [v for v in views if "error" in v.row]
    return evenly(full or views, count)


def _over_time(views: Sequence[View]) -> str:
    cameras = list(dict.fromkeys(str(v.row.get("camera")) for v in views))
    series = []
    for n, camera in enumerate(cameras[:3]):
        mine = [v.row for v in views if str(v.row.get("camera")) == camera]
        times = [_time(row) for row in mine]
        series.append(Series(f"{camera}, result", times, [as_float(row.get("psnr")) for row in mine], 2 * n))
        still = [as_float(at(row, "static_baseline.psnr")) for row in mine]
        series.append(Series(f"{camera}, standing still", times, still, 2 * n + 1, dashed=True))
    series = [s for s in series if any(y == y for y in s.y)]
    unit = "time, s" if views[0].row.get("time_s") is not None else "time (0 to 1)"
    chart = line_chart(series, unit, "PSNR, dB")
    return (
        f'<div class="charts one">{chart}</div><p class="source">Source: {link(METRICS)}</p>' if chart else ""
    )


def _viewer(run: RunFolder, views: Sequence[View], total: int) -> str:
    """The views' pictures; fewer and smaller ones where the page would become too large (`run.room`)."""
    folder = run.folder("evaluate")
    shown: list[tuple[View, dict[str, Any]]] = []
    for view in views:
        pictures = {kind: _picture(folder, view.row.get(kind)) for kind in KINDS}
        true, rendered = pictures["true"], pictures["rendered"]
        if true is None or rendered is None or true.shape != rendered.shape:
            continue
        if pictures["error"] is None:
            pictures["error"] = error_picture(true, rendered)
        shown.append((view, pictures))
    if not shown:
        return absent("The true and rendered pictures are not in evaluate/.")
    cameras = {view.row.get("camera") for view, _ in shown}
    scale = math.sqrt(run.room)
    rows = [(_short_name(v.row, len(cameras) > 1), _panes(v, pictures, scale)) for v, pictures in shown]
    some = (
        f" {len(rows)} of {total} views are shown; the others are in evaluate/." if len(rows) < total else ""
    )
    middle = len(rows) // 2  # at the first time of a clip nothing has moved yet
    return f'<div class="views">{frames(rows, middle)}{error_scale(some)}</div>'


def error_scale(more: str = "") -> str:
    """The key to error pictures."""
    return (
        '<p class="source scale">Difference, the largest of red, green and blue: 0'
        f'<span class="ramp"></span>{ERROR_FULL_SCALE:g} or more of the full range.{text(more)}</p>'
    )


def _panes(view: View, pictures: dict[str, Any], scale: float) -> list[str]:
    row, name = view.row, _long_name(view.row)
    widths = {kind: VIEW_WIDTH if kind in ("true", "rendered") else BESIDE_WIDTH for kind in KINDS}
    uris = {k: picture_uri(p, round(scale * widths[k])) for k, p in pictures.items() if p is not None}

    def score(key: str, unit: str, digits: int) -> str:
        return number(at(row, key), unit, digits, file=METRICS, key=f"per_view.{view.place}.{key}")

    words = f"{text(name)}: PSNR {score('psnr', 'dB', 1)}, SSIM {score('ssim', '', 3)}"
    if at(row, "moving.psnr") is not None:
        words += f"; where it moves {score('moving.psnr', 'dB', 1)}"
    panes = [
        pane(slider([(uris["true"], "true"), (uris["rendered"], "rendered")], name), words),
        pane(f'<img src="{uris["error"]}" alt="difference, {text(name)}">', "difference"),
    ]
    if "rest" in uris:
        still = f"as if nothing moved: {score('static_baseline.psnr', 'dB', 1)}"
        if at(row, "static_baseline.moving.psnr") is not None:
            still += f"; where it moves {score('static_baseline.moving.psnr', 'dB', 1)}"
        panes.append(pane(f'<img src="{uris["rest"]}" alt="as if nothing moved, {text(name)}">', still))
    return panes


def _picture(folder: Path, file: object) -> Any:
    return read_picture(folder / file) if isinstance(file, str) else None


def _short_name(row: dict[str, Any], with_camera: bool) -> str:
    camera = f"{row.get('camera', '')}, " if with_camera else ""
    if row.get("time_s") is not None:
        return f"{camera}{row['time_s']:.2f} s"
    return f"{camera}{row['time']:.2f}" if row.get("time") is not None else f"{camera}{row.get('index', '')}"


def _long_name(row: dict[str, Any]) -> str:
    time = f", {row['time_s']:.3f} s" if row.get("time_s") is not None else ""
    return f"{row.get('camera', '')}, frame {row.get('index', '')}{time}"


def _time(row: dict[str, Any]) -> float:
    return as_float(row.get("time_s") if row.get("time_s") is not None else row.get("time"))
