"""The pictures of a film that is being made, kept so that one that was stopped goes on where it was.

They lie in a hidden folder beside the film's, with what they were made from: the options and the content of the
model. Pictures are written under other names and renamed, by a thread of their own.
"""

import shutil
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from devrf.capture.durable import write_json
from devrf.capture.errors import CaptureError
from devrf.capture.formats.flow_files import Flow, read_flow_file, write_flow_file
from devrf.capture.picture_files import read_pixels, write_png
from devrf.pipelines.film.about import read_made_from
from devrf.pipelines.film.draw import Picture
from devrf.pipelines.runner.lock import LOCK

MADE_FROM = "made_from.json"
WAITING = 4  # pictures that may wait to be written: memory stays bounded where the disk is slow


class Kept:
    """Pictures of one film.

    Args:
        folder: Where they lie; made by `begin`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @staticmethod
    def beside(film: Path) -> "Kept":
        """Those of a film's folder."""
        return Kept(film.with_name(f".{film.name}.part"))

    def begin(self, made_from: str) -> bool:
        """Make the folder, or go on in it; True where pictures of another film were there and are gone."""
        same = read_made_from(self.folder / MADE_FROM) == made_from
        other = (self.folder / MADE_FROM).is_file() and not same
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in self.folder.iterdir() if not same else ():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:  # which is held
                path.unlink()
        if not same:
            write_json(self.folder / MADE_FROM, {"made_from": made_from})
        return other

    def read(self, names: list[str]) -> Picture | None:
        """A picture's files; None unless all are there and whole."""
        paths = {name: self.folder / name for name in names}
        if not all(path.is_file() for path in paths.values()):
            return None
        try:
            return {n: read_flow_file(p) if p.suffix == ".npz" else read_pixels(p) for n, p in paths.items()}
        except CaptureError:
            return None  # a power cut left a hole: it is made again

    @contextmanager
    def writing(self) -> Iterator["Writer"]:
        """Write pictures beside other work; all are written when the block ends."""
        with ThreadPoolExecutor(1, thread_name_prefix="pictures") as pool:
            writer = Writer(self.folder, pool)
            yield writer
            writer.wait(0)

    def count(self, layer: str) -> int:
        """Pictures of a layer that are there."""
        return sum(1 for _ in (self.folder / layer).glob("*.png"))


class Writer:
    """Hands pictures to the thread that writes them; errors come with a later picture, or at the end."""

    def __init__(self, folder: Path, pool: ThreadPoolExecutor) -> None:
        self._folder, self._pool = folder, pool
        self._waiting: deque[Future[None]] = deque()

    def put(self, picture: Picture) -> None:
        """Have a picture written."""
        self._waiting.append(self._pool.submit(_write_all, self._folder, picture))
        self.wait(WAITING)

    def wait(self, most: int) -> None:
        """Return when at most so many pictures wait."""
        while len(self._waiting) > most:
            self._waiting.popleft().result()


def _write_all(folder: Path, picture: Picture) -> None:
    for name, value in picture.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        new = path.with_name(f".{path.name}.tmp")
        _write(new, value)
        new.replace(path)


def _write(path: Path, value: np.ndarray | Flow) -> None:
    if isinstance(value, tuple):
        write_flow_file(path, value)
    else:
        write_png(path, value)
