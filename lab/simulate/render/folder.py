"""A folder that is filled picture by picture: known by what made it, resumed where it stopped, never mixed.

`made_by.json` holds the arguments and whether all is written. Every file appears whole or not at all.
"""

import json
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from devrf.capture.photos.picture_files import write_png
from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_folder

MADE_BY = "made_by.json"
REVISION = 1  # raised when the same arguments give other pictures


class OutputFolder:
    """Where one data set is written."""

    def __init__(self, path: Path, arguments: dict[str, Any]) -> None:
        """Begin, or go on where an earlier try stopped.

        Args:
            path: The folder.
            arguments: What determines every file, JSON values.
        Raises:
            InputError: The folder holds something else.
        """
        self.path = path
        # Once through JSON, so that tuples compare equal to what was read.
        self._made_by = json.loads(json.dumps({"revision": REVISION, **arguments}))
        self.complete = self._check()

    def begin(self) -> None:
        """Make the folder and say what it will hold."""
        self._write(MADE_BY, lambda file: file.write_text(self._text(False), encoding="utf-8"))

    def finish(self) -> None:
        """All is written."""
        self._write(MADE_BY, lambda file: file.write_text(self._text(True), encoding="utf-8"))
        self.complete = True

    def has(self, *names: str) -> bool:
        """Whether all of these files are written."""
        return all((self.path / name).is_file() for name in names)

    def picture(self, name: str, rgba: UInt8[np.ndarray, "h w 4"]) -> None:
        """Write a PNG."""
        self._write(name, lambda file: write_png(file, rgba))

    def arrays(self, name: str, **arrays: np.ndarray) -> None:
        """Write an .npz."""

        def save(file: Path) -> None:
            with open(file, "wb") as stream:
                np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]

        self._write(name, save)

    def array(self, name: str, array: np.ndarray) -> None:
        """Write an .npy."""

        def save(file: Path) -> None:
            with open(file, "wb") as stream:
                np.save(stream, array)

        self._write(name, save)

    def text(self, name: str, text: str) -> None:
        """Write a text file."""
        self._write(name, lambda file: file.write_text(text, encoding="utf-8"))

    def seed_of(self, name: str) -> int:
        """The seed of a picture's samples: of its own, so that a resumed set is the same as an unbroken one."""
        parts = [int(self._made_by["seed"]), zlib.crc32(name.encode())]
        return int(np.random.SeedSequence(parts).generate_state(1)[0] >> 1)

    def _write(self, name: str, write: Callable[[Path], object]) -> None:
        file = self.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        new = file.with_name(f".new-{file.name}")
        write(new)
        os.replace(new, file)

    def _text(self, complete: bool) -> str:
        return json.dumps({**self._made_by, "complete": complete}, indent=1) + "\n"

    def _check(self) -> bool:
        path = self.path
        check_folder(path, "simulate")
        if not path.exists() or not any(path.iterdir()):
            return False
        try:
            found = json.loads((path / MADE_BY).read_text(encoding="utf-8"))
            complete = bool(found.pop("complete"))
        except (OSError, ValueError, KeyError, AttributeError):
            wrong = f"simulate {path}: not an empty folder, and none that was begun with {MADE_BY}"
            raise InputError("folder-exists", f"{wrong}; give a new one or empty it") from None
        changed = sorted(k for k in {*found, *self._made_by} if found.get(k) != self._made_by.get(k))
        if changed:
            key = changed[0]
            differs = f"{key} {found.get(key)}, asked for {self._made_by.get(key)}"
            wrong = f"simulate {path}: holds another data set ({differs})"
            raise InputError("folder-exists", f"{wrong}; give a new folder or empty it")
        return complete
