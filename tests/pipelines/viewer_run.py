"""The run folder of a small scene, as far as a run has come, for the tests of the viewer."""

import json
from pathlib import Path

from tests.make.models import UNIT_BOX, straight
from tests.reconstruct.conftest import TRAVEL

from devrf.capture.formats import write_scene
from devrf.capture.scene import Scene
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.storage.checkpoint import Checkpoint, Saved
from devrf.reconstruct.storage.model_io import FILE, save_motion, save_rest

SCENE_YAML = "name: ball <b>\noutput: run\npreset: tiny\ndataset: {format: devrf, path: data}\n"
KEYS = 5


class ViewerRun:
    """A run folder that fills, stage by stage."""

    def __init__(self, folder: Path) -> None:
        self.scene_yaml, self.run_dir = folder / "scene.yaml", folder / "run"
        self.scene_yaml.write_text(SCENE_YAML)
        self.run_dir.mkdir()

    def scene(self, scene: Scene) -> None:
        """Stage `scene`."""
        write_scene(self.run_dir / "scene", scene)
        self._stamp("scene")

    def rest_in_training(self, rest: RestModel) -> None:
        """A checkpoint of stage `canonical`."""
        canonical = rest.canonical
        tensors = {name: getattr(canonical, name) for name in ("density", "features", "distance")}
        tensors |= {f"net.{name}": value for name, value in canonical.net.state_dict().items()}
        numbers = {"model": rest.numbers() | {"aabb": canonical.aabb.tolist()}}
        Checkpoint(self.run_dir / ".canonical.safetensors").write(Saved(7, tensors, numbers))

    def rest(self, rest: RestModel) -> None:
        """Stage `canonical`."""
        (self.run_dir / "canonical").mkdir(exist_ok=True)
        save_rest(self.run_dir / "canonical" / FILE, rest)
        self._stamp("canonical")
        (self.run_dir / ".canonical.safetensors").unlink(missing_ok=True)

    def motion(self, rest: RestModel, made_of: str = "content of canonical") -> MotionField:
        """Stage `deformation`: the ball goes straight along its way."""
        motion = straight(UNIT_BOX, TRAVEL, KEYS, 6)
        (self.run_dir / "deformation").mkdir(exist_ok=True)
        save_motion(self.run_dir / "deformation" / FILE, motion, rest.canonical.voxel)
        self._stamp("deformation", {"canonical": made_of})
        return motion

    def health(self, stage: str, verdict: str, check: str) -> None:
        """A row of a stage's health."""
        row = {
            "code": "x",
            "check": check,
            "value": 3.0,
            "unit": "dB",
            "warn": 5.0,
            "fail": 4.0,
            "verdict": verdict,
        }
        text = json.dumps({"stage": stage, "rows": [row | {"remedy": "Film it again."}]})
        (self.run_dir / stage / "health.json").write_text(text)

    def _stamp(self, stage: str, reads: dict[str, str] | None = None) -> None:
        stamp = {"id": f"{stage} 1", "content": f"content of {stage}", "identity": {"reads": reads or {}}}
        (self.run_dir / stage / "stamp.json").write_text(json.dumps(stamp))
