"""A calibrated scene written as a data set: into a new folder, which is renamed when it is whole.

The formats keep every camera's lens, and get the pictures as they are but for looks and mattes, which are applied. An
earlier export of the same format is replaced if it holds nothing else; any other folder that holds something is left
alone.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from devrf.capture.formats.parts.files import safe_name
from devrf.capture.formats.parts.readme import readme
from devrf.capture.photos.picture_files import write_png
from devrf.capture.scene import PosedFrame, Scene, plain_colour, read_matted
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.system.remove import remove_tree
from devrf.capture.system.writable import check_folder

MARKER = ".devrf-export"  # holds the name of the format, and those of all files on a line each
README = "README.txt"


@dataclass
class Export:
    """What a writer is given, and what it leaves behind to be told.

    Attributes:
        scene: The scene.
        folder: Empty folder to write into.
        progress: To be called with (fraction done, short text).
        notes: What people should know of this data set; added to its README.txt.
    """

    scene: Scene
    folder: Path
    progress: Progress
    notes: list[str] = field(default_factory=list)


def write_export(
    scene: Scene,
    dataset_format: str,
    write: Callable[[Export], None],
    folder: Path,
    progress: Progress = no_progress,
    notes: Sequence[str] = (),
) -> list[str]:
    """Write a data set and its README.txt; returns what people should know of it.

    Raises:
        InputError: The folder holds something else.
        CaptureError: The format cannot hold this scene, or a picture is missing.
    """
    with new_folder(folder, dataset_format) as new:
        export = Export(scene, new, progress, list(notes))
        write(export)
        (new / README).write_text(readme(scene, dataset_format, export.notes))
    return export.notes


@contextmanager
def new_folder(folder: Path, dataset_format: str) -> Iterator[Path]:
    """A folder to write an export into, which gets its name when it is whole; an earlier one is replaced.

    Raises:
        InputError: The folder holds something else.
    """
    check_target(folder, dataset_format)
    folder.parent.mkdir(parents=True, exist_ok=True)
    new = folder.with_name(f".new-{folder.name}")
    if new.exists() and not (new / MARKER).is_file() and any(new.iterdir()):
        wrong = f"--out {folder}: {new} is in the way, where no export has begun"
        raise InputError("folder-exists", f"{wrong}; move it away, or name another folder")
    if new.exists():
        with _held(new, folder):  # not that of an export that is being written
            remove_tree(new)
    new.mkdir()
    with _held(new, folder):
        try:
            (new / MARKER).write_text(f"{dataset_format}\n")
            yield new
            names = [os.fsencode(name) for name in _files(new)]
            (new / MARKER).write_bytes(b"\n".join([dataset_format.encode(), *names, b""]))
            check_target(folder, dataset_format)  # what came meanwhile
            if folder.exists():
                remove_tree(folder)
            new.rename(folder)
        except BaseException:
            remove_tree(new)
            raise


@contextmanager
def _held(new: Path, folder: Path) -> Iterator[None]:
    """A folder that this process alone writes into, by the kernel's lock on it; where a disk knows none, by nothing.

    Raises:
        InputError: Another export has it.
    """
    busy = InputError(
        "folder-busy", f"--out {folder}: another export is writing there; wait for it, or name another folder"
    )
    try:
        handle = os.open(new, os.O_RDONLY)
    except FileNotFoundError:
        raise busy from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise busy from None
        except OSError:
            pass
        if not (new.exists() and os.path.samestat(os.fstat(handle), new.stat())):
            raise busy
        yield
    finally:
        os.close(handle)


def check_target(folder: Path, dataset_format: str) -> None:
    """A folder to export into is new, empty, or an earlier export of the same format and nothing else.

    Raises:
        InputError: It is not, or cannot be written.
    """
    check_folder(folder, "--out")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    marker = folder / MARKER
    earlier, *names = marker.read_bytes().split(b"\n") if marker.is_file() else [b""]
    others = sorted(_files(folder) - {os.fsdecode(name) for name in names})
    if earlier != dataset_format.encode():
        named = earlier.decode(errors="replace").strip()
        what = f"an export to {named}" if named else "files that are no export"
    elif others:
        what = f"what no export has written ({', '.join(others[:3])}{', …' if others[3:] else ''})"
    else:
        return
    raise InputError("folder-exists", f"--out {folder}: holds {what}; name another folder, or move that away")


def _files(folder: Path) -> set[str]:
    """Names of all files below a folder but the marker; links too, and folders that hold nothing."""
    found: set[str] = set()
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        inside = [os.path.join(root, name) for name in (*files, *links)]
        found |= {os.path.relpath(path, folder) for path in (inside if folders or files else [root])}
    return found - {MARKER, "."}


def copied(export: Export, frames: tuple[PosedFrame, ...], part: str) -> tuple[PosedFrame, ...]:
    """The frames with their pictures copied to `part/<camera>/<number>`, bit by bit; looks and mattes are applied."""
    out, background = [], export.scene.background
    for n, (frame, stem) in enumerate(zip(frames, stems(frames), strict=True)):
        matted = frame.matte is not None and plain_colour(background) is not None
        as_it_is = frame.look is None and not matted
        path = export.folder / part / f"{stem}{frame.path.suffix.lower() if as_it_is else '.png'}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not frame.path.is_file():
            text = f"{frame.path}: picture not found; run the scene again with --force scene"
            raise CaptureError("picture-missing", text)
        if as_it_is:
            shutil.copyfile(frame.path, path)
        else:
            write_png(path, read_matted(frame, background))
        out.append(replace(frame, path=path, flow=None, look=None, matte=None))
        export.progress((n + 1) / len(frames), f"{n + 1} of {len(frames)} pictures")
    return tuple(out)


def stems(frames: tuple[PosedFrame, ...]) -> list[str]:
    """`<camera>/<index>` where indices are unique in each camera, else numbered in order."""
    keys = [(f.camera_name, f.index) for f in frames]
    unique = len(set(keys)) == len(keys)
    return [f"{safe_name(f.camera_name)}/{f.index if unique else n:06d}" for n, f in enumerate(frames)]
