"""Stamps: what made a stage's folder, and why it would have to be made again.

A stamp holds the configuration values the stage depends on, content digests of the raw files among them
(so touching, renaming or moving a file changes nothing), the identity of each stage it read, the version of
the code, and the size of every file it left. Times are for people; they decide nothing.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from devrf.pipelines.code_version import code_version
from devrf.pipelines.config.files import input_paths
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import LOG_FILE
from devrf.pipelines.stage import Stage

STAMP = "stamp.json"
HEALTH = "health.json"
DIGESTS = ".digests.json"  # content digests already taken, by size and time of change
OWN = (STAMP, HEALTH)  # written by the runner; not part of what the stage left


class Digests:
    """Content digests of raw files, remembered in the run folder by size and modification time.

    Reading gigabytes again to learn that nothing changed would make a run that does nothing slow. A file
    whose size or time differs is read again; only its content counts.
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / DIGESTS
        try:
            self._known: dict[str, list] = json.loads(self._path.read_text())
        except (OSError, ValueError):
            self._known = {}
        self._new: dict[str, list] = {}

    def of(self, path: Path) -> str:
        """Digest of a file's content, or of the names and contents of all files in a folder.

        Run folders inside it are left out: a run that lies in its own data set must not make itself stale.
        """
        if path.is_dir():
            digest = hashlib.blake2b(digest_size=16)
            for file in sorted(_raw_files(path)):
                digest.update(f"{file.relative_to(path).as_posix()}\0{self._of_file(file)}\0".encode())
            return digest.hexdigest()
        return self._of_file(path)

    def _of_file(self, path: Path) -> str:
        stat = path.stat()
        key, seen = str(path), [stat.st_size, stat.st_mtime_ns]
        known = self._new.get(key) or self._known.get(key)
        if known is None or known[:2] != seen:
            with path.open("rb") as file:
                digest = _file_digest(file)
            known = [*seen, digest]
        self._new[key] = known
        return known[2]

    def save(self) -> None:
        """Remember for the next run; a run folder that cannot be written only costs time."""
        if self._new and any(self._known.get(key) != value for key, value in self._new.items()):
            try:
                write_json(self._path, self._known | self._new)
            except OSError:
                pass


def _raw_files(folder: Path) -> Iterator[Path]:
    """All files below a folder but those of run folders, which are known by their log."""
    for root, folders, files in os.walk(folder):
        here = Path(root)
        folders[:] = [name for name in folders if not (here / name / LOG_FILE).is_file()]
        yield from (file for name in files if (file := here / name).is_file())


def _file_digest(file: Any) -> str:
    digest = hashlib.blake2b(digest_size=16)
    while block := file.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


def identity(
    stage: Stage, config: SceneConfig, scene_dir: Path, run_dir: Path, reads: Iterable[str], digests: Digests
) -> dict:
    """What a stage's result depends on, as far as it can be known now.

    Args:
        stage: The stage.
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        run_dir: The run folder; stages it reads may or may not have been made.
        reads: Names of the stages it reads that apply to this configuration.
        digests: Source of content digests.
    """
    values: dict[str, Any] = {}
    paths = input_paths(config)
    whole = config.model_dump(mode="json")
    for key in stage.config_keys:
        for leaf, value in _leaves(whole, key):
            if leaf in paths:
                path = config.path(scene_dir, paths[leaf])
                value = {"content": digests.of(path) if path.exists() else None}
            values[leaf] = value
    extra = {
        os.path.relpath(path, scene_dir): digests.of(path)
        for path in stage.inputs(config, scene_dir)
        if path.exists()
    }
    return {
        "config": values,
        "inputs": extra,
        "reads": {name: stamp_id(run_dir / name) for name in reads},
        "code": code_version(f"devrf.pipelines.stages.{stage.name}"),
    }


def _leaves(whole: dict, dotted: str) -> list[tuple[str, Any]]:
    """Every value at or below a dotted key. Sections that are absent count as None."""
    value: Any = whole
    for part in dotted.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    found: list[tuple[str, Any]] = []

    def walk(key: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            for name, inner in value.items():
                walk(f"{key}.{name}", inner)
        else:
            found.append((key, value))

    walk(dotted, value)
    return found


def read_stamp(folder: Path) -> dict | None:
    """The stamp of a finished stage, or None."""
    try:
        stamp = json.loads((folder / STAMP).read_text())
    except (OSError, ValueError):
        return None
    return stamp if isinstance(stamp, dict) and "identity" in stamp else None


def stamp_id(folder: Path) -> str | None:
    """Identity of one making of a stage: made again, it is another, even from the same inputs."""
    stamp = read_stamp(folder)
    return None if stamp is None else stamp.get("id")


def why_stale(folder: Path, now: dict) -> list[str]:
    """Reasons why a stage's folder does not fit; empty where it does.

    Args:
        folder: The stage's folder.
        now: What it would be made from now (`identity`).
    """
    stamp = read_stamp(folder)
    if stamp is None:
        return ["never finished"]
    then = stamp["identity"]
    reasons = []
    for key in sorted({*then["config"], *now["config"]}):
        old, new = then["config"].get(key), now["config"].get(key)
        if old != new:
            reasons.append(f"{key}: {_change(old, new)}")
    for name in sorted({*then["inputs"], *now["inputs"]}):
        if then["inputs"].get(name) != now["inputs"].get(name):
            reasons.append(f"{name} changed")
    reasons += [
        f"{name} was made again" for name, made in now["reads"].items() if then["reads"].get(name) != made
    ]
    reasons += [f"{name} no longer applies" for name in then["reads"] if name not in now["reads"]]
    if then["code"] != now["code"]:
        reasons.append("the code changed")
    reasons += damage(folder, stamp)
    return reasons


def _change(old: Any, new: Any) -> str:
    """What happened to a key, in words. Values are those of `identity`, None where there is none."""
    was_file, is_file = (isinstance(value, dict) and value.get("content") is not None for value in (old, new))
    if was_file or is_file:
        return "content changed" if was_file and is_file else "newly given" if is_file else "no longer given"
    if old == {} or new == {}:  # what came or went stands at keys of its own
        return "no longer empty" if old == {} else "now empty"
    if old is None or new is None:
        return f"was not set, is now {new}" if old is None else f"was {old}, is no longer set"
    return f"{old} is now {new}"


def damage(folder: Path, stamp: dict) -> list[str]:
    """Files of a finished stage that are gone or have another size."""
    bad = []
    for name, size in stamp.get("files", {}).items():
        try:
            now = (folder / name).stat().st_size
        except OSError:
            now = None
        if now != size:
            bad.append(f"{folder.name}/{name} {'is missing' if now is None else 'was changed'}")
    return bad if len(bad) <= 3 else [*bad[:2], f"and {len(bad) - 2} more files of {folder.name}"]


def files_of(folder: Path) -> dict[str, int]:
    """Relative name -> size in bytes of all that a stage left."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        p.relative_to(folder).as_posix(): p.stat().st_size
        for p in files
        if p.name not in OWN or p.parent != folder
    }


def write_json(path: Path, value: Any) -> None:
    """Write a file whole or not at all, and make it durable."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(value, file, indent=1, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
