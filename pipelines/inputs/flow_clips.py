"""The clips whose flow is needed, whether it is there already, and who finds it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.scene import PosedFrame, Scene, by_camera
from devrf.flow.estimator import FlowEstimator, create_estimator

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig


def training_clips(scene: Scene) -> dict[str, list[PosedFrame]]:
    """The frames of each training camera, in order of time; test cameras need no flow."""
    clips = by_camera(frame for frame in scene.dynamic if frame.split == "train")
    return {camera: sorted(frames, key=time_of) for camera, frames in clips.items()}


def is_brought(clips: Mapping[str, Sequence[PosedFrame]]) -> bool:
    """Whether the data set has the flow of all pairs of its training cameras."""
    return bool(clips) and all(f.flow is not None for frames in clips.values() for f in frames[1:])


def time_of(frame: PosedFrame) -> float:
    """When it was taken: seconds, or the data set's time where it has no seconds."""
    return float(frame.time_s if frame.time_s is not None else frame.time or 0.0)


def flow_estimator(config: "SceneConfig", scene_dir: Path, device: str = "cpu") -> FlowEstimator:
    """The estimator that scene.yaml names."""
    weights = config.path(scene_dir, config.flow.weights) if config.flow.weights else None
    return create_estimator(config.flow.method, weights, device)
