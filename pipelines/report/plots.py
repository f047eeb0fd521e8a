"""Drawings of the report's evidence as inline SVG: counts on a grid, clouds, arrows, a graph, ellipses. Pure functions.

Colours come from the page (report.css), so a drawing follows the light and the dark theme. All lengths in a drawing
are SVG units; `y` points down in pictures and up in plans, as readers expect.
"""

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

SIDE = 260.0  # of a square drawing
MARGIN = 26
PLAN_MARGIN = 60  # room for names and ellipses
MAX_DOTS = 500  # more only make the page heavy
NICE = (1, 2, 5)
WORD_AT = (0.37, 0.3, 0.44, 0.24, 0.56, 0.63, 0.7, 0.5, 0.76)  # of a link, where its words may stand
LETTER, LINE = 6.4, 14.0  # width and height that a letter of these words takes


def cell_grid(counts: Sequence[Sequence[float]], title: str) -> str:
    """Counts in the cells of a picture, each as a number on a square that is darker where there are more."""
    rows, columns = len(counts), max((len(row) for row in counts), default=0)
    if not columns:
        return ""
    width, height = SIDE, SIDE * 0.72
    w, h = width / columns, height / rows
    most = max(max(row) for row in counts) or 1
    parts = []
    for r, row in enumerate(counts):
        for c, count in enumerate(row):
            share = 0.08 + 0.62 * math.sqrt(count / most) if count else 0.0
            kind = "cell" if count else "cell empty"
            parts.append(
                f'<rect class="{kind}" x="{c * w + 1:.1f}" y="{r * h + 1:.1f}" width="{w - 2:.1f}" '
                f'height="{h - 2:.1f}" style="fill-opacity:{share:.2f}"/>'
                f'<text class="count" x="{(c + 0.5) * w:.1f}" y="{(r + 0.5) * h + 4:.1f}">{count:g}</text>'
            )
    return _figure(
        parts, width, height, title, f"{title}: counts in {columns} by {rows} parts of the picture"
    )


def cloud(dxy: Float[np.ndarray, "n 2"], title: str, unit: str = "px", colour: int = 0) -> str:
    """Differences [n, 2] as dots around zero, with rings at round radii; y down, as in the picture."""
    if not len(dxy):
        return ""
    lengths = np.linalg.norm(dxy, axis=1)
    reach = nice(float(np.percentile(lengths, 99)), up=True)
    scale = (SIDE / 2 - MARGIN / 2) / reach
    middle = SIDE / 2
    parts = [
        f'<circle class="ring" cx="{middle}" cy="{middle}" r="{reach * share * scale:.1f}"/>'
        f'<text class="tick" x="{middle + 3:.1f}" y="{middle - reach * share * scale + 12:.1f}">'
        f"{reach * share:g} {escape(unit)}</text>"
        for share in (0.5, 1.0)
    ]
    parts.append(
        f'<line class="grid" x1="{middle}" x2="{middle}" y1="4" y2="{SIDE - 4}"/>'
        f'<line class="grid" x1="4" x2="{SIDE - 4}" y1="{middle}" y2="{middle}"/>'
    )
    inside = dxy[lengths <= reach][:MAX_DOTS]
    parts.append(_dots(middle + inside * scale, 1.9, colour))
    return _figure(
        parts,
        SIDE,
        SIDE,
        title,
        f"{title}: {len(dxy)} differences, rings at {reach / 2:g} and {reach:g} {unit}",
    )


def arrows(
    xy: Float[np.ndarray, "n 2"],
    dxy: Float[np.ndarray, "n 2"],
    size: tuple[int, int],
    title: str,
    colour: int = 0,
) -> str:
    """Differences drawn where in the picture they were, magnified so that they can be seen."""
    if not len(xy) or min(size) < 1:
        return ""
    scale = SIDE / max(size)
    width, height = size[0] * scale, size[1] * scale
    typical = float(np.percentile(np.linalg.norm(dxy, axis=1), 90)) or 1.0
    grow = nice(0.05 * max(size) / typical)
    parts = [f'<rect class="frame-of" x="0.5" y="0.5" width="{width - 1:.1f}" height="{height - 1:.1f}"/>']
    starts = xy[:MAX_DOTS] * scale
    ends = starts + grow * scale * dxy[:MAX_DOTS]
    lines = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in np.hstack([starts, ends]).tolist())
    parts.append(
        f'<path class="arrow" style="stroke:var(--s{colour})" d="{lines}"/>{_dots(starts, 1.3, colour)}'
    )
    words = f"{title}, {grow:g} times larger"
    return _figure(parts, width, height, words, words)


