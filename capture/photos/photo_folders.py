"""Folders of photos: which files, in which order, and what of a folder is not read.

A folder as a card has it (DCIM, with 100CANON, 101CANON, ... in it, by the DCF standard) is one folder of photos.
"""

import re
from pathlib import Path

from devrf.capture.frames import some
from devrf.capture.measure import Measure
from devrf.capture.photos.picture_files import PICTURE_SUFFIXES, natural_key
from devrf.capture.photos.raw import is_raw
from devrf.capture.system.amounts import counted
from devrf.capture.system.errors import InputError
from devrf.capture.system.file_names import CLIP_SUFFIXES

UNREAD_KINDS = {  # need a decoder that is not a dependency
    ".heic": "HEIC",
    ".heif": "HEIC",
    ".hif": "HEIC",
    ".avif": "AVIF",
    ".jxl": "JPEG XL",
    ".jp2": "JPEG 2000",
    ".j2k": "JPEG 2000",
}
CONVERT = "set the camera to JPEG (phones: most compatible), and convert these to JPEG with their full size and EXIF"
CARD_FOLDER = re.compile(r"[1-9]\d{2}[A-Za-z0-9_]{5}")  # DCF 2.0: a number and five characters


def is_photo(path: Path) -> bool:
    """Whether the file name is that of a picture or a RAW photo."""
    return path.suffix.lower() in PICTURE_SUFFIXES or is_raw(path)


def list_pictures(folder: Path) -> list[Path]:
    """Photos of a folder in natural order; hidden files and other kinds are left out.

    Raises:
        InputError: If the folder is missing or holds no photos.
    """
    if not folder.is_dir():
        text = f"{folder}: no such folder; check the path in scene.yaml (relative to scene.yaml)"
        raise InputError("folder-missing", text)
    pictures = [picture for part in _parts(folder) for picture in _photos(part)]
    if pictures:
        return pictures
    unread = unread_kinds(folder)
    if unread:
        raise InputError(
            "picture-kind-unread", f"{folder}: holds {_counted(unread)} only, which are not read; {CONVERT}"
        )
    inside = {p.name: sum(len(_photos(part)) for part in _parts(p)) for p in _folders(folder)}
    if any(inside.values()):
        where = ", ".join(f"{count} in {name}" for name, count in inside.items() if count)
        text = f"{folder}: no pictures in this folder itself, but {where}; name one of these, or put them together"
        raise InputError("pictures-inside", text)
    clips = [p.name for p in _files(folder) if p.suffix.lower() in CLIP_SUFFIXES]
    if clips:
        text = f"{folder}: no pictures, but {counted(len(clips), 'clip')} ({some(clips)})"
        taken = f"`ffmpeg -i {clips[0]} -vf fps=2 -q:v 2 {Path(clips[0]).stem}_%04d.jpg`, of each into this folder"
        more = f"; of several clips of one camera take pictures, {taken}" if len(clips) > 1 else ""
        raise InputError("pictures-none", f"{text}; name one clip: {folder.name}/{clips[0]}{more}")
    kinds = ", ".join(sorted({p.suffix or p.name for p in _files(folder)})[:6]) or "nothing"
    text = f"{folder}: no pictures in this folder (it holds: {kinds}); expected JPEG, PNG or RAW files"
    raise InputError("pictures-none", text)


def unread_kinds(folder: Path) -> dict[str, list[Path]]:
    """Photos of a folder that cannot be read, by their kind, but for those of which a copy that can lies beside."""
    found: dict[str, list[Path]] = {}
    for part in _parts(folder):
        read = {p.stem for p in _photos(part)}
        for file in _files(part):
            kind = UNREAD_KINDS.get(file.suffix.lower())
            if kind is not None and file.stem not in read:
                found.setdefault(kind, []).append(file)
    return found


def unread_faults(folder: Path) -> list[Measure]:
    """What to say of photos of a folder, or in folders in it, that are not read."""
    faults, unread = [], unread_kinds(folder)
    if unread:
        count = sum(map(len, unread.values()))
        first = some([file.name for files in unread.values() for file in files])
        text = f"{count} beside {len(list_pictures(folder))} that are: {_counted(unread)} ({first})"
        faults.append(
            Measure("not-used", f"photos that are not read: {text}", why="kinds", facts={"convert": CONVERT})
        )
    parts = _parts(folder)
    inside = {p.name: len(_photos(p)) for p in _folders(folder) if p not in parts}
    if any(inside.values()):
        text = ", ".join(f"{count} in {name}" for name, count in inside.items() if count)
        faults.append(Measure("not-used", f"photos in folders inside: {text}", why="folders"))
    return faults


def numbering(pictures: list[Path]) -> list[str]:
    """What is odd about the numbers in the names of photos in natural order, one sentence each."""
    notes = []
    if [p.name for p in pictures] != sorted(p.name for p in pictures):
        notes.append(
            f"file names do not sort by number ({pictures[0].name} to {pictures[-1].name}): taken in the "
            "order of their numbers"
        )
    matches = [re.fullmatch(r"(.*?)(\d+)", p.stem) for p in pictures]
    numbers = [int(m[2]) for m in matches if m is not None]
    if len(numbers) == len(pictures) and len({m[1] for m in matches if m is not None}) == 1:
        missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
        if 0 < len(missing) <= len(numbers):  # more: numbers that are times, or count in steps
            between = f"between {numbers[0]} and {numbers[-1]}: {some(missing)}"
            notes.append(f"{len(missing)} numbers are missing {between}")
    return notes


def _files(folder: Path) -> list[Path]:
    """Files of a folder that are not hidden, in natural order."""
    files = (p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return sorted(files, key=lambda p: (natural_key(p.name), p.name))


def _folders(folder: Path) -> list[Path]:
    inside = (p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    return sorted(inside, key=lambda p: (natural_key(p.name), p.name))


def _photos(folder: Path) -> list[Path]:
    """Photos of a folder that are read; of a photo that is there as RAW too, the RAW file."""
    photos = [p for p in _files(folder) if is_photo(p)]
    developed = {p.stem for p in photos if is_raw(p)}  # one fixed recipe
    return [p for p in photos if is_raw(p) or p.stem not in developed]


def _parts(folder: Path) -> list[Path]:
    """The folder itself; where it has no photos but those of a card's folders, these."""
    if any(is_photo(p) or p.suffix.lower() in UNREAD_KINDS for p in _files(folder)):
        return [folder]
    return [p for p in _folders(folder) if CARD_FOLDER.fullmatch(p.name)] or [folder]


def _counted(kinds: dict[str, list[Path]]) -> str:
    return ", ".join(f"{len(files)} {kind}" for kind, files in kinds.items())
