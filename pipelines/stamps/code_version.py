"""What code a stage depends on: the rooms it may import, what stages share in `pipelines`, and libraries.

Of a room every file counts, whether the stage imports it or not: it may. What moves results about and does not make
them (configuration, runner, commands) is left out; `test_code_version.py` holds what is counted against what stages
import.
"""

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import Distribution

SHARED = "pipelines"  # the part of it that all stages share: all but these folders
APART = (
    *("batch", "budget", "check", "cli", "compare", "config", "export", "film", "init", "player", "report"),
    *("runner", "stages", "stamps", "terminal", "viewer"),
)
LIBRARIES = {  # of a room or a part of it -> the distributions that compute something there
    "capture": ("av", "numpy", "opencv-contrib-python-headless", "pillow", "rawpy", "scipy", "simplejpeg"),
    "calibration": ("numpy", "opencv-contrib-python-headless", "pycolmap", "pyyaml", "scipy"),
    "flow": ("numpy", "opencv-contrib-python-headless", "scipy", "torch"),
    "reconstruct": ("numpy", "opencv-contrib-python-headless", "safetensors", "scipy", "torch", "warp-lang"),
    "pipelines/report": ("jinja2", "matplotlib"),
}

_HERE = Path(__file__).resolve().parents[2]  # rooms lie beside one another, installed or not
_CODE = (".py", ".css", ".html", ".js", ".json", ".yaml")
_RELEASE = re.compile(r"(\d+)(?:\.(\d+))?[\d.]*(?:\.post\d+)?(?:\+.*)?")


@dataclass(frozen=True)
class Code:
    """What made a stage's result, beside what it was given.

    Attributes:
        rooms: Room, part of one, or package of others -> digest of its files.
        libraries: Distribution -> version; what of it counts says `series`.
    """

    rooms: dict[str, str]
    libraries: dict[str, str]


def code_version(*parts: str) -> str:
    """One digest of some rooms or parts of them, such as "flow" or "capture/formats"."""
    for part in parts:
        assert counted(part), f"{part} holds no code"  # by which nothing would ever be told apart
    return _joined(_digest(part) for part in parts)


def code_of(stage: str, rooms: Iterable[str], plug_ins: Iterable[str] = ()) -> Code:
    """The code that makes a stage.

    Args:
        stage: Its name.
        rooms: Rooms, or parts of them, that it may import.
        plug_ins: Modules of others that it loads by their names.
    """
    parts = (*rooms, SHARED)
    files = {part: _digest(part, APART if part == SHARED else ()) for part in parts}
    module = module_of(stage)
    files[module] = _digest(module)
    found = [_version(name) for name in sorted({name for part in parts for name in LIBRARIES.get(part, ())})]
    for top in {name.partition(".")[0] for name in plug_ins}:
        files[top] = _of_others(top)
        found.append(_version_of(top))
    return Code(files, dict(version for version in found if version is not None))


def module_of(stage: str) -> str:
    """The file of a stage's own code, or its folder where it has more than one."""
    module = f"pipelines/stages/{stage}"
    return module if (_HERE / module).is_dir() else f"{module}.py"


def series(version: str) -> str:
    """What of a version counts: major and minor number.

    Patch releases and builds mend what was wrong beside the result, and security updates come as such: they must not
    cost a night. Anything that is no plain release counts as a whole.
    """
    match = _RELEASE.fullmatch(version)
    return version if match is None else ".".join(part for part in match.groups() if part is not None)


def counted(part: str, apart: tuple[str, ...] = ()) -> list[Path]:
    """The files of code of a room, of a folder in it or of a module, in order, but for some folders."""
    place = _HERE / part
    return [place] if place.is_file() else sorted(_below(place, apart))


def _below(folder: Path, apart: tuple[str, ...] = ()) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name not in apart]
        apart = ()  # they lie in the room itself
        yield from (Path(root, name) for name in files if name.endswith(_CODE))


def _digest(part: str, apart: tuple[str, ...] = ()) -> str:
    return _joined(f"{path.relative_to(_HERE).as_posix()}\0{_file_id(path)}" for path in counted(part, apart))


def _joined(texts: Iterable[str]) -> str:
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=16).hexdigest()


def _file_id(path: Path) -> str:
    stat = path.stat()
    return _content(path, stat.st_mtime_ns, stat.st_size)


@cache
def _content(path: Path, mtime_ns: int, size: int) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _of_others(top: str) -> str:
    """One digest of all of somebody else's package: an editable one changes without its version."""
    spec = find_spec(top)
    if spec is None or spec.origin is None:
        return ""
    origin = Path(spec.origin)
    files = sorted(origin.parent.rglob("*.py")) if spec.submodule_search_locations else [origin]
    return _joined(f"{path.relative_to(origin.parent).as_posix()}\0{_file_id(path)}" for path in files)


@cache
def _version(name: str) -> tuple[str, str] | None:
    """A distribution's name and version; None where it is not installed."""
    from importlib import metadata

    try:
        return name, metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _version_of(module: str) -> tuple[str, str] | None:
    """Name and version of the installed distribution that holds a module; None where there is none."""
    from importlib import metadata

    holds = (f"\n{module}/", f"\n{module}.py,")
    found = next((d for d in metadata.distributions() if any(line in _files_in(d) for line in holds)), None)
    return None if found is None else (found.name, found.version)


def _files_in(distribution: "Distribution") -> str:
    return "\n" + (distribution.read_text("RECORD") or "")
