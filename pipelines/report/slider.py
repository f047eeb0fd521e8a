"""Two pictures under one border that the reader moves, and rows of frames of which one is shown (slider.js)."""

from collections.abc import Sequence

from devrf.pipelines.report.html import text


def slider(pictures: Sequence[tuple[str, str]], name: str, left: int = 0, right: int = 1) -> str:
    """Two pictures of one size, one over the other, with a border to drag; on paper all of them side by side.

    Args:
        pictures: Data URIs, each with what it is in a word or two. More than two: `chooser` tells which are shown.
        name: What all of them show.
        left, right: Which of them are shown at first.
    """
    words = [text(word) for _, word in pictures]
    kinds = {right: "over", left: "under"}  # one picture alone is under its own border
    images = "".join(
        f'<img src="{uri}" alt="{word}, {text(name)}" class="{kinds.get(n, "")}" data-word="{word}" draggable="false">'
        for n, ((uri, _), word) in enumerate(zip(pictures, words, strict=True))
    )
    return (
        f'<div class="compare" data-words="{", ".join(words)}">{images}'
        f'<span class="tag left">{words[left]}</span><span class="tag right">{words[right]}</span>'
        f'<input type="range" min="0" max="100" step="any" value="50" aria-label="Border, {text(name)}">'
        '<span class="bar"></span></div>'
    )


def chooser(words: Sequence[str], left: int, right: int) -> str:
    """Which two of the pictures of the sliders beside it are shown."""
    selects = "".join(
        f'<label>{side} <select data-side="{side}">'
        + "".join(
            f"<option{' selected' if n == shown else ''}>{text(word)}</option>"
            for n, word in enumerate(words)
        )
        + "</select></label>"
        for side, shown in (("left", left), ("right", right))
    )
    return f'<div class="chooser">{selects}</div>'


def pane(picture: str, caption: str) -> str:
    """A picture of a frame (ready HTML) over its caption (ready HTML)."""
    return f"<div>{picture}<figcaption>{caption}</figcaption></div>"


def frames(rows: Sequence[tuple[str, Sequence[str]]], shown: int) -> str:
    """Frames of which one is shown on a screen, with a button for each; all of them on paper.

    Args:
        rows: For each frame the word on its button, and its panes (`pane`).
        shown: Which one is shown at first.
    """
    bodies = "".join(
        f'<div class="frame{" on" if n == shown else ""}">'
        f'<div class="panes {_kind(panes)}">{"".join(panes)}</div></div>'
        for n, (_, panes) in enumerate(rows)
    )
    if len(rows) < 2:
        return bodies
    buttons = "".join(
        f'<button type="button" aria-pressed="{str(n == shown).lower()}">{text(word)}</button>'
        for n, (word, _) in enumerate(rows)
    )
    return f'<div class="picker" role="group" aria-label="Choose a view">{buttons}</div>{bodies}'


def _kind(panes: Sequence[str]) -> str:
    """How the panes are laid out: the slider beside one or two others, or above more of them."""
    return f"n{len(panes)}" if len(panes) <= 3 else "many"
