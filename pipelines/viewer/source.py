"""What a run folder has to show, the newest of it: finished models, or those that are being trained.

Only reads, and takes no lock: a run beside it is not disturbed. Stages' folders and checkpoints appear whole or not at
all; what is replaced while it is read cannot be read, and is looked for again.
"""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.run_folder.lock import is_held
from devrf.pipelines.run_folder.training_checkpoint import checkpoint_path
from devrf.pipelines.stamps.stamp import read_stamp, stamp_content, stamp_id
from devrf.pipelines.terminal.logs import EVENTS_FILE

if TYPE_CHECKING:  # they need torch
    from devrf.reconstruct.rendering.model import DynamicModel

TAIL_BYTES = 4096  # of events.jsonl: its last lines


@dataclass(frozen=True)
class Found:
    """Versions of what is there; None: not there.

    Attributes:
        scene: Cameras, pictures and points.
        rest, motion: Finished models that belong together.
        rest_training, motion_training: Checkpoints of trainings that replace them.
    """

    scene: str | None = None
    rest: str | None = None
    motion: str | None = None
    rest_training: int | None = None
    motion_training: int | None = None


@dataclass(frozen=True)
class Loaded:
    """What is shown.

    Attributes:
        found: What it was read from.
        scene: In the box frame; None where there is none yet.
        model: None where there is none yet.
    """

    found: Found = Found()
    scene: Scene | None = None
    model: "DynamicModel | None" = None


def look(run_dir: Path) -> Found:
    """What is there now. Beside a finished model only the training of a run at work counts."""
    scene, rest, motion = (stamp_id(run_dir / stage) for stage in ("scene", "canonical", "deformation"))
    if motion is not None and not _made_of(run_dir / "deformation", run_dir / "canonical"):
        motion = None
    working = is_held(run_dir)
    at_rest, in_motion = (
        _written(checkpoint_path(run_dir, stage)) if working or made is None else None
        for stage, made in (("canonical", rest), ("deformation", motion))
    )
    return Found(
        scene,
        rest,
        motion if at_rest is None else None,
        at_rest,
        in_motion if rest is not None and at_rest is None else None,
    )


def load(run_dir: Path, found: Found, device: str, before: Loaded) -> Loaded:
    """Read what was found; what cannot be read now stays as it was before.

    Raises:
        DevrfError: A file is damaged, or was replaced meanwhile.
    """
    if found.scene is None:
        return before
    try:
        scene = read_scene(run_dir / "scene")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DevrfError("scene-unreadable", f"{run_dir / 'scene'}: cannot be read ({error})") from None
    trained = found.rest is not None or found.rest_training is not None
    return Loaded(found, scene.in_box_frame(), _model(run_dir, found, device) if trained else None)


def progress(run_dir: Path) -> dict[str, Any]:
    """The last event of progress of the run's log; empty where there is none."""
    try:
        with (run_dir / EVENTS_FILE).open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read().splitlines()
    except OSError:
        return {}
    for line in reversed(lines):
        try:
            event = json.loads(line)
        except ValueError:  # the first is cut off, the last may be
            continue
        if isinstance(event, dict):
            return event if event.get("event") in ("progress", "stage_started") else {}
    return {}


def _model(run_dir: Path, found: Found, device: str) -> "DynamicModel":
    from devrf.reconstruct.rendering.model import DynamicModel
    from devrf.reconstruct.storage.model_io import FILE, load_model, load_rest
    from devrf.reconstruct.storage.unfinished import motion_in_training, rest_in_training

    if found.rest_training is not None:
        return DynamicModel(rest_in_training(checkpoint_path(run_dir, "canonical"), device))
    if found.motion_training is not None:
        rest = load_rest(run_dir / "canonical" / FILE, device)
        return DynamicModel(rest, motion_in_training(checkpoint_path(run_dir, "deformation"), device))
    model = load_model(run_dir, device)
    return model if found.motion is not None else replace(model, motion=None, in_motion=None, movers=None)


def _made_of(folder: Path, read: Path) -> bool:
    """Whether a stage was made of what another one holds now."""
    identity = (read_stamp(folder) or {}).get("identity", {})
    return identity.get("reads", {}).get(read.name) == stamp_content(read)


def _written(path: Path) -> int | None:
    """When a file was written, ns."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None
