"""Weights of RAFT from a file: the authors' checkpoints, or torchvision's state dicts. Nothing missing, nothing left.

Files are read as data only (`weights_only`): no code of theirs is run. Which network they belong to is told by the
width of the first convolution.
"""

import re
from pathlib import Path

import torch
from torch import Tensor

from devrf.capture.system.errors import DevrfError, InputError
from devrf.flow.raft.network import LARGE, SMALL, Raft
from devrf.flow.raft.weights_file import read_weights

LISTED = 4  # names in a message
SIZES = {sizes.stem: sizes for sizes in (SMALL, LARGE)}

TORCHVISION = (
    (r"^feature_encoder\.", "fnet."),
    (r"^context_encoder\.", "cnet."),
    (r"^(.net)\.conv\.", r"\1.conv2."),
    (r"\.convnormrelu\.0\.", ".conv1."),
    (r"\.convnormrelu\.1\.", ".norm1."),
    (r"\.convnormrelu(\d)\.0\.", r".conv\1."),
    (r"\.convnormrelu(\d)\.1\.", r".norm\1."),
    (r"\.motion_encoder\.conv(c)orr(\d)\.0\.", r".encoder.conv\1\2."),
    (r"\.motion_encoder\.conv(f)low(\d)\.0\.", r".encoder.conv\1\2."),
    (r"\.motion_encoder\.conv\.0\.", ".encoder.conv."),
    (r"^mask_predictor\.convrelu\.0\.", "update_block.mask.0."),
    (r"^mask_predictor\.conv\.", "update_block.mask.2."),
)
"""torchvision's names, and those of the authors; the recurrent unit's depend on the network's size."""


def load_raft(path: Path) -> Raft:
    """The network of a file of weights, ready to be used.

    Raises:
        InputError: No such file, not a file of weights, not of RAFT, or names or shapes that do not all fit.
    """
    named = _names_of_authors(_read(path))
    stem = named.get("fnet.conv1.weight")
    sizes = SIZES.get(stem.shape[0]) if stem is not None and stem.dim() else None
    if sizes is None:
        there = "absent" if stem is None else list(stem.shape)
        expected = f"{SMALL.stem} (small) or {LARGE.stem} (large) filters; the file has {_listed(named)}"
        wrong = f"flow.weights: {path}: no RAFT: fnet.conv1.weight is {there}"
        raise InputError("weights-wrong", f"{wrong}, expected {expected}")
    network = Raft(sizes)
    _check(path, named, network.state_dict(), sizes.name)
    network.load_state_dict(named, strict=True)
    return network.eval().requires_grad_(False)


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        text = f"flow.weights: {path}: no such file; expected a checkpoint of RAFT (.pth)"
        raise InputError("file-missing", text)
    try:
        found = read_weights(path)
    except DevrfError as error:
        raise InputError(error.code, f"flow.weights: {error}") from error
    except OSError as error:
        text = f"flow.weights: {path}: cannot be read ({error.strerror or error})"
        raise InputError("file-unreadable", text) from error
    except Exception as error:  # what torch's reader raises of other files depends on their first bytes
        wrong = f"flow.weights: {path}: not a file of plain weights"
        text = f"{wrong}; expected a state dict of RAFT (.pth), get it again"
        raise InputError("file-damaged", text) from error
    if not isinstance(found, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in found.items()
    ):
        text = f"flow.weights: {path}: holds no state dict; expected names with tensors"
        raise InputError("weights-wrong", text)
    return found


def _names_of_authors(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Without the prefix of data parallel training, torchvision's names translated, doubles taken out."""
    plain = {name.removeprefix("module."): value for name, value in weights.items()}
    unit = r".gru.conv\2\1" if any(".convgru2." in name for name in plain) else r".gru.conv\2"
    out = {}
    for name, value in plain.items():
        for pattern, new in TORCHVISION:
            name = re.sub(pattern, new, name)
        name = re.sub(r"\.recurrent_block\.convgru(\d)\.conv(.)", unit, name)
        # The authors register the norm of a shortcut twice.
        twin = re.sub(r"\.norm3\.", ".downsample.1.", name) if name.startswith("cnet.layer") else name
        if twin == name or twin not in plain or not torch.equal(plain[twin], value):
            out[name] = value
    return out


def _check(path: Path, named: dict[str, Tensor], expected: dict[str, Tensor], size: str) -> None:
    missing, surplus = expected.keys() - named.keys(), named.keys() - expected.keys()
    shapes = [
        f"{name} {list(named[name].shape)} for {list(expected[name].shape)}"
        for name in sorted(expected.keys() & named.keys())
        if named[name].shape != expected[name].shape
    ]
    wrong = [f"missing {_listed(missing)}"] if missing else []
    wrong += [f"surplus {_listed(surplus)}"] if surplus else []
    wrong += [f"of another shape {_listed(shapes)}"] if shapes else []
    if wrong:
        found = f"flow.weights: {path}: not all weights of RAFT ({size}) and nothing else: {'; '.join(wrong)}"
        raise InputError("weights-wrong", f"{found}; use the authors' or torchvision's file as published")


def _listed(names) -> str:
    shown = sorted(names)
    return ", ".join(shown[:LISTED]) + (f" and {len(shown) - LISTED} more" if len(shown) > LISTED else "")
