"""Weights for LPIPS: the convolutions of a network (its trunk) and the five linear heads of version 0.1.

None are part of this package. Two layouts are read:

- `lpips_<net>_v0.1.npz`: trunk (`features.N.weight`, `features.N.bias`) and heads (`lin0.weight` … `lin4.weight`);
- torchvision's `alexnet*.pth` or `vgg16*.pth`, in the folder or downloaded: the trunk; its classifier is not used. The
  heads are those of the installed package `lpips` (`lin0.model.1.weight` …), which is looked up but not imported.

Every tensor's shape is checked; a network with other weights is not LPIPS and is never reported as such.
"""

import importlib.util
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from devrf.capture.system.arrays import read_npz
from devrf.capture.system.errors import DevrfError, ReconstructError

if TYPE_CHECKING:
    from torch import Tensor

Net = Literal["vgg", "alex"]
Source = Path | Literal["download"]
NETWORK: dict[Net, str] = {"alex": "AlexNet", "vgg": "VGG16"}
# Convolutions in order: (layer number, channels out, side of the window)
CONVOLUTIONS: dict[Net, tuple[tuple[int, int, int], ...]] = {
    "alex": ((0, 64, 11), (3, 192, 5), (6, 384, 3), (8, 256, 3), (10, 256, 3)),
    "vgg": (
        *((0, 64, 3), (2, 64, 3), (5, 128, 3), (7, 128, 3), (10, 256, 3), (12, 256, 3), (14, 256, 3)),
        *((17, 512, 3), (19, 512, 3), (21, 512, 3), (24, 512, 3), (26, 512, 3), (28, 512, 3)),
    ),
}
HEADS: dict[Net, tuple[int, ...]] = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
TRUNK_FILES: dict[Net, str] = {"alex": "alexnet*.pth", "vgg": "vgg16*.pth"}
URLS: dict[Net, str] = {
    "alex": "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "vgg": "https://download.pytorch.org/models/vgg16-397923af.pth",
}
PATIENCE_S = 30.0  # without an answer, before a download is given up

Weights = dict[str, "Tensor"]


def load_weights(net: Net, source: Source) -> tuple[Weights, "list[Tensor]"]:
    """The trunk by torchvision's names and the five heads [1, channels, 1, 1], single precision.

    Args:
        net: The network.
        source: A folder with one of the two layouts, or `download`: torchvision's public file (kept in torch's own
            cache), with the heads of the installed package `lpips`.
    Raises:
        ReconstructError: Nothing there, or something else; says which two layouts are read.
    """
    if isinstance(source, str):
        heads = _heads_of_package(net)  # before half a gigabyte is fetched
        return _trunk(_downloaded(URLS[net]), net, URLS[net]), heads
    both = source / f"lpips_{net}_v0.1.npz"
    if both.is_file():
        state = _read(both)
        return _trunk(state, net, str(both)), _heads(state, "lin{}.weight", net, str(both))
    found = sorted(source.glob(TRUNK_FILES[net]))
    if not found:
        layouts = f"{both.name}, or torchvision's {TRUNK_FILES[net]} with the package lpips (evaluate.lpips_weights)"
        text = f"{source}: no weights of {NETWORK[net]}; two layouts are read: {layouts}"
        raise ReconstructError("weights-missing", text)
    return _trunk(_read(found[0]), net, str(found[0])), _heads_of_package(net)


def _heads_of_package(net: Net) -> "list[Tensor]":
    """The heads in an installed package `lpips`.

    Raises:
        ReconstructError: There is no such package, or it has others.
    """
    try:
        spec = importlib.util.find_spec("lpips")
    except (ImportError, ValueError):
        spec = None
    for root in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(root) / "weights" / "v0.1" / f"{net}.pth"
        if path.is_file():
            return _heads(_read(path), "lin{}.model.1.weight", net, str(path))
    text = f"the heads of LPIPS on {NETWORK[net]} are missing; expected the package lpips (pip install lpips)"
    raise ReconstructError("package-missing", text)


def _trunk(state: Mapping[str, Any], net: Net, name: str) -> Weights:
    channels, shapes = 3, {}
    for n, out, side in CONVOLUTIONS[net]:
        shapes[f"features.{n}.weight"], shapes[f"features.{n}.bias"] = (out, channels, side, side), (out,)
        channels = out
    return {key: _tensor(state, key, shape, net, name) for key, shape in shapes.items()}


def _heads(state: Mapping[str, Any], key: str, net: Net, name: str) -> "list[Tensor]":
    return [_tensor(state, key.format(n), (1, c, 1, 1), net, name) for n, c in enumerate(HEADS[net])]


def _tensor(state: Mapping[str, Any], key: str, shape: tuple[int, ...], net: Net, name: str) -> "Tensor":
    import torch

    value, expected = state.get(key), f"expected {list(shape)}; take the file of {NETWORK[net]}"
    if not isinstance(value, torch.Tensor) or list(value.squeeze().shape) != [n for n in shape if n > 1]:
        found = list(value.shape) if isinstance(value, torch.Tensor) else "missing"
        text = f"{name}: not LPIPS weights of {net}: {key} is {found}, {expected}"
        raise ReconstructError("weights-wrong", text)
    if not torch.isfinite(value).all():
        text = f"{name}: {key} has values that are not finite; get the file again"
        raise ReconstructError("values-not-finite", text)
    return value.detach().reshape(shape).float()


def _read(path: Path) -> Mapping[str, Any]:
    """Tensors by name, of an npz or of a file of torch's; nothing in them is executed."""
    import torch

    from devrf.flow.raft.weights_file import read_weights

    try:
        if path.suffix == ".npz":
            return {key: torch.from_numpy(value) for key, value in read_npz(path).items()}
        state = read_weights(path)
    except DevrfError as error:
        raise ReconstructError(error.code, f"{error}; get the file again") from error
    except Exception as error:  # torch raises errors of many kinds
        wrong = f"{path}: damaged, or holds more than weights, and is not used ({_short(error)})"
        raise ReconstructError("file-damaged", f"{wrong}; get the file again") from error
    return state if isinstance(state, Mapping) else {}


def _downloaded(url: str) -> Mapping[str, Any]:
    """Torchvision's file, from torch's cache where it is there already."""
    import torch

    patience = socket.getdefaulttimeout()
    socket.setdefaulttimeout(PATIENCE_S)
    try:
        return torch.hub.load_state_dict_from_url(
            url, map_location="cpu", progress=False, check_hash=True, weights_only=True
        )
    except Exception as error:  # no network, no space, another file: the metric is missing, no more
        text = f"{url}: could not be downloaded ({_short(error)})"
        raise ReconstructError("download-failed", text) from error
    finally:
        socket.setdefaulttimeout(patience)


def _short(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__
