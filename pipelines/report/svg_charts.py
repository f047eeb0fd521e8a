"""Drawings for the report: matplotlib's SVG in the colours of the page, so that they follow the light and dark theme.

The same values give the same text. matplotlib is imported when the first drawing is made.
"""

import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = 6  # --s0 .. --s5 in report.css
LINES = tuple(f"#0000f{n}" for n in range(COLOURS))  # stand for the page's colours, and are replaced by them
MUTED, RULE = "#00000a", "#00000b"
THEME = {MUTED: "--muted", RULE: "--rule"} | {c: f"--s{n}" for n, c in enumerate(LINES)}
WIDE, SMALL = (480, 250), (340, 190)  # px; text is 12 px high in both
NEEDLESS = re.compile(
    r'font-family:[^;"]*; ?|<g id="[^"]*"/>|(?<=<g) id="[^"]*"| transform="rotate\(-0 [^"]*"'
)
PLACES = re.compile(r'(?<= d=")[^"]*|(?<= [xy]=")[^"]*')  # two decimals of them can be seen
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "devrf",
    "text.parse_math": False,  # a dollar in a name is one
    "font.size": 12,
    "text.color": MUTED,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": RULE,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "lines.linewidth": 1.8,
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True)
class Series:
    """One line of a chart; y may hold NaN where there is no value. Without a name it is not in the legend."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: int = 0
    dashed: bool = False


@dataclass(frozen=True)
class Chart:
    """A drawing for a page: its SVG, the words above it, and the lines that its legend names."""

    svg: str
    title: str = ""
    keys: tuple[Series, ...] = ()


def line_chart(
    series: Sequence[Series],
    labels: tuple[str, str],
    *,
    log_y: bool = False,
    marks: Sequence[tuple[float, str]] = (),
    title: str = "",
    small: bool = False,
) -> Chart | None:
    """A line chart with axes, grid and a legend; None when nothing can be drawn.

    Args:
        series: Lines; points that are not finite (or not positive on a logarithmic axis) break the line.
        labels: Titles of the axes, x and y, with units.
        log_y: A logarithmic axis.
        marks: Vertical lines with a word each (for example where a level begins).
        title: Words above the chart.
        small: For rows of three.
    """
    x_label, y_label = labels
    drawn = [(s, _drawable(s.x, False), _drawable(s.y, log_y)) for s in series]
    drawn = [(s, x, y) for s, x, y in drawn if np.isfinite(x + y).any()]
    if not drawn:
        return None

    def paint(figure: "Figure") -> None:
        from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

        axes = figure.add_subplot(xlabel=x_label, ylabel=y_label)
        for s, x, y in drawn:
            axes.plot(x, y, "--" if s.dashed else "-", color=LINES[s.colour % COLOURS])
        if log_y:
            axes.set(yscale="log")
            low, high = axes.yaxis.get_data_interval()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_locator(NullLocator())
        low, high = axes.get_xlim()
        for x, word in marks:
            if low <= x <= high:
                axes.axvline(x, color=MUTED, linestyle=":", linewidth=1)
                beside = "left" if x < low + 0.8 * (high - low) else "right"
                at_top = {"xycoords": ("data", "axes fraction"), "va": "top", "ha": beside}
                axes.annotate(f" {word} ", (x, 0.98), fontsize=10.5, **at_top)

    described = f"{title} {y_label} against {x_label}".strip()
    named = tuple(s for s, _, _ in drawn if s.name)
    keys = named if len(named) > 1 and not title else ()
    return draw(paint, SMALL if small else WIDE, title, described, keys)


def draw(
    paint: Callable[["Figure"], None],
    size: tuple[int, int],
    title: str,
    described: str,
    keys: tuple[Series, ...] = (),
) -> Chart:
    """What `paint` draws, as SVG in the colours of the page."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    out = io.StringIO()
    with rc_context(STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of letters that matplotlib's own font lacks: the browser has them
        figure = Figure(figsize=(size[0] / 72, size[1] / 72), dpi=72)
        paint(figure)
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    head = f'<svg viewBox="0 0 {size[0]} {size[1]}" role="img" aria-label="{escape(described)}">'
    svg = re.sub(r"^.*?<svg[^>]*>.*?</style>", lambda _: head + "<defs>", out.getvalue(), flags=re.DOTALL)
    svg = NEEDLESS.sub("", svg)
    svg = PLACES.sub(lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), svg)
    for colour, name in THEME.items():
        svg = svg.replace(colour, f"var({name})")
    return Chart(re.sub(r"\s*\n\s*", " ", svg), title, keys)


def _drawable(values: Sequence[float], is_log: bool) -> Float[np.ndarray, " n"]:
    found = np.array(values, dtype=np.float64)
    return np.where(np.isfinite(found) & (~is_log | (found > 0)), found, np.nan)
