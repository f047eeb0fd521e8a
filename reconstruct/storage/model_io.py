"""Models on disk: data only (safetensors), everything that rendering needs and nothing else.

`canonical/model.safetensors` holds the scene at rest and its surroundings, `deformation/model.safetensors` both
motion fields, or movers and what stands beside them (that only where it differs from the scene at rest). Only vertices
that samples can touch are kept; densities are in half precision, colours in bytes, motion is true to a fortieth of a
voxel at rest (`packing.py`). Numbers that are not tensors stand in the file's metadata, as JSON under `devrf`.
"""

import copy
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from scipy.spatial.transform import Rotation
from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.fields.canonical import EMPTY, NUMBERS, Canonical, ColourNet
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.contracted_background import Shell
from devrf.reconstruct.fields.grids import grown
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import UPPER, Movers, symmetric
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.fields.shading import Shading
from devrf.reconstruct.kernels.background import Contraction
from devrf.reconstruct.kernels.occupancy import distance
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.storage.packing import (
    bits_of,
    field_from_stream,
    field_to_stream,
    from_bytes,
    mask_of,
    to_bytes,
)
from devrf.reconstruct.storage.tensor_file import save_tensors

FILE = "model.safetensors"
TUNED_FILE = "fine_tuned.safetensors"  # the scene at rest as it looks in motion
FORMAT = 6
BYTES, STREAM = ("codes", "low", "step"), ("stream", "ends")
MOTION_STEP = 0.05  # voxels of the scene at rest
SHADING_STEP = 0.005  # of the logarithm of a factor on brightness: about one level of 8 bits


def save_rest(path: Path, model: RestModel) -> None:
    """Write the scene at rest."""
    meta = {"kind": "rest", **model.numbers()}
    canonical, shell, net = model.canonical, model.shell, model.canonical.net
    tensors = {
        "canonical.aabb": canonical.aabb,
        **_kept(
            "canonical", canonical.distance == 0, canonical.reachable(), canonical.density, canonical.features
        ),
        **{f"net.{name}": value for name, value in net.state_dict().items()},
    }
    if shell is not None:
        density, colour = shell.grid[..., :1], shell.grid[..., 1:]
        tensors["shell.aabb"] = shell.aabb
        tensors["shell.points"] = shell.points.half()
        tensors |= _kept("shell", shell.distance == 0, shell.reachable(), density, colour)
    _save(path, tensors, meta)


def save_motion(path: Path, motion: MotionField, voxel: float) -> None:
    """Write both motion fields, to a fortieth of a `voxel` of the scene at rest."""
    tensors, step = {"aabb": motion.aabb}, MOTION_STEP * voxel
    for name, field in (("backward", motion.backward), ("forward", motion.forward)):
        tensors |= {f"{name}.{part}": value for part, value in field_to_stream(field, step).items()}
    meta = {"kind": "motion", "shape": motion.backward.shape[:4], "step": step, **motion.numbers()}
    _save(path, tensors, meta)


def save_movers(path: Path, model: DynamicModel) -> None:
    """Write movers, and what stands where it is another than at rest."""
    assert model.movers is not None and model.in_motion is not None and model.motion is not None
    rest, stands, movers = model.rest.canonical, model.in_motion.canonical, model.movers
    own, labelled = movers.canonical, movers.labels > 0
    other = (stands.density != rest.density)[..., 0] | (stands.features != rest.features).any(-1)
    turns = Rotation.from_matrix(movers.rotations.reshape(-1, 3, 3).numpy()).as_rotvec()
    tensors = {
        **_kept("movers", own.distance == 0, own.reachable(), own.density, own.features),
        "movers.labelled": bits_of(labelled),
        "movers.labels": movers.labels[labelled],
        "movers.times": movers.times,
        "movers.turns": torch.from_numpy(turns.reshape(*movers.shifts.shape)).float(),
        "movers.shifts": movers.shifts,
        **_kept("stands", stands.distance == 0, other, stands.density, stands.features),
        "stands.other": bits_of(other),
        **{f"net.{name}": value for name, value in own.net.state_dict().items()},
    }
    meta: dict[str, Any] = {
        "kind": "movers",
        "shape": rest.shape,
        "keys": model.motion.keys,
        "rest_time": model.motion.key_times[model.motion.rest_key or 0],
    }
    if movers.stretches is not None:
        tensors["movers.stretches"] = movers.stretches[:, :, UPPER[0], UPPER[1]]
    if movers.shading is not None:
        light = movers.shading
        meta["shading"] = {"t_first": light.t_first, "t_last": light.t_last, "shape": light.grid.shape[1:]}
        packed = field_to_stream(light.grid.detach().permute(1, 2, 3, 4, 0), SHADING_STEP)
        tensors |= {f"shading.{part}": x for part, x in packed.items()}
    _save(path, tensors, meta)


