"""What messages about scene.yaml are made of: what may have been meant."""

import difflib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from devrf.capture.system.errors import InputError
from devrf.pipelines.config.gone import GONE

Say = Callable[[str, str], None]  # takes the dotted key and what is wrong with it


def suggestion(word: str, choices: Iterable[str], *, cutoff: float = 0.6) -> str:
    """`, did you mean …?` where one of the choices is near; else nothing."""
    near = difflib.get_close_matches(word, list(choices), n=1, cutoff=cutoff)
    return f", did you mean {near[0]}?" if near else ""


def unknown_word(option: str, word: str, choices: Sequence[str]) -> InputError:
    """A word that an option does not take, or no more."""
    expected = f"expected {', '.join(choices)}{suggestion(word, choices)}"
    text = f"{option} {word}: {GONE.get(f'{option} {word}', expected)}"
    return InputError("option-unknown-value", text)


def shown(value: object) -> str:
    """A value as it stands in the file, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def near_file(path: Path) -> str:
    """A suggestion out of the folder of a file that is missing."""
    try:
        names = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    except OSError:
        names = []
    return suggestion(path.name, names, cutoff=0.75)
