"""What the report reads: a run folder of which any part may be missing or damaged."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from devrf.capture.errors import DevrfError
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.scene import Scene


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

    def __init__(
        self,
        path: Path,
        stages: Sequence[str],
        reasons: Mapping[str, str],
        errors: Mapping[str, str] | None = None,
        stale: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path
        self.stages = tuple(stages)
        self.reasons = dict(reasons)
        self.errors = dict(errors or {})
        self.stale = dict(stale or {})
        self.unreadable: dict[str, str] = {}
        self.drawn_on: set[str] = set()
        self.film_inside = True
        self.room = 1.0
        self._json: dict[str, Any] = {}

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

    def object(self, file: str) -> dict[str, Any]:
        """Content of a JSON file that holds an object; empty where it does not."""
        value = self.json(file)
        return value if isinstance(value, dict) else {}

    def cameras(self, file: str) -> dict[str, dict[str, Any]]:
        """The entries under `cameras` of a JSON file, by name."""
        value = self.object(file).get("cameras")
        entries = value.items() if isinstance(value, dict) else ()
        return {str(name): entry for name, entry in entries if isinstance(entry, dict)}

    def objects(self, file: str, key: str) -> list[dict[str, Any]]:
        """The objects of a list in a JSON file, under a dotted key."""
        value = at(self.object(file), key)
        return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []

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

    def why_absent(self, stage: str) -> str:
        """A sentence for a section whose stage left nothing."""
        if stage in self.reasons:
            return f"Does not apply: {self.reasons[stage]}"
        if self.has(stage):
            return f"The stage {stage} left nothing that can be shown here."
        if stage in self.errors:
            return f"Not available: the stage {stage} failed."
        return f"Not available: the stage {stage} has not run."

    def _read(self, file: str) -> Any:
        try:
            return json.loads((self.path / file).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            self.unreadable[file] = str(error)
            return None


def at(value: Any, key: str) -> Any:
    """The entry under a dotted key ("test.psnr"), None where any step is missing."""
    for step in key.split("."):
        if not isinstance(value, dict) or step not in value:
            return None
        value = value[step]
    return value


def evenly(items: Sequence[Any], count: int) -> list[Any]:
    """At most `count` items, evenly spread, the first and the last among them."""
    if len(items) <= count:
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[round(n * (len(items) - 1) / (count - 1))] for n in range(count)]


def fewer(count: int, room: float) -> int:
    """How many of `count` pictures there is room for, one at least."""
    return max(1, round(count * room))


def as_float(value: Any) -> float:
    """A number of a file; NaN where there is none, which breaks a line in a chart."""
    return float(value) if isinstance(value, (int, float)) else float("nan")
