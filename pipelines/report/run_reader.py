"""What the report reads: a run folder of which any part may be missing or damaged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.durable import read_json
from devrf.capture.system.errors import DevrfError

METRICS = "evaluate/metrics.json"


@dataclass
class RunFolder:
    """A run folder, read tolerantly: what is not there is None, what is damaged is noted in `unreadable`.

    Attributes:
        path: The folder that holds the stages' folders.
        stages: Names of the stages in their order.
        reasons: Why a stage does not apply, by its name.
        errors: Why a stage failed when it was last tried, by its name.
        stale: Why a stage that is there would be made again, by its name.
        unreadable: Files that are there but could not be read, with the reason.
        drawn_on: Stages whose files were asked for since it was last emptied.
        film_inside: Whether the page has room for a film.
        room: Share of the usual pictures that it has room for.
    """

    path: Path
    stages: Sequence[str]
    reasons: Mapping[str, str]
    errors: Mapping[str, str] = field(default_factory=dict)
    stale: Mapping[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    drawn_on: set[str] = field(default_factory=set)
    film_inside: bool = True
    room: float = 1.0
    _json: dict[str, Any] = field(default_factory=dict)

    def has(self, stage: str) -> bool:
        """Whether the stage's folder is there."""
        return (self.path / stage).is_dir()

    def folder(self, stage: str) -> Path:
        """The folder of a stage that is to be read."""
        self.drawn_on.add(stage)
        return self.path / stage

    def json(self, file: str) -> Any:
        """Content of a JSON file, None where it is missing or damaged."""
        self.drawn_on.add(file.partition("/")[0])
        if file not in self._json:
            self._json[file] = self._read(file)
        return self._json[file]

    def at(self, file: str, *path: str | int) -> Any:
        """The entry of a JSON file under keys and places in lists, None where any step is missing."""
        return at(self.json(file), *path)

    def object(self, file: str, *path: str | int) -> dict[str, Any]:
        """An object of a JSON file; empty where there is none."""
        value = self.at(file, *path)
        return value if isinstance(value, dict) else {}

    def cameras(self, file: str) -> dict[str, dict[str, Any]]:
        """The entries under `cameras` of a JSON file, by name."""
        entries = self.object(file, "cameras").items()
        return {str(name): entry for name, entry in entries if isinstance(entry, dict)}

    def objects(self, file: str, *path: str | int) -> list[dict[str, Any]]:
        """The objects of a list in a JSON file."""
        value = self.at(file, *path)
        return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []

    def health(self, stage: str) -> list[dict[str, Any]]:
        """The rows a stage wrote about its own result."""
        return self.objects(f"{stage}/health.json", "rows")

    @property
    def scene(self) -> Scene | None:
        """The scene, None where it is missing or damaged."""
        self.drawn_on.add("scene")
        return self._scene

    @cached_property
    def _scene(self) -> Scene | None:
        if not self.has("scene"):
            return None
        try:
            return read_scene(self.path / "scene")
        except (DevrfError, OSError, ValueError, KeyError, TypeError) as error:
            self.unreadable["scene/"] = str(error)
            return None

    def _read(self, file: str) -> Any:
        try:
            return read_json(self.path / file)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            self.unreadable[file] = str(error)
            return None


def at(value: Any, *path: str | int) -> Any:
    """The entry under keys and places in lists, None where any step is missing.

    A dotted key is several ("test.psnr", "K.0.0") unless it is there as it stands: names may hold dots.
    """
    for key in path:
        steps = (
            [key]
            if not isinstance(key, str) or (isinstance(value, dict) and key in value)
            else key.split(".")
        )
        for step in steps:
            if isinstance(value, dict):
                value = value.get(step)
            elif isinstance(value, list) and str(step).isdigit() and int(step) < len(value):
                value = value[int(step)]
            else:
                return None
    return value


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value of a file is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < float("inf")


def as_float(value: Any) -> float:
    """A number of a file; NaN where there is none, which breaks a line in a chart."""
    return float(value) if is_number(value) else float("nan")


def table_of(value: object, columns: int | None = None) -> Float[np.ndarray, "n m"] | None:
    """Rows of finite numbers; None for anything else."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    good = found.ndim == 2 and found.size > 0 and np.isfinite(found).all()
    return found if good and columns in (None, found.shape[1]) else None