def rose(directions_deg: Sequence[float], radii: Sequence[float], reach: float, unit: str, title: str) -> str:
    """Dots in polar coordinates: a direction (0 right, 90 down, as in the picture) and a length up to `reach`."""
    if not directions_deg:
        return ""
    middle = SIDE / 2
    scale = (SIDE / 2 - MARGIN) / reach
    parts = [
        f'<circle class="ring" cx="{middle}" cy="{middle}" r="{reach * share * scale:.1f}"/>'
        f'<text class="tick" x="{middle + 3:.1f}" y="{middle - reach * share * scale + 12:.1f}">'
        f"{reach * share:g}{escape(unit)}</text>"
        for share in (1 / 3, 2 / 3, 1.0)
    ]
    for n in range(8):  # borders of the eight sectors that are counted
        a = math.radians(45 * n)
        x, y = reach * scale * math.cos(a), reach * scale * math.sin(a)
        parts.append(
            f'<line class="grid" x1="{middle}" y1="{middle}" x2="{middle + x:.1f}" y2="{middle + y:.1f}"/>'
        )
    angle, length = np.radians(directions_deg), np.minimum(radii, reach) * scale
    spots = middle + np.column_stack([length * np.cos(angle), length * np.sin(angle)])
    parts.append(_dots(spots[:MAX_DOTS], 2.6, 0))
    return _figure(parts, SIDE, SIDE, title, f"{title}: {len(directions_deg)} directions")


def link_graph(nodes: Sequence[str], links: Sequence[tuple[str, str, str, str]], middle: str) -> str:
    """Nodes in a circle, one in its middle, joined by links (a, b, words, verdict); verdict: ok, warn or fail."""
    width, height = 480.0, 360.0
    ring = [name for name in nodes if name != middle]
    turn = 2 * math.pi / max(len(ring), 1)
    spots = {name: (math.sin(turn * n), math.cos(turn * n)) for n, name in enumerate(ring)} | {
        middle: (0.0, 0.0)
    }
    at = {name: (width / 2 + 190 * x, height / 2 - 140 * y) for name, (x, y) in spots.items()}
    linked = {name for link in links for name in link[:2]}
    parts, words = [], []
    taken: list[tuple[float, float, float, float]] = []
    for name, (x, y) in at.items():
        if name in linked or name != middle:
            kind = "node" if name in linked else "node alone"
            above = 16 if y < height / 2 or name == middle else -26
            words.append(
                f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="6"/>'
                f'<text class="nodeword" x="{x:.1f}" y="{y - above + 5:.1f}">{escape(name)}</text>'
            )
            taken += [_box(x, y, "()"), _box(x, y - above, name)]  # a circle is as large as two letters
    for a, b, said, verdict in links:
        (x1, y1), (x2, y2) = at[a], at[b]
        parts.append(
            f'<line class="link {verdict}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
        )
        places = [(x1 + share * (x2 - x1), y1 + share * (y2 - y1)) for share in WORD_AT]
        x, y = min(places, key=lambda place: sum(_covered(_box(*place, said), box) for box in taken))
        taken.append(_box(x, y, said))
        words.append(f'<text class="linkword {verdict}" x="{x:.1f}" y="{y + 4:.1f}">{escape(said)}</text>')
    said = "; ".join(f"{a} and {b}: {text}" for a, b, text, _ in links)
    return _figure([*parts, *words], width, height, "", f"Links between cameras. {said}", "graph")


