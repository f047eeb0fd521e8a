"""Models on disk: data only (safetensors), half precision, everything that rendering needs and nothing else.

`canonical/model.safetensors` holds the scene at rest and its surroundings, `deformation/model.safetensors` both
motion fields. Numbers that are not tensors stand in the file's metadata, as JSON under `devrf`.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from devrf.capture.errors import ReconstructError
from devrf.reconstruct.canonical import Canonical, ColourNet
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.ndc import Ndc
from devrf.reconstruct.shell import Shell
from devrf.reconstruct.train_canonical import RestModel

FILE = "model.safetensors"
FORMAT = 2
CANONICAL_NUMBERS = ("base_voxel", "stepsize", "shift", "alpha_threshold", "weight_threshold")


def save_rest(path: Path, model: RestModel) -> None:
    """Write the scene at rest."""
    canonical, shell, net = model.canonical, model.shell, model.canonical.net
    if not isinstance(net, ColourNet):
        raise ValueError("a coarse model without an MLP is not saved")
    tensors = {
        "canonical.aabb": canonical.aabb,
        "canonical.density": canonical.density.half(),
        "canonical.features": canonical.features.half(),
        "canonical.distance": canonical.distance,
        **{f"net.{name}": value for name, value in net.state_dict().items()},
    }
    meta: dict[str, Any] = {
        "kind": "rest",
        "canonical": {name: getattr(canonical, name) for name in CANONICAL_NUMBERS},
        "channels": canonical.features.shape[3],
        "mlp_width": net.hidden.out_features,
        "view_frequencies": net.frequencies,
        "ndc": asdict(canonical.ndc) if canonical.ndc is not None else None,
        "background": model.background,
        "near": model.near,
        "far": model.far,
    }
    if shell is not None:
        tensors |= {"shell.aabb": shell.aabb, "shell.grid": shell.grid.half()}
        meta["shell"] = {"final": shell.final, "near": shell.near, "far": shell.far}
    _save(path, tensors, meta)


def save_motion(path: Path, motion: MotionField) -> None:
    """Write both motion fields."""
    tensors = {
        "aabb": motion.aabb,
        "backward": motion.backward.half(),
        "forward": motion.forward.half(),
    }
    meta = {
        "kind": "motion",
        "t_first": motion.t_first,
        "t_last": motion.t_last,
        "rest_key": motion.rest_key,
    }
    _save(path, tensors, meta)


def load_rest(path: Path, device: str = "cpu") -> RestModel:
    """Read what `save_rest` wrote.

    Raises:
        ReconstructError: The file is missing, damaged, or holds something else.
    """
    tensors, meta = _load(path, "rest", device)
    net = ColourNet(meta["channels"], meta["mlp_width"], meta["view_frequencies"]).to(device)
    net.load_state_dict({k.removeprefix("net."): v for k, v in tensors.items() if k.startswith("net.")})
    for parameter in net.parameters():
        parameter.requires_grad_(False)
    canonical = Canonical(
        tensors["canonical.aabb"],
        tensors["canonical.density"].float(),
        tensors["canonical.features"].float(),
        net,
        ndc=Ndc(**meta["ndc"]) if meta["ndc"] is not None else None,
        **{name: float(meta["canonical"][name]) for name in CANONICAL_NUMBERS},
    )
    canonical.distance = tensors["canonical.distance"]
    shell = None
    if "shell" in meta:
        numbers = meta["shell"]
        shell = Shell(
            tensors["shell.aabb"],
            tensors["shell.grid"].float(),
            final=int(numbers["final"]),
            near=float(numbers["near"]),
            far=float(numbers["far"]),
        )
        shell.rebuild_occupancy()
    return RestModel(canonical, shell, meta["background"], float(meta["near"]), float(meta["far"]), {})


def load_motion(path: Path, device: str = "cpu") -> MotionField:
    """Read what `save_motion` wrote, for work on `device`; errors as `load_rest`."""
    tensors, meta = _load(path, "motion", "cpu")
    return MotionField(
        tensors["aabb"].cpu(),
        tensors["backward"].float(),
        tensors["forward"].float(),
        float(meta["t_first"]),
        float(meta["t_last"]),
        meta["rest_key"],
    ).stored(device)


def load_model(run_dir: Path, device: str = "cpu") -> DynamicModel:
    """The trained model of a run folder: with motion where that stage has run, else at rest."""
    motion = run_dir / "deformation" / FILE
    return DynamicModel(
        load_rest(run_dir / "canonical" / FILE, device),
        load_motion(motion, device) if motion.is_file() else None,
    )


def _save(path: Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    ready = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    save_file(ready, str(path), metadata={"devrf": json.dumps({"format": FORMAT, **meta})})


def _load(path: Path, kind: str, device: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if not path.is_file():
        raise ReconstructError(f"{path}: no model here; run the stage that makes it")
    try:
        with safe_open(str(path), framework="pt", device=device) as file:
            meta = json.loads((file.metadata() or {}).get("devrf", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise ReconstructError(
            f"{path}: cannot be read ({error}); delete it and run its stage again"
        ) from None
    if meta.get("format") != FORMAT or meta.get("kind") != kind:
        raise ReconstructError(
            f"{path}: holds {meta.get('kind', 'something else')}, format {meta.get('format')}; expected "
            f"{kind}, format {FORMAT}"
        )
    if not all(torch.isfinite(t).all() for t in tensors.values() if t.is_floating_point()):
        raise ReconstructError(f"{path}: holds values that are not finite; train again")
    return tensors, meta
