"""What a batch sees of a scene whose stages lie in a store: their stamps, health and measures, and the report."""

import json
import os
import shutil
from pathlib import Path

from devrf.pipelines.batch.scenes import BatchScene
from devrf.pipelines.batch.store import Store
from devrf.pipelines.durable import write_json
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.stamp import HEALTH, STAMP, read_stamp

ALWAYS = (HEALTH, "metrics.json")
WHOLE = ("report",)  # what people open first


def mirror(store: Store, scene: BatchScene, name: str, folder: Path) -> None:
    """Bring a folder up to date with the store; stages are compared and judged there as in a run folder.

    Stamps name no files here, because there are none to be looked at.

    Args:
        store: The store.
        scene: The scene.
        name: What it is called there.
        folder: Its mirror.
    """
    for stage in STAGES:
        here = folder / stage.name
        stamp = store.stamp(name, stage.name)
        if stamp is None:
            shutil.rmtree(here, ignore_errors=True)
        elif (read_stamp(here) or {}).get("id") != stamp["id"]:
            shutil.rmtree(here, ignore_errors=True)
            here.mkdir(parents=True)
            store.get(name, stage.name, stamp, here, None if stage.name in WHOLE else ALWAYS)
            places = stage.places(scene.config, scene.scene_dir) if scene.config is not None else {}
            identity = json.loads(json.dumps(stamp["identity"]))
            identity["places"] = {key: os.path.relpath(path, here) for key, path in places.items()}
            write_json(here / STAMP, stamp | {"files": {}, "identity": identity})
