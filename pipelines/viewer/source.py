"""What a run folder has to show, the newest of it: finished models, or those that are being trained.

Only reads, and takes no lock: a run beside it is not disturbed. Stages' folders and checkpoints appear whole or not at
all; what is replaced while it is read cannot be read, and is looked for again.
"""

import json
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.run_folder.lock import is_held
from devrf.pipelines.run_folder.training_checkpoint import checkpoint_path
from devrf.pipelines.stamps.stamp import read_stamp, stamp_content, stamp_id
from devrf.pipelines.terminal.logs import EVENTS_FILE
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.storage.model_io import FILE, load_model, load_rest
from devrf.reconstruct.storage.unfinished import motion_in_training, rest_in_training

TAIL_BYTES = 4096  # of events.jsonl: its last lines
CHUNK_CPU = 1 << 12  # rays between two looks at what is wanted


@dataclass(frozen=True)
class RunVersions:
    """Versions of what is there; None: not there.

    Attributes:
        scene: Cameras, pictures and points.
        rest, motion: Finished models that belong together.
        training: The stage whose training is shown instead of its model, and when its checkpoint was written, ns.
    """

    scene: str | None = None
    rest: str | None = None
    motion: str | None = None
    training: tuple[str, int] | None = None


@dataclass(frozen=True)
class Loaded:
    """What is shown.

    Attributes:
        found: What it was read from.
        scene: In the box frame; None where there is none yet.
        model: None where there is none yet.
    """

    found: RunVersions = RunVersions()
    scene: Scene | None = None
    model: DynamicModel | None = None


def look(run_dir: Path) -> RunVersions:
    """What is there now. Beside a finished model only the training of a run at work counts."""
    scene, rest, motion = (stamp_id(run_dir / stage) for stage in ("scene", "canonical", "deformation"))
    made_of = (read_stamp(run_dir / "deformation") or {}).get("identity", {}).get("reads", {})
    if made_of.get("canonical") != stamp_content(run_dir / "canonical"):
        motion = None
    working = is_held(run_dir)
    for stage, made in (("canonical", rest), ("deformation", motion)):
        checkpoint = checkpoint_path(run_dir, stage)
        if (working or made is None) and checkpoint.is_file():
            return RunVersions(scene, rest, None, (stage, checkpoint.stat().st_mtime_ns))
        if made is None:
            break
    return RunVersions(scene, rest, motion)


def load(run_dir: Path, found: RunVersions, device: str) -> Loaded:
    """Read what was found.

    Raises:
        DevrfError: A file is damaged, or was replaced meanwhile.
    """
    if found.scene is None:
        return Loaded()
    try:
        scene = read_scene(run_dir / "scene").in_box_frame()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DevrfError("scene-unreadable", f"{run_dir / 'scene'}: cannot be read ({error})") from None
    training, model = found.training, None
    if training is not None and training[0] == "canonical":
        model = DynamicModel(rest_in_training(checkpoint_path(run_dir, "canonical"), device))
    elif training is not None:
        rest = load_rest(run_dir / "canonical" / FILE, device)
        model = DynamicModel(rest, motion_in_training(checkpoint_path(run_dir, "deformation"), device))
    elif found.rest is not None:
        model = load_model(run_dir, device)
        if found.motion is None:
            model = replace(model, motion=None, in_motion=None, movers=None)
    if model is not None and device == "cpu":
        model.chunk = min(model.chunk, CHUNK_CPU)
    return Loaded(found, scene, model)


def progress(run_dir: Path) -> dict[str, Any]:
    """The last event of progress of the run's log; empty where there is none."""
    try:
        with (run_dir / EVENTS_FILE).open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read().splitlines()
    except OSError:
        return {}
    for line in reversed(lines):
        with suppress(ValueError, AttributeError):  # the first is cut off, the last may be
            event = json.loads(line)
            return event if event.get("event") in ("progress", "stage_started") else {}
    return {}
