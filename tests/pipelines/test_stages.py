"""The list of stages agrees with the contract, with the configuration and with what each stage does."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.formats import read_dataset
from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import ReconstructConfig, SceneConfig
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.stage import Stage
from devrf.pipelines.stages import STAGES, stage_names

CONTRACT = (
    "ingest static_poses sync rig colour scene flow canonical deformation evaluate render report".split()  # noqa: SIM905
)
BY_NAME = {stage.name: stage for stage in STAGES}


def config(**keys: object) -> SceneConfig:
    return SceneConfig.model_validate({"name": "x"} | keys)


SWEEP = config(capture={"static": "s.mp4"})
CAMERAS = config(capture={"cameras": {"a": "a.mp4"}})
DYNAMIC = config(capture={"static": "s.mp4", "cameras": {"a": "a.mp4"}})
DATASET = config(dataset={"format": "devrf", "path": "d"})
AT_REST = config(dataset={"format": "blender", "path": "d"})


def applying(scene: SceneConfig) -> list[str]:
    return [stage.name for stage in STAGES if stage.applies(scene) is None]


def test_order_is_the_contract() -> None:
    assert list(stage_names()) == CONTRACT


def test_every_stage_reads_only_what_was_made_before() -> None:
    made: set[str] = set()
    for stage in STAGES:
        assert set(stage.reads) <= made, stage.name
        made.add(stage.name)


def test_what_applies() -> None:
    assert applying(DYNAMIC) == CONTRACT
    rest = [name for name in CONTRACT if name not in ("sync", "rig", "flow", "deformation")]
    assert applying(SWEEP) == rest
    assert applying(CAMERAS) == ["ingest", "sync", "rig", "colour", "scene", "flow"]
    assert applying(DATASET) == CONTRACT[5:]
    assert applying(AT_REST) == ["scene", "canonical", "evaluate", "render", "report"]
    for scene in (SWEEP, CAMERAS, DATASET, AT_REST):
        assert all(stage.applies(scene) is None or len(str(stage.applies(scene))) > 10 for stage in STAGES)


@pytest.mark.parametrize("stage", STAGES, ids=stage_names())
def test_config_keys_exist(stage: Stage) -> None:
    for key in stage.config_keys:
        model = SceneConfig
        for part in key.split("."):
            assert part in model.model_fields, key
            kinds = [model.model_fields[part].annotation]
            kinds += list(getattr(kinds[0], "__args__", ()))
            model = next(
                (k for k in kinds if isinstance(k, type) and hasattr(k, "model_fields")), SceneConfig
            )


def at_rest(forward: bool = False) -> Scene:
    """A scene of one picture; seen from one side it is modelled in normalised device coordinates."""
    frame = PosedFrame(Path("p.png"), Camera(8, 8, np.eye(3), np.eye(3, 4)), "static", 0, None, None, "train")
    box, ndc = np.array([[-1.0, -1, -1], [1, 1, 1]]), (1.0, 1.0) if forward else None
    return scene_of((frame,), aabb=box, near=0.0, far=1.0, background="white", rest_time=None, ndc=ndc)


@pytest.mark.parametrize("forward", [False, True])
@pytest.mark.parametrize("key", sorted(ReconstructConfig.model_fields))
def test_the_scene_at_rest_depends_on_the_keys_it_declares(key: str, forward: bool) -> None:
    """And on no other: hours of training must not be done again for a key of the motion."""
    values: dict[str, object] = {"image_scale": 0.37, "adapt": False, "motion": "auto"}
    scene = at_rest(forward)

    def rest(**changed: object) -> object:
        chosen = config(dataset={"format": "devrf", "path": "d"}, reconstruct=changed)
        return training_options(chosen, scene).canonical

    changes = rest(**{key: values.get(key, 77)}) != rest()
    assert changes == (f"reconstruct.{key}" in BY_NAME["canonical"].config_keys)


@pytest.mark.parametrize(
    ("times", "at_rest"),
    [
        ([None, None, None, None], True),
        ([None, None, 0.0, 1.0], False),
        ([None, None, None, 0.5], True),  # the last is a test picture
        ([0.0, 0.0, 0.0, 0.0], True),  # of one moment
    ],
)
def test_motion_needs_training_pictures_with_times(tmp_path: Path, times: list, at_rest: bool) -> None:
    pose = np.eye(4)
    entries = []
    for n, time in enumerate(times):
        pose[0, 3] = n
        entries.append({"file_path": f"{n}.png", "transform_matrix": pose.tolist(), "time": time})
        Image.new("RGB", (8, 8)).save(tmp_path / f"{n}.png")
    meta = {"fl_x": 8.0, "frames": entries, "test_filenames": ["3.png"]}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    (tmp_path / "scene.yaml").write_text("name: x\ndataset: {format: nerfstudio, path: .}\n")
    loaded = load_scene(tmp_path / "scene.yaml")
    motion = ["flow", "deformation"]
    assert applying(loaded) == [name for name in CONTRACT[5:] if not (at_rest and name in motion)]
    notes: list[str] = []
    scene = read_dataset("nerfstudio", tmp_path, notes=notes)
    assert bool(scene.dynamic) is not at_rest
    said = ["1"] * times.count(0.5) + ["every"] * (
        times.count(0.0) == 4
    )  # how many are left out, or are at rest
    assert [note.split()[0] for note in notes] == said
