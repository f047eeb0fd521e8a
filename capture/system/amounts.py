"""Amounts of memory and disk, and numbers of things, for people."""

from collections.abc import Sequence
from typing import Any

GB = 1e9  # bytes
LISTED = 6  # frames, photos or files that a text names


def size_text(count: int | float) -> str:
    """Bytes for people: 12 MB, 0.36 GB, 19 GB."""
    if count < 0.1 * GB:
        return f"{max(0.0, count) / 1e6:.0f} MB"
    return f"{count / GB:.2g} GB" if count < 99 * GB else f"{count / GB:.0f} GB"


def counted(count: int, thing: str) -> str:
    """1 photo, 2 photos."""
    return f"{count} {thing}" + ("s" if count != 1 else "")


def some(things: Sequence[Any]) -> str:
    """The first few of many frames, photos or cameras, and how many more there are; "none" of none."""
    more = f" and {len(things) - LISTED} more" if len(things) > LISTED else ""
    return (", ".join(map(str, things[:LISTED])) + more) or "none"
