"""Which source files a stage depends on: those its module imports, followed through the domain folders.

The runner's own files (configuration, stamps, command line) are left out: they move results about, they
do not make them. Imports are read from the text, so nothing is imported.
"""

import ast
import hashlib
import re
from functools import cache
from pathlib import Path

ROOMS = ("capture", "calibration", "flow", "reconstruct")
RUNNER = (
    "stage",
    "health.rows",
    "runner",
    "stamp",
    "console",
    "status",
    "stages",
    "cli",
    "cli_options",
)
_DATA_FILE = re.compile(r"[\w-]+\.(css|js|html|json)")


def code_version(module: str) -> str:
    """Digest of the sources that a module (such as devrf.pipelines.stages.flow) needs."""
    digest = hashlib.blake2b(digest_size=16)
    for name, path in sorted(sources(module).items()):
        digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def sources(module: str) -> dict[str, Path]:
    """Module name -> file, of `module` and of all that it imports from the domain folders."""
    found: dict[str, Path] = {}
    todo = [module]
    while todo:
        name = todo.pop()
        path = _file(name)
        if path is None or name in found:
            continue
        found[name] = path
        for word in _names(path, path.stat().st_mtime_ns):
            if _counts(word):
                todo.append(word)
            elif _DATA_FILE.fullmatch(word) and (beside := path.parent / word).is_file():
                found[f"{name}:{word}"] = beside
    return found


def _counts(name: str) -> bool:
    parts = name.split(".")
    if len(parts) < 3 or parts[0] != "devrf":
        return False
    if parts[1] == "pipelines":
        return parts[2] != "config" and ".".join(parts[2:]) not in RUNNER
    return parts[1] in ROOMS


@cache
def _names(path: Path, mtime_ns: int) -> tuple[str, ...]:
    """Modules that a file may import (`from a import b` gives both a and a.b), and files it names."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if node.value.startswith("devrf.") or _DATA_FILE.fullmatch(node.value):
                names.append(node.value)  # a module that runs in a process of its own; a file beside this one
    return tuple(names)


def _file(module: str) -> Path | None:
    """The file of a devrf module. Its folder is where the room was imported from: editable or installed."""
    parts = module.split(".")
    folder = _room(parts[1])
    if folder is None:
        return None
    path = folder.joinpath(*parts[2:])
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


@cache
def _room(room: str) -> Path | None:
    beside = Path(__file__).resolve().parent.parent / room  # rooms lie beside one another in both layouts
    return beside if beside.is_dir() else None
