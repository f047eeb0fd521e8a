"""The report's views: true and rendered pictures under a slider, where they differ, and PSNR over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import absent, link, number, section, text
from devrf.pipelines.report.pictures import ERROR_FULL_SCALE, error_picture, picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder, as_float, at, evenly

METRICS = "evaluate/metrics.json"
VIEW_WIDTH = 560
MAX_MOVING, MAX_STATIC = 12, 8  # frames inside the page; the others stay in evaluate/
LEAD = (
    "Pictures that training never saw. Left of the border is the true picture, right of it the rendered one; "
    "drag the border. Beside it: where they differ, and the scene rendered as if nothing moved."
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
    folder = run.folder("evaluate")
    body = ""
    if moving:
        body += f"<h3>Test views over time</h3>{_over_time(moving)}"
        body += _viewer(_some(moving, MAX_MOVING), len(moving), folder)
    if static:
        body += f"<h3>Held-out sweep pictures</h3>{_viewer(_some(static, MAX_STATIC), len(static), folder)}"
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


def _viewer(views: Sequence[View], total: int, folder: Path) -> str:
    shown: list[tuple[View, dict[str, Any]]] = []
    for view in views:
        pictures = {
            kind: _picture(folder, view.row.get(kind)) for kind in ("true", "rendered", "error", "rest")
        }
        true, rendered = pictures["true"], pictures["rendered"]
        if true is None or rendered is None or true.shape != rendered.shape:
            continue
        if pictures["error"] is None:
            pictures["error"] = error_picture(true, rendered)
        shown.append((view, pictures))
    first = len(shown) // 2  # at the first time of a clip nothing has moved yet
    frames = [_frame(view, pictures, n == first) for n, (view, pictures) in enumerate(shown)]
    buttons = [
        f'<button type="button" aria-pressed="{str(n == first).lower()}">{text(_short_name(view.row))}</button>'
        for n, (view, _) in enumerate(shown)
    ]
    if not frames:
        return absent("The true and rendered pictures are not in evaluate/.")
    some = (
        f" {len(frames)} of {total} views are shown; the others are in evaluate/."
        if len(frames) < total
        else ""
    )
    key = (
        '<p class="source">Difference: 0<span class="ramp"></span>'
        f"{ERROR_FULL_SCALE:g} or more of the full range.{some}</p>"
    )
    picker = f'<div class="picker" role="group" aria-label="Choose a view">{"".join(buttons)}</div>'
    return f'<div class="views">{"".join(frames)}{picker if len(frames) > 1 else ""}{key}</div>'


def _frame(view: View, pictures: dict[str, Any], on: bool) -> str:
    row, name = view.row, text(_long_name(view.row))
    uris = {kind: picture_uri(p, VIEW_WIDTH) for kind, p in pictures.items() if p is not None}

    def score(key: str, unit: str, digits: int) -> str:
        return number(at(row, key), unit, digits, file=METRICS, key=f"per_view.{view.place}.{key}")

    compare = (
        '<div class="compare">'
        f'<img src="{uris["true"]}" alt="true, {name}" draggable="false">'
        f'<img src="{uris["rendered"]}" alt="rendered, {name}" class="over" draggable="false">'
        '<span class="tag left">true</span><span class="tag right">rendered</span>'
        '<input type="range" min="0" max="100" step="0.5" value="50" '
        'aria-label="Border between true and rendered"><span class="bar"></span></div>'
    )
    words = f"PSNR {score('psnr', 'dB', 1)}, SSIM {score('ssim', '', 3)}"
    if at(row, "moving.psnr") is not None:
        words += f"; where it moves {score('moving.psnr', 'dB', 1)}"
    panes = [(compare, f"{name}: {words}"), (f'<img src="{uris["error"]}" alt="difference">', "difference")]
    if "rest" in uris:
        still = f"as if nothing moved: {score('static_baseline.psnr', 'dB', 1)}"
        if at(row, "static_baseline.moving.psnr") is not None:
            still += f"; where it moves {score('static_baseline.moving.psnr', 'dB', 1)}"
        panes.append((f'<img src="{uris["rest"]}" alt="at rest">', still))
    body = "".join(f"<div>{pane}<figcaption>{caption}</figcaption></div>" for pane, caption in panes)
    return f'<div class="frame{" on" if on else ""}"><div class="panes n{len(panes)}">{body}</div></div>'


def _picture(folder: Path, file: object) -> Any:
    return read_picture(folder / file) if isinstance(file, str) else None


def _short_name(row: dict[str, Any]) -> str:
    if row.get("time_s") is not None:
        return f"{row['time_s']:.2f} s"
    return f"{row['time']:.2f}" if row.get("time") is not None else f"{row.get('index', '')}"


def _long_name(row: dict[str, Any]) -> str:
    time = f", {row['time_s']:.3f} s" if row.get("time_s") is not None else ""
    return f"{row.get('camera', '')}, frame {row.get('index', '')}{time}"


def _time(row: dict[str, Any]) -> float:
    return as_float(row.get("time_s") if row.get("time_s") is not None else row.get("time"))
