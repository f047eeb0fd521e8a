"""Which files of a card belong to one recording: chapters that the camera cut it into, small copies, clips of photos.

GoPro names its chapters: GX010012 and GX020012, or GOPR0042 and GP010042. Others count on: C0001 and C0002, MVI_0007
and MVI_0008, 00000 and 00001, DJI_0003 and DJI_0004, or with a time between, DJI_20240512143000_0003_D. Two of those
are one recording where the second begins as the first ends, or where the first is as large as a file on a card can be.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from devrf.capture.measure import Measure
from devrf.capture.system.errors import DevrfError
from devrf.capture.video.reader import probe_video
from devrf.capture.video.recorded import read_recorded

CHAPTER = re.compile(r"(G[HXLSP])(\d{2})(\d{4})")  # kind, chapter, recording
FIRST_OF_OLD = re.compile(r"GOPR(\d{4})")
NUMBERED = re.compile(r"(.*?)(\d{4,})")  # as cameras count; `cam1` and `cam2` are two of them
DATED = re.compile(r"(DJI_)\d{14}_(\d{4})(_\w+)?")  # each with its own time
CARD_BYTES = (0.93 * 2**32, 2.0**32)  # of FAT; cameras stop somewhat before the end
AT_ONCE_S = 1.0  # created in whole seconds; nobody stops and starts a camera so fast
NEXT_FRAME_S = 0.1  # by timecode
# Sony's C0001S03, editors' C0001_Proxy
SMALL_COPY = re.compile(r"(.+?)(S\d{2}|[_-]?proxy|[_-]?lr)", re.IGNORECASE)
SMALL_COPIES = frozenset(("sub", "proxy", "proxies"))  # folders of them
LIVE_S = 4.0  # the clip that a phone takes with a photo lasts up to three seconds


def chapters(path: Path) -> list[Path]:
    """All files of the recording that a clip belongs to, in order; the clip alone where it is whole."""
    alike = _named_alike(path)
    if len(alike) > 1:
        return alike
    before, after = [path], [path]
    while (previous := _neighbour(before[0], -1)) is not None and _continues(previous, before[0]):
        before.insert(0, previous)
    while (following := _neighbour(after[-1], 1)) is not None and _continues(after[-1], following):
        after.append(following)
    return before + after[1:]


def chapter_faults(path: Path) -> list[Measure]:
    """What to say of a clip that is one of several chapters, of which only it is used."""
    parts = chapters(path)
    if len(parts) < 2:
        return []
    others = ", ".join(p.name for p in parts if p != path)
    text = f"{path.name} is one of {len(parts)} chapters of one recording, {others} not used"
    return [Measure("not-used", text, why="chapters", facts={"command": join_command(parts)})]


def join_command(parts: Sequence[Path]) -> str:
    """How to join chapters without coding anew, in their folder."""
    names = " ".join(p.name for p in parts)
    joined = f"{parts[0].stem}_whole{parts[0].suffix}"
    return (
        f"`printf \"file '%s'\\n\" {names} > chapters.txt && ffmpeg -f concat -i chapters.txt -map 0:v -map 0:a? "
        f"-c copy {joined}`"
    )


def small_copy_of(path: Path, clips: Sequence[Path]) -> Path | None:
    """The clip of which another is by its name a small copy, made by the camera for editing; None where it is none."""
    in_folder = bool(SMALL_COPIES & {part.lower() for part in path.parts[:-1]})
    found = SMALL_COPY.fullmatch(path.stem)
    stems = {found[1].lower()} if found else set()
    stems |= {path.stem.lower()} if in_folder else set()
    near = [c for c in clips if c != path and c.stem.lower() in stems and _near(c, path)]
    return near[0] if near else None


def is_of_photo(path: Path, photos: Sequence[Path], duration_s: float) -> bool:
    """Whether a clip was taken by a phone along with a photo of the same name in the same folder."""
    return duration_s <= LIVE_S and any(p.parent == path.parent and p.stem == path.stem for p in photos)


def _chapter(path: Path) -> tuple[str, int] | None:
    """Recording and number of a clip that its name says is a chapter."""
    first = FIRST_OF_OLD.fullmatch(path.stem.upper())
    if first:
        return f"GP{first[1]}", 0
    found = CHAPTER.fullmatch(path.stem.upper())
    return (found[1] + found[3], int(found[2])) if found else None


def _named_alike(path: Path) -> list[Path]:
    """A clip and the chapters of the same recording beside it, by their names, in order; none by another name."""
    own = _chapter(path)
    if own is None:
        return []
    beside = [p for p in path.parent.iterdir() if p.suffix.lower() == path.suffix.lower()]
    numbers = {p: found[1] for p in beside if (found := _chapter(p)) is not None and found[0] == own[0]}
    return sorted(numbers, key=numbers.__getitem__)


def _neighbour(path: Path, step: int) -> Path | None:
    """The file whose name counts one further, or one back; None where there is none, or several."""
    dated = DATED.fullmatch(path.stem)
    if dated is not None:
        wanted = (dated[1], int(dated[2]) + step, dated[3])
        others = [(p, DATED.fullmatch(p.stem)) for p in path.parent.iterdir() if p.suffix == path.suffix]
        next_to = [p for p, found in others if found and (found[1], int(found[2]), found[3]) == wanted]
        return next_to[0] if len(next_to) == 1 else None
    found = NUMBERED.fullmatch(path.stem)
    if found is None or _chapter(path) is not None:
        return None
    number = int(found[2]) + step
    other = path.with_name(f"{found[1]}{number:0{len(found[2])}d}{path.suffix}")
    return other if number >= 0 and other.is_file() else None


def _continues(first: Path, second: Path) -> bool:
    """Whether the second of two files begins where the first one ends, of one camera in one mode."""
    try:
        a, b = probe_video(first), probe_video(second)
        said_a, said_b = read_recorded(first), read_recorded(second)
    except DevrfError:
        return False  # whoever uses it will say
    if (a.width, a.height, a.codec, a.fps) != (b.width, b.height, b.codec, b.fps) or a.duration_s is None:
        return False
    if said_a.timecode_s is not None and said_b.timecode_s is not None:
        return abs(said_b.timecode_s - said_a.timecode_s - a.duration_s) < NEXT_FRAME_S
    if CARD_BYTES[0] < first.stat().st_size < CARD_BYTES[1]:
        return True
    if said_a.created_s is None or said_b.created_s is None:
        return False
    return abs(said_b.created_s - said_a.created_s - a.duration_s) <= AT_ONCE_S < a.duration_s


def _near(one: Path, other: Path) -> bool:
    """Whether two files lie in one folder, or in folders of one folder."""
    return (
        one.parent == other.parent
        or one.parent.parent == other.parent.parent
        or one.parent == other.parent.parent
    )
