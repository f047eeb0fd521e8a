"""What code a stage depends on: the sources its module imports, followed through the domain folders, and libraries.

The runner's own files (configuration, stamps, command line) are left out: they move results about, they
do not make them. Imports are read from the text, so nothing is imported; and by patterns, not by a parser, because
every start of the program reads them all; `test_stamps.py` holds both against each other.
"""

import hashlib
import os
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import Distribution

ROOMS = ("capture", "calibration", "flow", "reconstruct")
RUNNER = ("config", "runner", "stamps")  # folders of `pipelines`
RUNNER_FILES = (
    "stage",
    "health.rows",
    "logs",
    "console",
    "status",
    "stages",
    "cli",
    "cli_options",
    "run_command",
    "budget.allowance",
    "budget.at_once",
    "budget.memory",
    "budget.raw_files",
)
NO_RESULTS = ("jaxtyping", "psutil")  # libraries that check or look at processes, and compute nothing

# a folder; what is in it, and the data files beside it, which it may include, count whole
_TEMPLATES = "templates"
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))", re.MULTILINE
)
_COMMENT = re.compile(r"#[^\n]*")
_DATA_FILE = r"[\w-]+\.(?:css|js|html|json)"
_NAMED = re.compile(rf"""["'](devrf\.[\w.]+|{_DATA_FILE}|{_TEMPLATES})["']""")
_RELEASE = re.compile(r"(\d+)(?:\.(\d+))?[\d.]*(?:\.post\d+)?(?:\+.*)?")


@dataclass(frozen=True)
class Code:
    """What made a stage's result, beside what it was given.

    Attributes:
        sources: Module -> digest of its file.
        libraries: Distribution -> version; what of it counts says `series`.
    """

    sources: dict[str, str]
    libraries: dict[str, str]


def code_version(module: str) -> str:
    """One digest of the sources that a module needs."""
    digest = hashlib.blake2b(digest_size=16)
    for name, path in sorted(sources(module).items()):
        digest.update(f"{name}\0{file_id(path)}\0".encode())
    return digest.hexdigest()


def code_of(module: str, plug_ins: Iterable[str] = ()) -> Code:
    """The code that a module (such as devrf.pipelines.stages.flow) needs.

    Args:
        module: The module.
        plug_ins: Modules of others that it loads by their names.
    """
    files = sources(module)
    imported = {name for path in files.values() for name in _words(path)[0]}
    tops = {name.partition(".")[0] for name in imported} - {"devrf"} - sys.stdlib_module_names
    for name in plug_ins:
        top = name.partition(".")[0]
        files |= _package(top)
        tops.add(top)
    installed = dict(found for top in tops if (found := _distribution(top)) is not None)
    return Code(
        {name: file_id(path) for name, path in sorted(files.items())},
        {name: version for name, version in sorted(installed.items()) if name not in NO_RESULTS},
    )


def sources(module: str) -> dict[str, Path]:
    """Module name -> file, of `module` and of all that it imports from the domain folders."""
    found: dict[str, Path] = {}
    todo, seen = [module], {module}
    while todo:
        name = todo.pop()
        path = _file(name)
        if path is None:
            continue
        found[name] = path
        imported, named = _words(path)
        new = {word for word in (*imported, *named) if _counts(word)} - seen
        todo += new
        seen |= new
        found |= {f"{name}:{word}": path.parent / word for word in named if (path.parent / word).is_file()}
        if _TEMPLATES in named:
            beside = (file for file in path.parent.rglob("*.*") if re.fullmatch(_DATA_FILE, file.name))
            found |= {f"{name}:{file.relative_to(path.parent).as_posix()}": file for file in beside}
    return found


def series(version: str) -> str:
    """What of a library's version counts: major and minor number.

    Patch releases and builds mend what was wrong beside the result, and security updates come as such: they must not
    cost a night. Anything that is no plain release counts as a whole.
    """
    match = _RELEASE.fullmatch(version)
    return version if match is None else ".".join(part for part in match.groups() if part is not None)


def file_id(path: Path) -> str:
    """Digest of a source file; short, since a stamp holds a hundred."""
    stat = path.stat()
    return _file_id(path, stat.st_mtime_ns, stat.st_size)


@cache
def _file_id(path: Path, mtime_ns: int, size: int) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest()


def _counts(name: str) -> bool:
    parts = name.split(".")
    if len(parts) < 3 or parts[0] != "devrf":
        return False
    if parts[1] == "pipelines":
        return parts[2] not in RUNNER and ".".join(parts[2:]) not in RUNNER_FILES
    return parts[1] in ROOMS


def _words(path: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    stat = path.stat()
    return _read_words(path, stat.st_mtime_ns, stat.st_size)


@cache
def _read_words(path: Path, mtime_ns: int, size: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Modules that a file may import (`from a import b` gives both a and a.b); modules and files that it names.

    A module that is named runs in a process of its own; a file lies beside this one.
    """
    if path.suffix != ".py":
        return (), ()
    text = path.read_text(encoding="utf-8")
    imported: list[str] = []
    for module, names, plain in _IMPORT.findall(text):
        inner = _COMMENT.sub("", names or plain).strip("() \t\n").replace("\\", "")
        firsts = [words[0] for part in inner.split(",") if (words := part.split())]
        imported += [module, *(f"{module}.{name}" for name in firsts)] if module else firsts
    return tuple(imported), tuple(_NAMED.findall(text))


def _file(module: str) -> Path | None:
    """The file of a devrf module. Its folder is where the room was imported from: editable or installed."""
    parts = module.split(".")
    folder = _room(parts[1])
    if folder is None:
        return None
    path = os.path.join(folder, *parts[2:])  # not Path's methods: thousands of names are tried
    for candidate in (f"{path}.py", os.path.join(path, "__init__.py")):
        if os.path.isfile(candidate):
            return Path(candidate)
    return None


@cache
def _room(room: str) -> Path | None:
    beside = Path(__file__).resolve().parents[2] / room  # rooms lie beside one another in both layouts
    return beside if beside.is_dir() else None


def _package(top: str) -> dict[str, Path]:
    """Module name -> file of everything in somebody else's package: an editable one changes without its version."""
    spec = find_spec(top)
    if spec is None or spec.origin is None:
        return {}
    if not spec.submodule_search_locations:
        return {top: Path(spec.origin)}
    folder = Path(spec.origin).parent
    return {
        ".".join((top, *path.relative_to(folder).with_suffix("").parts)): path
        for path in folder.rglob("*.py")
    }


@cache
def _distribution(module: str) -> tuple[str, str] | None:
    """Name and version of the installed distribution that holds a module; None where there is none.

    Most bear the module's name. For the others (cv2, PIL, warp) the lists of files are searched, as text: the
    standard library's own table of all modules takes longer than the rest of a start.
    """
    from importlib import metadata

    try:
        found = metadata.distribution(module)
    except metadata.PackageNotFoundError:
        holds = (f"\n{module}/", f"\n{module}.py,")
        found = next(
            (d for d in metadata.distributions() if any(line in _files_in(d) for line in holds)), None
        )
    return None if found is None else (found.name, found.version)


def _files_in(distribution: "Distribution") -> str:
    return "\n" + (distribution.read_text("RECORD") or "")
