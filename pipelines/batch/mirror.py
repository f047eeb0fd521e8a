"""What a batch sees of a scene whose stages lie in a store: their stamps, health and measures, and the report."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from devrf.capture.durable import write_json
from devrf.pipelines.batch.store import DamagedError, Store
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.stamp import HEALTH, STAMP, stamp_id

ALWAYS = (HEALTH, "metrics.json")
WHOLE = ("report",)  # what people open first


def mirror(
    store: Store, config: SceneConfig, scene_dir: Path, folder: Path, say: Callable[[str], None]
) -> None:
    """Bring a folder up to date with the store; stages are compared and judged there as in a run folder.

    Stamps name no files here, because there are none to be looked at. A stage that is damaged counts as not made.

    Args:
        store: The store.
        config: The scene.
        scene_dir: Folder of scene.yaml.
        folder: Its mirror; made where it is missing.
        say: Told what is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamps = store.stamps(config.folder_name, [stage.name for stage in STAGES])
    for stage in STAGES:
        here, stamp = folder / stage.name, stamps.get(stage.name)
        if stamp is not None and stamp_id(here) == stamp["id"]:
            continue
        shutil.rmtree(here, ignore_errors=True)
        if stamp is None:
            continue
        here.mkdir()
        try:
            store.get(config.folder_name, stage.name, stamp, here, None if stage.name in WHOLE else ALWAYS)
        except DamagedError as error:
            say(f"{config.name}: {stage.name} counts as not made: {error}")
            shutil.rmtree(here)
            continue
        places = {key: os.path.relpath(path, here) for key, path in stage.places(config, scene_dir).items()}
        write_json(here / STAMP, stamp | {"files": {}, "identity": stamp["identity"] | {"places": places}})
