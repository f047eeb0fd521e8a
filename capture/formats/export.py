"""A calibrated scene written as a data set: into a new folder, which is renamed when it is whole.

nerfstudio and COLMAP keep every camera's lens, and get the pictures as they are. The others have one focal
length: their pictures are undistorted to a common pinhole camera. Looks are applied in all formats. An earlier export
of the same format is replaced if it holds nothing else; any other folder that holds something is left alone.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from devrf.capture.camera import Camera
from devrf.capture.errors import CaptureError, InputError
from devrf.capture.formats.files import safe_name
from devrf.capture.formats.flow_files import Flow
from devrf.capture.formats.readme import readme
from devrf.capture.picture_files import write_png
from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import PosedFrame, Scene, plain_colour, read_matted
from devrf.capture.writable import check_folder

if TYPE_CHECKING:
    from devrf.capture.undistort import Undistorter

MARKER = ".devrf-export"  # holds the name of the format, and those of all files on a line each
README = "README.txt"
FindFlow = Callable[[PosedFrame], Flow | None]


@dataclass
class Export:
    """What a writer is given, and what it leaves behind to be told.

    Attributes:
        scene: The scene.
        folder: Empty folder to write into.
        find_flow: Backward flow of a frame at any size of its picture, or None.
        progress: To be called with (fraction done, short text).
        notes: What people should know of this data set; added to its README.txt.
    """

    scene: Scene
    folder: Path
    find_flow: FindFlow
    progress: Progress
    notes: list[str] = field(default_factory=list)


def write_export(
    scene: Scene,
    dataset_format: str,
    write: Callable[[Export], None],
    folder: Path,
    find_flow: FindFlow = lambda frame: None,
    progress: Progress = no_progress,
    notes: Sequence[str] = (),
) -> list[str]:
    """Write a data set and its README.txt; returns what people should know of it.

    Raises:
        InputError: The folder holds something else.
        CaptureError: The format cannot hold this scene, or a picture is missing.
    """
    with new_folder(folder, dataset_format) as new:
        export = Export(scene, new, find_flow, progress, list(notes))
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
            shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    with _held(new, folder):
        try:
            (new / MARKER).write_text(f"{dataset_format}\n")
            yield new
            names = [os.fsencode(name) for name in _files(new)]
            (new / MARKER).write_bytes(b"\n".join([dataset_format.encode(), *names, b""]))
            check_target(folder, dataset_format)  # what came meanwhile
            if folder.exists():
                shutil.rmtree(folder)
            new.rename(folder)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
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


def static_of(export: Export, what: str, left_out: bool = True) -> tuple[PosedFrame, ...]:
    """The pictures at rest, for formats that hold nothing else (`left_out`: those in motion, which is said).

    Raises:
        CaptureError: There are none.
    """
    scene = export.scene
    if not scene.static:
        text = f"{what} holds a scene at rest, and this scene has no sweep; export to nerfstudio"
        raise CaptureError("rest-missing", text)
    if scene.dynamic and left_out:
        export.notes.append(
            f"{what} has no times: the {len(scene.dynamic)} pictures in motion are left out (nerfstudio, colmap and "
            "devrf hold them)"
        )
    return scene.static


class Pinholes:
    """Pictures of several cameras as one pinhole camera sees them."""

    def __init__(self, export: Export, frames: tuple[PosedFrame, ...], part: str = "") -> None:
        """Of `frames`, to be written into folder `part` of the export.

        Where the background is plain nothing is cut; where surroundings are seen no pixel stays empty.
        """
        from devrf.capture.undistort import common_pinhole  # by OpenCV, which reading does not need

        self.export = export
        self.whole = plain_colour(export.scene.background) is not None
        self.pinhole = common_pinhole([f.camera for f in frames], self.whole)
        self._undistorters: dict[tuple, Undistorter] = {}
        self.same = all(self._of(f.camera).same for f in frames)
        if not self.same:
            how = (
                "nothing is cut, what a camera did not see is transparent"
                if self.whole
                else "cut to what all see"
            )
            size = f"{self.pinhole.width}x{self.pinhole.height}"
            which = f"pictures in {part}/" if part else "pictures"
            export.notes.append(f"{which} are undistorted to one pinhole camera of {size} ({how})")

    def camera(self, frame: PosedFrame) -> Camera:
        """The pinhole camera where a frame's camera is."""
        return replace(self.pinhole, cam_from_world=frame.camera.cam_from_world)

    def write(self, frame: PosedFrame, path: Path, alpha: bool = True) -> PosedFrame:
        """Write a frame's picture as PNG; the frame as it is in the data set."""
        path.parent.mkdir(parents=True, exist_ok=True)
        undistorter = self._of(frame.camera)
        rgba = _with_alpha(read_matted(frame, self.export.scene.background))
        if rgba.shape[:2] != (frame.camera.height, frame.camera.width):
            wrong = f"{frame.path}: picture has another size than its calibration"
            raise CaptureError("picture-size-wrong", f"{wrong}; run again with --force scene")
        picture = undistorter.picture(rgba)
        write_png(path, picture if alpha else picture[..., :3])
        return replace(frame, path=path, camera=self.camera(frame), flow=None, look=None, matte=None)

    def flow(self, frame: PosedFrame) -> Flow | None:
        """A frame's backward flow at the size of the written picture."""
        found = self.export.find_flow(frame)
        return None if found is None else self._of(frame.camera).flow(*found)

    def _of(self, camera: Camera) -> "Undistorter":
        from devrf.capture.undistort import Undistorter

        if camera.lens not in self._undistorters:
            self._undistorters[camera.lens] = Undistorter(camera, self.pinhole)
        return self._undistorters[camera.lens]


def _with_alpha(pixels: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w 4"]:
    """Opaque where the file has no alpha."""
    opaque = np.full((*pixels.shape[:2], 4 - pixels.shape[2]), 255, np.uint8)
    return np.concatenate([pixels, opaque], axis=2)