def load_movers(path: Path, rest: RestModel, device: str = "cpu") -> DynamicModel:
    """Read what `save_movers` wrote; `rest` is the scene at rest that they were found in. Errors as `load_rest`."""
    tensors, meta = _load(path, "movers", device)
    with _damage_named(path):
        X, Y, Z = meta["shape"]
        if (X, Y, Z) != rest.canonical.shape:
            raise ValueError(f"voxels {X} x {Y} x {Z}, the scene at rest has {rest.canonical.shape}")
        net = _rest_net(tensors, rest)

        def mask(name: str) -> Bool[Tensor, "X Y Z"]:
            return mask_of(tensors[name].cpu(), (X, Y, Z)).to(device)

        own, stands = copy.copy(rest.canonical), copy.copy(rest.canonical)
        own.net = stands.net = net
        occupied = mask("movers.occupied")
        own.density, own.features = _spread("movers", tensors, grown(occupied))
        own.distance, stands.distance = distance(occupied), distance(mask("stands.occupied"))
        other = mask("stands.other")
        density, features = _spread("stands", tensors, other)
        stands.density = torch.where(other[..., None], density, rest.canonical.density)
        stands.features = torch.where(other[..., None], features, rest.canonical.features)
        labels = torch.zeros(X, Y, Z, dtype=torch.uint8, device=device)
        labels[mask("movers.labelled")] = tensors["movers.labels"]
        turns = tensors["movers.turns"].cpu()
        rotations = Rotation.from_rotvec(turns.reshape(-1, 3).numpy()).as_matrix().reshape(*turns.shape, 3)
        light = None
        if "shading" in meta:
            told = meta["shading"]
            T, A, B, C = told["shape"]
            packed = {part: tensor.cpu() for part, tensor in _parts("shading", tensors, STREAM).items()}
            grid = field_from_stream(packed, (T, A, B, C), SHADING_STEP, 2).permute(4, 0, 1, 2, 3)
            light = Shading(
                own.aabb, float(told["t_first"]), float(told["t_last"]), grid.contiguous().to(device)
            )
            light.requires_grad_(False)
        movers = Movers(
            own,
            labels,
            tensors["movers.times"].cpu(),
            torch.from_numpy(rotations).float(),
            tensors["movers.shifts"].cpu(),
            light,
            symmetric(tensors["movers.stretches"].cpu()) if "movers.stretches" in tensors else None,
        )
        keys, rest_time = int(meta["keys"]), float(meta["rest_time"])
        still = replace(rest, canonical=stands, shell=None, metrics={})
        return DynamicModel.of_movers(rest, still, movers, keys, rest_time)


def save_deformation(folder: Path, model: DynamicModel) -> list[Path]:
    """Write what stage 2 leaves; returns the files."""
    files = [folder / FILE]
    if model.movers is not None:
        save_movers(files[0], model)
        return files
    assert model.motion is not None
    save_motion(files[0], model.motion, model.rest.canonical.voxel)
    if model.in_motion is not None:
        files.append(folder / TUNED_FILE)
        save_rest(files[1], model.in_motion)
    return files


def load_rest(path: Path, device: str = "cpu") -> RestModel:
    """Read what `save_rest` wrote.

    Raises:
        ReconstructError: The file is missing, damaged, or holds something else.
    """
    tensors, meta = _load(path, "rest", device)
    with _damage_named(path):
        return _rest(tensors, meta, device)


