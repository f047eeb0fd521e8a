"""Stamps: what made a stage's folder, and whether it is whole.

A stamp holds the configuration values the stage depends on, content digests of the raw files among them (so touching,
renaming or moving a file changes nothing), the content of each stage it read (so a stage that was made again and came
out the same makes nothing else stale), the version of the program and of the libraries that worked, the code of the
rooms that the stage may import, and size and digest of every file it left. Times are for people; they decide nothing.
Nor do the device, Python's version or the machine: results differ by rounding there, and nobody wants to lose a night's
training to that.
"""

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import devrf
from devrf.capture.system.durable import parse_json
from devrf.capture.system.limits import is_device
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.code_version import Code, code_of, series
from devrf.pipelines.stamps.digests import Digests

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

STAMP = "stamp.json"
HEALTH = "health.json"
IN_ORDER = ("capture.cameras",)  # sections whose order counts: the first camera's clock is everyone's


def code_of_stage(stage: Stage, config: "SceneConfig") -> Code:
    """The code that makes a stage."""
    return code_of(stage.name, stage.rooms, stage.plug_ins(config))


def identity(
    stage: Stage,
    config: "SceneConfig",
    scene_dir: Path,
    run_dir: Path,
    reads: Iterable[str],
    digests: Digests,
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
    from devrf.pipelines.config.files import input_paths

    values: dict[str, Any] = {}
    paths = input_paths(config)
    whole = config.model_dump(mode="json")
    for key in stage.config_keys:
        for leaf, value in _leaves(whole, key):
            if leaf in paths:
                path = config.path(scene_dir, paths[leaf])
                value = {"content": digests.of(path) if path.exists() else None}
            values[leaf] = value
    inputs = {
        name: digests.of(path) for name, path in stage.inputs(config, scene_dir).items() if path.exists()
    }
    places = {
        name: os.path.relpath(path, run_dir / stage.name)
        for name, path in stage.places(config, scene_dir).items()
    }
    version_of = stamp_id if stage.quotes_stamps else stamp_content
    made = {name: version_of(run_dir / name) for name in reads}
    code = code_of_stage(stage, config)
    return {
        "config": values,
        "inputs": inputs,
        "places": places,
        "reads": made,
        "rooms": code.rooms,
        "libraries": {
            name: series(version) for name, version in {"devrf": devrf.__version__, **code.libraries}.items()
        },
    }


def identity_key(stage: str, made_from: dict) -> str:
    """One digest of an identity."""
    text = json.dumps([stage, made_from], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _leaves(whole: dict, dotted: str) -> list[tuple[str, Any]]:
    """Every value at or below a dotted key. Sections that are absent count as None."""
    value: Any = whole
    for part in dotted.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    found: list[tuple[str, Any]] = []

    def walk(key: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            if key in IN_ORDER:
                found.append((key, list(value)))
            for name, inner in value.items():
                walk(f"{key}.{name}", inner)
        else:
            found.append((key, value))

    walk(dotted, value)
    return found


def read_stamp(folder: Path) -> dict | None:
    """The stamp of a finished stage, or None."""
    try:
        return None if is_device(folder / STAMP) else parse_stamp((folder / STAMP).read_bytes())
    except OSError:
        return None


def parse_stamp(text: bytes) -> dict | None:
    """A stamp from its text; None where that is damaged."""
    try:
        stamp = parse_json(text)
    except ValueError:
        return None
    made_from = stamp.get("identity") if isinstance(stamp, dict) else None
    return stamp if isinstance(made_from, dict) else None


def stamp_id(folder: Path) -> str | None:
    """Name of one making of a stage: made again, it is another, even with the same content."""
    return (read_stamp(folder) or {}).get("id")


def stamp_content(folder: Path) -> str | None:
    """Digest of what a stage left for others to read."""
    return (read_stamp(folder) or {}).get("content")


def files_of(folder: Path, digests: Digests) -> dict[str, list]:
    """Relative name -> [size in bytes, digest] of all that a stage left, its health included."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / STAMP]
    contents = digests.of_files(paths)
    return {
        path.relative_to(folder).as_posix(): [path.stat().st_size, digest]
        for path, digest in zip(paths, contents, strict=True)
    }


def content_of(folder: Path, files: dict[str, list], places: dict[str, str], referred: Iterable[str]) -> str:
    """One digest of what a stage left for others to read: all but its health.

    Of files that it refers to instead of holding them the content counts, not the place: moved, they are the same.

    Args:
        folder: The stage's folder.
        files: What is in it (`files_of`).
        places: In its identity.
        referred: Digests of the files that it refers to.
    """
    content = hashlib.blake2b(digest_size=16)
    for name, (_, digest) in sorted(files.items()):
        if name == HEALTH:
            continue
        if places and name.endswith(".json"):
            digest = _without_places(folder / name, folder, places)
        content.update(f"{name}\0{digest}\0".encode())
    for digest in referred:
        content.update(f"{digest}\0".encode())
    return content.hexdigest()


def _without_places(path: Path, folder: Path, places: dict[str, str]) -> str:
    text = path.read_text(encoding="utf-8")
    for name, place in places.items():
        text = text.replace(Path(os.path.relpath(folder / place, path.parent)).as_posix(), f"<{name}>")
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def is_whole(stamp: dict) -> bool:
    """Whether a stamp names its making and its files; not so where it is damaged or of an earlier version."""
    files = stamp.get("files")
    return (
        isinstance(stamp.get("id"), str)
        and isinstance(files, dict)
        and all(isinstance(entry, list) and tuple(map(type, entry)) == (int, str) for entry in files.values())
    )


def damage(folder: Path, stamp: dict, digests: Digests) -> list[str]:
    """Files of a finished stage that are gone or have another content."""
    if not is_whole(stamp):
        return [f"{folder.name}/{STAMP} was changed"]
    bad, there = [], []
    for name, (size, digest) in stamp["files"].items():
        try:
            now = (folder / name).stat().st_size
        except (OSError, ValueError):  # a damaged name can hold what no system takes
            bad.append(f"{folder.name}/{name} is missing")
            continue
        if now != size:
            bad.append(f"{folder.name}/{name} was changed")
        else:
            there.append((name, digest))
    found = digests.of_files(folder / name for name, _ in there)
    bad += [
        f"{folder.name}/{name} was changed"
        for (name, digest), now in zip(there, found, strict=True)
        if now != digest
    ]
    return bad if len(bad) <= 3 else [*bad[:2], f"and {len(bad) - 2} more files of {folder.name}"]
