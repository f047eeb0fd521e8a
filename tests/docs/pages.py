"""What stands on the pages: blocks of code, calls of devrf-pipeline, links, headings."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CHANGELOG.md",
    *sorted((REPOSITORY / "docs").glob("*.md")),
    *sorted((REPOSITORY / "examples").glob("*/README.md")),
]
PROGRAM = "devrf-pipeline"
FENCE = re.compile(
    r"^(?P<fence>```+)(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=fence)$", re.MULTILINE | re.DOTALL
)
FILE = re.compile(r"^`([^`\s]+\.\w+)`:\n\n\Z", re.MULTILINE)  # a line above a block


@dataclass(frozen=True)
class Block:
    """A block of code: where it stands, its language, its text, and the file it is to be, where the page says so."""

    page: Path
    language: str
    text: str
    file: str | None


@dataclass(frozen=True)
class Call:
    """`devrf-pipeline …` as it stands on a page, in words."""

    page: Path
    words: tuple[str, ...]


def blocks(page: Path) -> Iterator[Block]:
    """All blocks of code of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        file = FILE.search(text[: match.start()])
        yield Block(page, match["language"], match["text"], file[1] if file else None)


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def calls(page: Path, commands: set[str]) -> Iterator[Call]:
    """Every call on a page: lines of blocks, and `code` that begins with the program or is a command with options."""
    lines = [line for block in blocks(page) for line in block.text.replace("\\\n", " ").splitlines()]
    for line in lines:
        start = re.match(rf"[^#]*?(?:^|[\s/]){PROGRAM} ", line)
        if start is not None:
            yield Call(page, _words(line[start.end() :]))
    for code in re.findall(r"`([^`\n]+)`", prose(page)):
        if code.startswith(f"{PROGRAM} "):
            yield Call(page, _words(code.removeprefix(f"{PROGRAM} ")))
        elif " --" in code and code.split()[0] in commands:
            yield Call(page, _words(code))


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, by GitHub's rule."""
    found: set[str] = set()
    for title in re.findall(r"^#{1,6} +(.+?) *$", prose(page), flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "").replace("*", "")
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        number = 0
        while (name := f"{slug}-{number}" if number else slug) in found:
            number += 1
        found.add(name)
    return found


def links(page: Path) -> list[str]:
    """Targets of a page's links and pictures."""
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page)))


def _words(text: str) -> tuple[str, ...]:
    return tuple(shlex.split(text.replace("|", " | ").replace("'", ""), comments=True))