def load_motion(path: Path, device: str = "cpu") -> MotionField:
    """Read what `save_motion` wrote, for work on `device`; errors as `load_rest`."""
    tensors, meta = _load(path, "motion", "cpu")
    with _damage_named(path):
        (T, X, Y, Z), step = meta["shape"], float(meta["step"])
        fields = (
            field_from_stream(_parts(name, tensors, STREAM), (T, X, Y, Z), step)
            for name in ("backward", "forward")
        )
        return motion_of(meta, tensors["aabb"].cpu(), *fields).stored(device)


def load_model(run_dir: Path, device: str = "cpu") -> DynamicModel:
    """The trained model of a run folder: with motion where that stage has run, else at rest."""
    rest = load_rest(run_dir / "canonical" / FILE, device)
    return load_deformation(run_dir / "deformation", rest, device)


def load_deformation(folder: Path, rest: RestModel, device: str = "cpu") -> DynamicModel:
    """What `save_deformation` wrote, beside the scene at rest; that alone where nothing was."""
    motion, tuned = folder / FILE, folder / TUNED_FILE
    if not motion.is_file():
        return DynamicModel(rest)
    if _kind(motion) == "movers":
        return load_movers(motion, rest, device)
    in_motion = load_rest(tuned, device) if tuned.is_file() else None
    return DynamicModel(rest, load_motion(motion, device), in_motion)


def _rest(tensors: dict[str, Tensor], meta: dict[str, Any], device: str) -> RestModel:
    X, Y, Z = meta["shape"]
    occupied = mask_of(tensors["canonical.occupied"].cpu(), (X, Y, Z)).to(device)
    grids = _spread("canonical", tensors, grown(occupied))
    model = rest_of(meta, tensors, tensors["canonical.aabb"], *grids)
    model.canonical.distance = distance(occupied)
    if "shell" in meta:
        N = int(meta["shell"]["size"])
        occupied = mask_of(tensors["shell.occupied"].cpu(), (N, N, N)).to(device)
        grid = torch.empty(N, N, N, 4, device=device)
        shell = shell_of(meta, tensors["shell.aabb"], grid, tensors.get("shell.points"))
        shell.distance = distance(occupied)
        shell.grid = torch.cat(_spread("shell", tensors, shell.reachable()), dim=-1)
        model.shell = shell
    return model


def rest_of(
    meta: dict[str, Any], tensors: dict[str, Tensor], aabb: Tensor, density: Tensor, features: Tensor
) -> RestModel:
    """The scene at rest by its `RestModel.numbers`, grids and the MLP among tensors; without surroundings."""
    canonical = Canonical(
        aabb,
        density,
        features,
        _net(tensors, meta),
        deferred=bool(meta["deferred"]),
        ndc=Ndc(**meta["ndc"]) if meta["ndc"] is not None else None,
        **{name: float(meta["canonical"][name]) for name in NUMBERS},
    )
    return RestModel(canonical, None, meta["background"], float(meta["near"]), float(meta["far"]), {})


def shell_of(meta: dict[str, Any], aabb: Tensor, grid: Tensor, points: Tensor | None = None) -> Shell:
    """Its surroundings; files of before have no points, and their space is not bent."""
    final, near, reach = (meta["shell"][name] for name in ("final", "near", "reach"))
    contraction = Contraction(float(reach), float(meta["shell"].get("bend", 1.0)))
    known = torch.zeros(0, 3) if points is None else points
    return Shell(aabb, grid, int(final), float(near), contraction, points=known)


def motion_of(meta: dict[str, Any], aabb: Tensor, backward: Tensor, forward: Tensor) -> MotionField:
    """Motion by its `MotionField.numbers` and fields."""
    return MotionField(
        aabb, backward, forward, float(meta["t_first"]), float(meta["t_last"]), meta["rest_key"]
    )


def _rest_net(tensors: dict[str, Tensor], rest: RestModel) -> ColourNet:
    """The MLP among a file's tensors, of the size of that of the scene at rest."""
    meta = rest.numbers()
    return _net(tensors, {name: meta[name] for name in ("channels", "mlp_width", "view_frequencies")})


