"""Small pieces of the report's HTML. Every text that comes from outside passes `text`, which escapes it."""

import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from urllib.parse import quote

UP = "../"  # the page lies in report/, the files it quotes in the run folder beside it


def text(value: object) -> str:
    """Any value as escaped text."""
    return escape(str(value), quote=True)


def page(title: str, body: str) -> str:
    """A page that needs no other file."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{asset('report.css')}</style></head><body>{body}</body></html>"
    )


def asset(name: str) -> str:
    """A file of this folder that pages hold."""
    return (files("devrf.pipelines.report") / name).read_text(encoding="utf-8")


def link(file: str, label: str | None = None) -> str:
    """A relative link to a file of the run folder."""
    return f'<a class="file" href="{UP}{quote(file)}">{text(label or file)}</a>'


def number(
    value: object,
    unit: str = "",
    digits: int = 2,
    *,
    file: str,
    key: str,
    why: str = "",
    sign: bool = False,
    scale: float = 1.0,
) -> str:
    """A number with its unit, linked to the file it stands in.

    Args:
        value: Number as it stands in the file; anything else (None, NaN) is shown as missing, with `why`.
        unit: Unit, after a thin space.
        digits: Decimals shown; the full value is in `data-value`.
        file, key: Where it comes from, relative to the run folder, and the dotted key there.
        why: Reason for a missing value.
        sign: Show a plus in front of positive values.
        scale: Factor from the file's unit to the shown one (100 for a share in percent).
    """
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        reason = f' title="{text(why)}"' if why else ""
        return f'<span class="none"{reason}>not measured</span>'
    shown = readable(float(value) * scale, digits)
    if sign and value > 0:
        shown = f"+{shown}"
    space = "" if unit == "°" else " "
    tail = f'<span class="unit">{space}{text(unit)}</span>' if unit else ""
    return (
        f'<a class="n" href="{UP}{quote(file)}" title="{text(file)}: {text(key)}" data-file="{text(file)}" '
        f'data-key="{text(key)}" data-value="{float(value)!r}">{shown}</a>{tail}'
    )


def readable(value: float, digits: int) -> str:
    """Fixed decimals; two significant digits where they would all be zero; spaces between thousands."""
    if value != 0 and abs(value) < 0.5 * 10**-digits:
        return f"{value:.2g}"
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "\u2212")


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    source: str = "",
    numeric: Sequence[int] = (),
    narrow: bool = False,
    wide_last: bool = False,
) -> str:
    """A table of ready HTML cells; columns in `numeric` are set right. Empty text without rows.

    Args:
        head, rows: Words over the columns, and the cells.
        source: File of the run folder that the numbers stand in.
        numeric: Columns of numbers.
        narrow: As wide as half a page.
        wide_last: The last column holds sentences: on a phone it is scrolled to instead of squeezed.
    """
    if not rows:
        return ""
    align = ['class="num"' if i in numeric else "" for i in range(len(head))]
    top = "".join(f'<th scope="col" {a}>{text(h)}</th>' for h, a in zip(head, align, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td {a}>{cell}</td>" for cell, a in zip(row, align, strict=True)) + "</tr>"
        for row in rows
    )
    note = f'<p class="source">Source: {link(source)}</p>' if source else ""
    kinds = f"scroll{' narrow' if narrow else ''}{' wide-last' if wide_last else ''}"
    return (
        f'<div class="{kinds}"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>{note}'
    )


def section(name: str, title: str, lead: str, body: str) -> str:
    """A section of the page with a heading and one sentence about what it shows."""
    return (
        f'<section id="{text(name)}"><h2>{text(title)}</h2><p class="lead">{text(lead)}</p>{body}</section>'
    )


def absent(reason: str) -> str:
    """The body of a section that has nothing to show, with the reason."""
    return f'<p class="absent">{text(reason)}</p>'


def figure(image: str, caption: str, alt: str) -> str:
    """A picture (data URI) with a caption of ready HTML."""
    return (
        f'<figure class="pic"><img src="{image}" alt="{text(alt)}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def duration(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 1:
        return "under 1 s"
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 60 else f"{minutes / 60:.1f} h"