def ellipses(
    centres: Float[np.ndarray, "n 2"],
    covariances: Float[np.ndarray, "n 2 2"],
    names: Sequence[str],
    looks: Float[np.ndarray, "n 2"],
    unit: str,
    title: str,
) -> str:
    """Positions seen along an axis with one-sigma ellipses, magnified; a line shows where each camera looks."""
    if not len(centres):
        return ""
    width, height = 480.0, 330.0
    at, scale = _placed(centres, width, height)
    spread = float(np.sqrt(max(np.linalg.eigvalsh(c)[-1] for c in covariances)))
    grow = nice(24 / (spread * scale)) if spread > 0 else 1.0
    parts = []
    for n, name in enumerate(names):
        x, y = at[n].tolist()
        values, vectors = np.linalg.eigh(covariances[n])
        long, short = (grow * scale * math.sqrt(max(v, 0.0)) for v in (values[1], values[0]))
        turn = -math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))  # SVG turns clockwise, y is up here
        dx, dy = looks[n]
        parts.append(
            f'<line class="look" x1="{x:.1f}" y1="{y:.1f}" x2="{x + 34 * dx:.1f}" y2="{y - 34 * dy:.1f}"/>'
            f'<ellipse class="sigma" cx="{x:.1f}" cy="{y:.1f}" rx="{max(long, 0.8):.1f}" ry="{max(short, 0.8):.1f}" '
            f'transform="rotate({turn:.1f} {x:.1f} {y:.1f})"/>'
            + _dots(np.array([[x, y]]), 2.2, 2)
            + f'<text class="nodeword" x="{x:.1f}" y="{y - 12 - short:.1f}">{escape(name)}</text>'
        )
    bar = nice(0.2 * width / scale)
    length = bar * scale
    parts.append(
        f'<line class="axis" x1="12" x2="{12 + length:.1f}" y1="{height - 12}" y2="{height - 12}"/>'
        f'<text class="tick" x="{18 + length:.1f}" y="{height - 8}">{bar:g} {escape(unit)}; ellipses {grow:g} times '
        "larger</text>"
    )
    return _figure(parts, width, height, title, f"{title}: positions and doubts of {', '.join(names)}")


def nice(value: float, up: bool = False) -> float:
    """The nearest 1, 2 or 5 times a power of ten from below (nothing grows beyond what was asked), or from above."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    steps = [m * power for m in (*NICE, 10)]
    return (
        min(s for s in steps if s >= value * (1 - 1e-9))
        if up
        else max(s for s in steps if s <= value * (1 + 1e-9))
    )


def _box(x: float, y: float, words: str) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of words around a point."""
    half = LETTER * len(words) / 2
    return x - half, y - LINE / 2, x + half, y + LINE / 2


def _covered(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """Area that two boxes share."""
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def _placed(
    places: Float[np.ndarray, "n 2"], width: float, height: float
) -> tuple[Float[np.ndarray, "n 2"], float]:
    """Places (y up) in a drawing (y down), in one scale, and that scale."""
    low, high = places.min(0), places.max(0)
    room = np.array([width, height]) - 2 * PLAN_MARGIN
    span = high - low
    scale = float((room[span > 0] / span[span > 0]).min(initial=np.inf))
    scale = scale if np.isfinite(scale) else 1.0
    return np.array([width, height]) / 2 + scale * (places - (low + high) / 2) * [1, -1], scale


def _dots(xy: Float[np.ndarray, "n 2"], r: float, colour: int) -> str:
    """Dots as one path: lines of no length with round ends, which is a fifth of as many circles."""
    spots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in xy.tolist())
    return f'<path class="dots" style="stroke:var(--s{colour});stroke-width:{2 * r:g}" d="{spots}"/>'


def _figure(
    parts: Sequence[str], width: float, height: float, title: str, described: str, kind: str = ""
) -> str:
    above = f'<figcaption class="legend">{escape(title)}</figcaption>' if title else ""
    return (
        f'<figure class="chart plot {kind}">{above}<svg viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="{escape(described)}">{"".join(parts)}</svg></figure>'
    )
