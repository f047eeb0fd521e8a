"""Amounts of memory and disk, and numbers of things, for people."""

GB = 1e9  # bytes


def size_text(count: int | float) -> str:
    """Bytes for people: 12 MB, 0.36 GB, 19 GB."""
    if count < 0.1 * GB:
        return f"{max(0.0, count) / 1e6:.0f} MB"
    return f"{count / GB:.2g} GB" if count < 99 * GB else f"{count / GB:.0f} GB"


def counted(count: int, thing: str) -> str:
    """1 photo, 2 photos."""
    return f"{count} {thing}" + ("s" if count != 1 else "")
