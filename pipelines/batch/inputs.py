"""The raw files of a scene, by their content, and where they are to lie on another machine."""

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path

from devrf.capture.errors import InputError
from devrf.pipelines.batch.store import SizeAndDigest
from devrf.pipelines.config.files import input_paths
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.digests import Digests, raw_files

OUTSIDE = "outside"  # folder, in the copy of a scene, of files that lie outside of the scene's own folder


@dataclass
class Inputs:
    """Raw files of one scene.

    Attributes:
        files: Path relative to the scene's folder on another machine -> size and digest.
        overrides: `--set` of the keys whose files lie elsewhere there.
        here: Digest -> where the file lies on this machine.
    """

    files: dict[str, SizeAndDigest] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    here: dict[str, Path] = field(default_factory=dict)


def inputs_of(config: SceneConfig, scene: Path, digests: Digests) -> Inputs:
    """What a scene needs on another machine.

    Args:
        config: The scene.
        scene: Its scene.yaml.
        digests: Source of content digests.
    Raises:
        InputError: A file could not be found there by its path in scene.yaml.
    """
    found, scene_dir = Inputs(), scene.parent.resolve()
    _add(found, scene.resolve(), scene.name, digests)
    for key, text in input_paths(config).items():
        path = config.path(scene_dir, text)
        if path.is_relative_to(scene_dir):
            place = path.relative_to(scene_dir).as_posix()
        else:
            beside = hashlib.blake2b(str(path.parent).encode(), digest_size=4).hexdigest()
            place = f"{OUTSIDE}/{beside}/{path.name}"
        if place != text:  # absolute, or through a link, which does not come along
            found.overrides.append(f"{key}={json.dumps(place)}")
        _add(found, path, place, digests)
    known = set(found.here.values())
    for stage in STAGES:
        for name, path in stage.inputs(config, scene_dir).items():
            if path in known or not path.exists():
                continue
            place = Path(os.path.relpath(path, scene_dir))  # as it is asked for, a link or not
            if os.pardir in place.parts:
                raise InputError(
                    "file-outside-scene",
                    f"{scene}: {name} ({path}) lies outside of the scene's folder; with --store it has to be in it",
                )
            _add(found, path, place.as_posix(), digests)
    return found


def _add(found: Inputs, path: Path, place: str, digests: Digests) -> None:
    """A file, or all files of a folder."""
    files = raw_files(path) if path.is_dir() else [path]
    # one name for one file: no "./x"
    places = [(Path(place) / f.relative_to(path)).as_posix() for f in files]
    for file, where, digest in zip(files, places, digests.of_files(files), strict=True):
        found.files[where] = (file.stat().st_size, digest)
        found.here[digest] = file
