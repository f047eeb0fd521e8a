"""Models that are being trained, from the checkpoints that their trainings leave: to be looked at, never changed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.storage.checkpoint import look_at
from devrf.reconstruct.storage.model_io import motion_of, rest_of, shell_of

REST_PARTS = ("density", "features", "distance", "surround", "surround distance")
MOTION_PARTS = ("backward", "forward")

T = TypeVar("T")


def rest_in_training(path: Path, device: str = "cpu") -> RestModel:
    """The scene at rest as a checkpoint of stage 1 has it.

    Raises:
        ReconstructError: No checkpoint of such a training is there; it may have ended.
    """
    saved = look_at(path, device, lambda name: name in REST_PARTS or name.startswith("net."))
    return _as_told(path, lambda: _rest(saved.numbers["model"], saved.tensors))


def motion_in_training(path: Path, device: str = "cpu") -> MotionField:
    """The motion as a checkpoint of stage 2 has it; errors as `rest_in_training`."""
    saved = look_at(path, "cpu", MOTION_PARTS.__contains__)

    def told() -> MotionField:
        meta, fields = saved.numbers["motion"], (saved.tensors[name] for name in MOTION_PARTS)
        return motion_of(meta, torch.tensor(meta["aabb"]), *fields).stored(device)

    return _as_told(path, told)


def _rest(meta: dict[str, Any], tensors: dict[str, Tensor]) -> RestModel:
    aabb = torch.tensor(meta["aabb"])
    model = rest_of(meta, tensors, aabb, tensors["density"], tensors["features"])
    model.canonical.distance = tensors["distance"]
    if "shell" in meta:
        model.shell = shell_of(meta, aabb, tensors["surround"])
        model.shell.distance = tensors["surround distance"]
    return model


def _as_told(path: Path, make: Callable[[], T]) -> T:
    """What is made of a checkpoint; of another kind, or of an older program, it lacks something."""
    try:
        return make()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ReconstructError(
            "checkpoint-without-model", f"{path}: the checkpoint holds no usable model ({error})"
        ) from None
