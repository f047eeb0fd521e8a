"""What a part of an accuracy benchmark gets, and how the parts become one table."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from devrf.capture.system.errors import DevrfError
from devrf.lab.bench.bench_rows import Row, publish
from devrf.pipelines.stages.evaluate import versions
from devrf.pipelines.terminal.console import Talk


@dataclass(frozen=True)
class Cases:
    """Where a part finds real captures and leaves its own files.

    Attributes:
        data: Folder of real captures, one folder each; None where there is none.
        out: Folder for what a part makes; every part uses a folder of its own in it.
        talk: Where to say how far it is.
    """

    data: Path | None
    out: Path
    talk: Talk

    def real(self, name: str) -> Path | None:
        """The folder of a real capture; None where it is not there."""
        folder = None if self.data is None else self.data / name
        return folder if folder is not None and folder.is_dir() else None

    def measured(
        self, capture: str, name: str, unit: str, measure: Callable[[str, Path], list[Row]]
    ) -> list[Row]:
        """What is measured of a real capture, given `name` and its folder; a row that says so where it is missing."""
        folder = self.real(capture)
        return [not_there(name, unit, capture)] if folder is None else measure(name, folder)

    def folder(self, name: str) -> Path:
        """A part's own folder in `out`, made where it is not there."""
        (self.out / name).mkdir(parents=True, exist_ok=True)
        return self.out / name


def not_there(name: str, unit: str, capture: str) -> Row:
    """The row of a number whose capture is missing."""
    return Row(name, None, unit, why=f"{capture} is not in the folder of captures (--data)")


def run_parts(title: str, parts: Mapping[str, str], cases: Cases, json_path: Path) -> list[Row]:
    """Measure parts (name -> module, in which the function has that name), print one table, write the rows.

    A part that cannot be calibrated is a row without a value that says why, and the others go on.
    """
    rows: list[Row] = []
    for name, module in parts.items():
        cases.talk.say(f"{title}: {name}")
        try:
            rows += getattr(import_module(f"devrf.lab.bench.accuracy.{module}"), name)(cases)
        except DevrfError as error:
            rows.append(Row(f"{title}/{name}", None, "", met=False, why=str(error)))
    return publish(cases.talk, f"bench {title}", rows, json_path, benchmark=title, versions=versions())
