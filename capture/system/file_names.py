"""Names of people as names of files: letters of all alphabets are safe in them."""

import hashlib
import unicodedata

LONGEST = 200  # bytes; file systems take 255, and suffixes follow

CLIP_SUFFIXES = frozenset(
    ".mp4 .mov .mkv .avi .m4v .mts .m2ts .ts .mxf .webm .mpg .mpeg .wmv .3gp .insv".split()
)


def is_safe(text: str, marks: str = "_-") -> bool:
    """Whether all of a text are letters, digits and these marks, and it is not too long for a file's name."""
    return all(_is_letter(c) or c in marks for c in text) and len(text.encode()) <= LONGEST


def safe(text: str, marks: str = "_-", other: str = "_") -> str:
    """A text with `other` in place of runs of what is neither letter, digit nor one of these marks.

    What is cut off because it is too long goes on as a digest: two long names that begin alike stay two.
    """
    letters = [c if _is_letter(c) or c in marks else "" for c in unicodedata.normalize("NFC", text)]
    kept = "".join(c or other for c, before in zip(letters, ["x", *letters], strict=False) if c or before)
    if len(kept.encode()) <= LONGEST:
        return kept
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{kept.encode()[: LONGEST - 9].decode(errors='ignore')}-{digest}"


def _is_letter(c: str) -> bool:
    """Letters, what is written above and below them, and digits."""
    kind = unicodedata.category(c)
    return kind[0] in "LM" or kind == "Nd"
