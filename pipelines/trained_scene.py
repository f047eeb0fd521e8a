"""The scene of a run folder with the times that its motion was learned with."""

import json
from pathlib import Path

from devrf.capture.formats.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.pipelines.stamps.stamp import STAMP
from devrf.reconstruct.as_trained import as_trained


def trained_scene(run_dir: Path) -> Scene:
    """As stage `scene` left it, in the world; where stage `deformation` moved clocks, with these."""
    stamp, metrics = (run_dir / "deformation" / name for name in (STAMP, "metrics.json"))
    trained = stamp.is_file() and metrics.is_file()
    return as_trained(read_scene(run_dir / "scene"), json.loads(metrics.read_text()) if trained else {})
