"""The scene of a run folder with the times that its motion was learned with."""

from pathlib import Path

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.durable import read_object
from devrf.pipelines.stamps.stamp import STAMP
from devrf.reconstruct.sampling.retimed import as_trained


def trained_scene(run_dir: Path) -> Scene:
    """As stage `scene` left it, in the world; where stage `deformation` moved clocks, with these."""
    stage = run_dir / "deformation"
    metrics = read_object(stage / "metrics.json") if (stage / STAMP).is_file() else {}
    return as_trained(read_scene(run_dir / "scene"), metrics)
