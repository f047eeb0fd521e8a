"""Line charts for the report, as inline SVG. Pure functions.

A chart takes its colours from the page (`--s0`, `--s1`, ... in report.css), so it follows the light and
the dark theme.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

COLOURS = 6  # --s0 .. --s5 in report.css
CHART_WIDTH, CHART_HEIGHT = 480, 250  # text stays readable when a phone shows the chart at 340 px
SMALL_WIDTH, SMALL_HEIGHT = 340, 190  # for three charts in a row
MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 64, 22, 10, 44
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MAX_CHART_POINTS = 400  # more cannot be seen on 480 units, and only make the page heavy


@dataclass(frozen=True)
class Series:
    """One line of a chart; y may hold NaN where there is no value. Without a name it is not in the legend."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: int = 0
    dashed: bool = False
    markers: bool = False


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    log_x: bool = False,
    log_y: bool = False,
    x_marks: Sequence[tuple[float, str]] = (),
    title: str = "",
    small: bool = False,
) -> str:
    """A line chart with axes, grid and a legend, as one <figure>; empty text when nothing can be drawn.

    Args:
        series: Lines; points that are not finite (or not positive on a logarithmic axis) break the line.
        x_label, y_label: Axis titles with units.
        log_x, log_y: Logarithmic axes.
        x_marks: Vertical lines with a word each (for example where a level begins).
        title: Words above the chart.
        small: For rows of three.
    """
    width, height = (SMALL_WIDTH, SMALL_HEIGHT) if small else (CHART_WIDTH, CHART_HEIGHT)
    lines = [(s, [_drawable(x, y, log_x, log_y) for x, y in zip(s.x, s.y, strict=True)]) for s in series]
    points = [p for _, ps in lines for p in ps if p is not None]
    if not points:
        return ""
    x_all, y_all = [p[0] for p in points], [p[1] for p in points]
    x_ticks = _log_ticks(min(x_all), max(x_all)) if log_x else ticks(min(x_all), max(x_all), 5)
    y_ticks = _log_ticks(min(y_all), max(y_all)) if log_y else ticks(min(y_all), max(y_all), 5)
    x_low, x_high = (x_ticks[0], x_ticks[-1]) if log_x else (min(x_all), max(x_all))
    x_high = x_high if x_high > x_low else x_low + 1.0
    y_low, y_high = y_ticks[0], y_ticks[-1]
    bottom = height - MARGIN_BOTTOM

    def px(x: float) -> float:
        return MARGIN_LEFT + (x - x_low) / (x_high - x_low) * (width - MARGIN_LEFT - MARGIN_RIGHT)

    def py(y: float) -> float:
        return bottom - (y - y_low) / (y_high - y_low) * (bottom - MARGIN_TOP)

    parts = [
        f'<line class="grid" x1="{MARGIN_LEFT}" x2="{width - MARGIN_RIGHT}" '
        f'y1="{py(y):.1f}" y2="{py(y):.1f}"/>'
        f'<text class="tick" x="{MARGIN_LEFT - 7}" y="{py(y) + 4:.1f}" text-anchor="end">'
        f"{_power_text(y) if log_y else _tick_text(y, y_ticks)}</text>"
        for y in y_ticks
    ]
    parts += [
        f'<text class="tick" x="{px(x):.1f}" y="{bottom + 17}" text-anchor="middle">'
        f"{_power_text(x) if log_x else _tick_text(x, x_ticks)}</text>"
        for x in x_ticks
        if x_low <= x <= x_high
    ]
    for x, word in ((math.log10(x) if log_x else x, word) for x, word in x_marks):
        if x_low <= x <= x_high:
            parts.append(
                f'<line class="mark" x1="{px(x):.1f}" x2="{px(x):.1f}" y1="{MARGIN_TOP}" y2="{bottom}"/>'
                f'<text class="markword" {_beside(px(x), width)} y="{MARGIN_TOP + 10}">{escape(word)}</text>'
            )
    for s, ps in lines:
        parts.append(_line(s, [None if p is None else (px(p[0]), py(p[1])) for p in _thin(ps)]))
    parts.append(
        f'<line class="axis" x1="{MARGIN_LEFT}" x2="{width - MARGIN_RIGHT}" '
        f'y1="{bottom}" y2="{bottom}"/>'
        f'<text class="label" x="{(MARGIN_LEFT + width - MARGIN_RIGHT) / 2}" y="{height - 8}" '
        f'text-anchor="middle">{escape(x_label)}</text>'
        f'<text class="label" transform="translate(13 {(MARGIN_TOP + bottom) / 2}) rotate(-90)" '
        f'text-anchor="middle">{escape(y_label)}</text>'
    )
    described = f"{title} {y_label} against {x_label}".strip()
    svg = (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(described)}">'
        f"{''.join(parts)}</svg>"
    )
    above = f'<figcaption class="legend">{escape(title)}</figcaption>' if title else _legend(series)
    return f'<figure class="chart{" small" if small else ""}">{above}{svg}</figure>'


