"""Models that are being trained, from the checkpoints that their trainings leave: to be looked at, never changed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from devrf.capture.errors import ReconstructError
from devrf.reconstruct.canonical import NUMBERS, Canonical
from devrf.reconstruct.checkpoint import look_at
from devrf.reconstruct.model_io import net_of
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.ndc import Ndc
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.shell import Shell

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
    return _as_told(path, lambda: _motion(saved.numbers["motion"], saved.tensors).stored(device))


def _rest(meta: dict[str, Any], tensors: dict[str, Tensor]) -> RestModel:
    aabb = torch.tensor(meta["aabb"])
    canonical = Canonical(
        aabb,
        tensors["density"],
        tensors["features"],
        net_of(tensors, meta),
        deferred=bool(meta["deferred"]),
        ndc=Ndc(**meta["ndc"]) if meta["ndc"] is not None else None,
        **{name: float(meta["canonical"][name]) for name in NUMBERS},
    )
    canonical.distance = tensors["distance"]
    shell = None
    if "shell" in meta:
        numbers = meta["shell"]
        near, far = float(numbers["near"]), float(numbers["far"])
        shell = Shell(aabb, tensors["surround"], final=int(numbers["final"]), near=near, far=far)
        shell.distance = tensors["surround distance"]
    return RestModel(canonical, shell, meta["background"], float(meta["near"]), float(meta["far"]), {})


def _motion(meta: dict[str, Any], tensors: dict[str, Tensor]) -> MotionField:
    return MotionField(
        torch.tensor(meta["aabb"]),
        tensors["backward"],
        tensors["forward"],
        float(meta["t_first"]),
        float(meta["t_last"]),
        meta["rest_key"],
    )


def _as_told(path: Path, make: Callable[[], T]) -> T:
    """What is made of a checkpoint; of another kind, or of an older program, it lacks something."""
    try:
        return make()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ReconstructError("checkpoint-without-model", f"{path}: no model to look at ({error})") from None