def _net(tensors: dict[str, Tensor], meta: dict[str, Any]) -> ColourNet:
    """The MLP among a file's tensors, not to be trained."""
    with torch.device("meta"):  # no memory by what the file says, before its tensors are known to fit
        net = ColourNet(meta["channels"], meta["mlp_width"], meta["view_frequencies"])
    weights = {k.removeprefix("net."): v for k, v in tensors.items() if k.startswith("net.")}
    net.load_state_dict(weights, assign=True)
    for parameter in net.parameters():
        parameter.requires_grad_(False)
    return net


def _kept(
    name: str,
    occupied: Bool[Tensor, "X Y Z"],
    kept: Bool[Tensor, "X Y Z"],
    density: Float[Tensor, "X Y Z 1"],
    colour: Float[Tensor, "X Y Z C"],
) -> dict[str, Tensor]:
    """Tensors of a grid: which vertices are occupied, and the values that can be touched from there."""
    parts = {f"{name}.{part}": value for part, value in to_bytes(colour[kept]).items()}
    return parts | {f"{name}.occupied": bits_of(occupied), f"{name}.density": density[kept].half()}


def _spread(
    name: str, tensors: dict[str, Tensor], kept: Bool[Tensor, "X Y Z"]
) -> tuple[Float[Tensor, "X Y Z 1"], Float[Tensor, "X Y Z C"]]:
    """Density and colour of a whole grid, empty where nothing was kept."""
    colour = from_bytes(_parts(name, tensors, BYTES))
    density = torch.full((*kept.shape, 1), EMPTY, device=kept.device)
    density[kept] = tensors[f"{name}.density"].float()
    whole = torch.zeros(*kept.shape, colour.shape[-1], device=kept.device)
    whole[kept] = colour
    return density, whole


def _parts(name: str, tensors: dict[str, Tensor], parts: tuple[str, ...]) -> dict[str, Tensor]:
    return {part: tensors[f"{name}.{part}"] for part in parts}


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Tensors that are missing or do not fit together, as an error that names the file."""
    try:
        yield
    except (
        KeyError,
        ValueError,
        TypeError,
        RuntimeError,
        IndexError,
        AttributeError,
        OverflowError,
    ) as error:
        raise _damaged(path, f"its parts do not fit together ({error})") from None


def _damaged(path: Path, why: str) -> ReconstructError:
    return ReconstructError("file-damaged", f"{path}: {why}; delete it and run its stage again")


def _save(path: Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    ready = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    save_tensors(path, ready, {"devrf": json.dumps({"format": FORMAT, **meta})})


def _kind(path: Path) -> str:
    """What a file says that it holds; nothing where it cannot be read, which `_load` says."""
    try:
        with safe_open(str(path), framework="pt", device="cpu") as file:
            return str(_meta(file).get("kind", ""))
    except (SafetensorError, ValueError, RecursionError, OSError, AttributeError):
        return ""


def _meta(file: Any) -> Any:
    """What an open file says of its tensors."""
    return json.loads((file.metadata() or {}).get("devrf", "{}"))


def _load(path: Path, kind: str, device: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if not path.is_file():
        raise ReconstructError("file-missing", f"{path}: no model here; run the stage that makes it")
    try:
        with safe_open(str(path), framework="pt", device=device) as file:
            meta = _meta(file)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            if not isinstance(meta, dict):
                raise ValueError("its metadata are no names with values")
    except (SafetensorError, ValueError, RecursionError, OSError) as error:
        raise _damaged(path, f"cannot be read ({error})") from None
    if meta.get("format") != FORMAT or meta.get("kind") != kind:
        found = f"{meta.get('kind', 'something else')}, format {meta.get('format')}"
        text = f"{path}: holds {found}; expected {kind}, format {FORMAT}; run its stage again"
        raise ReconstructError("model-wrong-kind", text)
    if not all(torch.isfinite(t).all() for t in tensors.values() if t.is_floating_point()):
        raise ReconstructError("values-not-finite", f"{path}: holds values that are not finite; train again")
    return tensors, meta