def _beside(x: float, width: int) -> str:
    """Where the word of a mark at `x` stands: right of it, left of it near the right edge."""
    return f'x="{x + 3:.1f}"' if x < 0.8 * width else f'x="{x - 3:.1f}" text-anchor="end"'


def ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` round numbers from at or below `low` to at or above `high`."""
    if not high > low:
        pad = abs(low) * 0.1 or 1.0
        low, high = low - pad, high + pad
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [n * step for n in range(first, last + 1)]


def _drawable(x: float | None, y: float | None, log_x: bool, log_y: bool) -> tuple[float, float] | None:
    if x is None or y is None or not math.isfinite(x) or not math.isfinite(y):
        return None
    if (log_x and x <= 0) or (log_y and y <= 0):
        return None
    return math.log10(x) if log_x else float(x), math.log10(y) if log_y else float(y)


def _log_ticks(low: float, high: float) -> list[float]:
    """Exponents of round numbers around [low, high]: powers of ten, or 1-2-5 where there are few of them."""
    first, last = math.floor(low), math.ceil(high)
    if high - low >= 2:
        step = max(1, math.ceil((last - first) / 6))
        return [float(n) for n in range(first, last + step, step)]
    fine = [n + math.log10(m) for n in range(first - 1, last + 2) for m in (1, 2, 5)]
    below = [t for t in fine if t <= low + 1e-9]
    above = [t for t in fine if t >= high - 1e-9]
    return [t for t in fine if below[-1] <= t <= max(above[0], below[-1] + 0.1)]


def _power_text(exponent: float) -> str:
    if -3 <= exponent < 5:
        return f"{10.0**exponent:.6g}"
    power = math.floor(exponent + 1e-9)
    mantissa = round(10.0 ** (exponent - power))
    raised = f"10{str(power).translate(SUPERSCRIPT)}"
    return raised if mantissa == 1 else f"{mantissa}·{raised}"


def _tick_text(value: float, all_ticks: Sequence[float]) -> str:
    if abs(value) >= 1e5:
        return f"{value:g}"
    return f"{value:.{_decimals(all_ticks)}f}".replace("-", "\u2212")


def _decimals(all_ticks: Sequence[float]) -> int:
    step = all_ticks[1] - all_ticks[0] if len(all_ticks) > 1 else 1.0
    return next((d for d in range(5) if abs(round(step, d) - step) < 1e-9 * max(1.0, abs(step))), 5)


def _thin(
    points: list[tuple[float, float] | None],
) -> list[tuple[float, float] | None]:
    """At most MAX_CHART_POINTS: of each stretch its lowest and highest, so that spikes stay visible."""
    if len(points) <= MAX_CHART_POINTS:
        return points
    size = math.ceil(2 * len(points) / MAX_CHART_POINTS)
    out: list[tuple[float, float] | None] = []
    for start in range(0, len(points), size):
        there = [p for p in points[start : start + size] if p is not None]
        if not there:
            out.append(None)
            continue
        out += sorted({min(there, key=lambda p: p[1]), max(there, key=lambda p: p[1])})
    return out


def _line(series: Series, points: list[tuple[float, float] | None]) -> str:
    commands, pen_down = [], False
    for p in points:
        if p is not None:
            commands.append(f"{'L' if pen_down else 'M'}{p[0]:.1f} {p[1]:.1f}")
        pen_down = p is not None
    style = f"stroke:var(--s{series.colour % COLOURS})"
    dash = ' stroke-dasharray="5 4"' if series.dashed else ""
    path = f'<path class="line" style="{style}"{dash} d="{"".join(commands)}"/>'
    if series.markers:
        fill = f"fill:var(--s{series.colour % COLOURS})"
        path += "".join(
            f'<circle style="{fill}" cx="{p[0]:.1f}" cy="{p[1]:.1f}" r="3"/>' for p in points if p is not None
        )
    return path


def _legend(series: Sequence[Series]) -> str:
    named = [s for s in series if s.name]
    if len(named) < 2:
        return ""
    items = "".join(
        f'<span class="key{" dashed" if s.dashed else ""}" style="--c:var(--s{s.colour % COLOURS})">'
        f"{escape(s.name)}</span>"
        for s in named
    )
    return f'<figcaption class="legend">{items}</figcaption>'
