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
    """A block of code: its language, its text, and the file it is to be, where the page says so."""

    language: str
    text: str
    file: str | None


def blocks(page: Path) -> Iterator[Block]:
    """All blocks of code of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        file = FILE.search(text[: match.start()])
        yield Block(match["language"], match["text"], file[1] if file else None)


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def calls(page: Path, commands: set[str]) -> Iterator[list[str]]:
    """Words of every call on a page: lines of blocks, `code` that begins with the program or a command with options."""
    for line in (line for block in blocks(page) for line in block.text.replace("\\\n", " ").splitlines()):
        start = re.match(rf"[^#]*?(?:^|[\s/]){PROGRAM} ", line)
        if start is not None and "[OPTIONS]" not in line:  # of what typer writes
            yield _words(line[start.end() :])
    for code in re.findall(r"`([^`\n]+)`", prose(page)):
        if code.startswith(f"{PROGRAM} ") or (" --" in code and code.split()[0] in commands):
            yield _words(code.removeprefix(f"{PROGRAM} "))


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


def _words(text: str) -> list[str]:
    return shlex.split(text.replace("|", " | ").replace("'", ""), comments=True)
