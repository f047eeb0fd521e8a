"""Weights for LPIPS: the convolutions of a network (its trunk) and the five linear heads of version 0.1.

None are part of this package. They are looked for in a folder, and in its subfolder `lpips_ref`:

- `lpips_<net>_v0.1.npz`: trunk (`features.N.weight`, `features.N.bias`) and heads (`lin0.weight` … `lin4.weight`);
- torchvision's `alexnet*.pth` or `vgg16*.pth`: the trunk; its classifier is not used;
- upstream's `<net>.pth` or `lin_v0.1_<net>.pth` (`lin0.model.1.weight` …): the heads, which an installed package
  `lpips` has too.

Every tensor's shape is checked; a network with other weights is not LPIPS and is never reported as such.
"""

import importlib.util
import socket
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from devrf.capture.arrays import ArrayError, read_npz
from devrf.capture.errors import DevrfError, ReconstructError

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")
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
TRUNK_FILES: dict[Net, tuple[str, ...]] = {
    "alex": ("lpips_alex_v0.1.npz", "alexnet-owt-*.pth", "alexnet*.pth"),
    "vgg": ("lpips_vgg_v0.1.npz", "vgg16-*.pth", "vgg16*.pth"),
}
HEAD_FILES = ("lpips_{net}_v0.1.npz", "{net}.pth", "lin_v0.1_{net}.pth")
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
        source: A folder, or `download`: torchvision's public file (kept in torch's own cache), with the heads
            of the installed package `lpips`.
    Raises:
        ReconstructError: Nothing there, or something else; says what was expected.
    """
    folders = () if isinstance(source, str) else (source, source / "lpips_ref")
    trunk_files = _files(folders, TRUNK_FILES[net])
    if folders and not trunk_files:
        names = " or ".join(TRUNK_FILES[net][:2])
        raise ReconstructError(
            f"{source}: no weights of {NETWORK[net]}; expected {names} (evaluate.lpips_weights)"
        )
    head_files = _files(folders, [name.format(net=net) for name in HEAD_FILES]) + _of_package(net)
    if not head_files:
        files = f"{net}.pth or lin_v0.1_{net}.pth in {source}, or " if folders else ""
        raise ReconstructError(
            f"the heads of LPIPS on {NETWORK[net]} are missing; "
            f"expected {files}the package lpips (pip install lpips)"
        )
    heads = _first_that_fits(head_files, net, _heads)
    if folders:
        return _first_that_fits(trunk_files, net, _trunk), heads
    return _trunk(_downloaded(URLS[net]), net, URLS[net]), heads


def _files(folders: Iterable[Path], patterns: Iterable[str]) -> list[Path]:
    """Files by pattern, the first pattern's first; each once."""
    patterns = list(patterns)
    return list(dict.fromkeys(path for f in folders for p in patterns for path in sorted(f.glob(p))))


def _of_package(net: Net) -> list[Path]:
    """The heads in an installed package `lpips`, which is looked up but not imported."""
    try:
        spec = importlib.util.find_spec("lpips")
    except (ImportError, ValueError):
        return []
    roots = [Path(root) for root in (spec.submodule_search_locations or ())] if spec is not None else []
    return [path for root in roots if (path := root / "weights" / "v0.1" / f"{net}.pth").is_file()]


def _first_that_fits(files: list[Path], net: Net, take: Callable[[Mapping[str, Any], Net, str], T]) -> T:
    """What `take` finds in the first file that has it.

    Raises:
        ReconstructError: None has it; says why of each.
    """
    wrong = []
    for path in files:
        try:
            return take(_read(path), net, str(path))
        except ReconstructError as error:
            wrong.append(str(error))
    raise ReconstructError("; ".join(wrong))


def _trunk(state: Mapping[str, Any], net: Net, name: str) -> Weights:
    channels, shapes = 3, {}
    for n, out, side in CONVOLUTIONS[net]:
        shapes[f"features.{n}.weight"], shapes[f"features.{n}.bias"] = (out, channels, side, side), (out,)
        channels = out
    return {key: _tensor(state, key, shape, net, name) for key, shape in shapes.items()}


def _heads(state: Mapping[str, Any], net: Net, name: str) -> "list[Tensor]":
    key = "lin{}.model.1.weight" if "lin0.model.1.weight" in state else "lin{}.weight"
    return [_tensor(state, key.format(n), (1, c, 1, 1), net, name) for n, c in enumerate(HEADS[net])]


def _tensor(state: Mapping[str, Any], key: str, shape: tuple[int, ...], net: Net, name: str) -> "Tensor":
    import torch

    value, expected = state.get(key), f"expected {list(shape)}; take the file of {NETWORK[net]}"
    if not isinstance(value, torch.Tensor):
        raise ReconstructError(f"{name}: not LPIPS weights of {net}: {key} is missing, {expected}")
    if list(value.squeeze().shape) != [n for n in shape if n > 1]:  # heads are stored flat, too
        raise ReconstructError(
            f"{name}: not LPIPS weights of {net}: {key} is {list(value.shape)}, {expected}"
        )
    if not torch.isfinite(value).all():
        raise ReconstructError(f"{name}: {key} has values that are not finite; get the file again")
    return value.detach().reshape(shape).float()


def _read(path: Path) -> Mapping[str, Any]:
    """Tensors by name, of an npz or of a file of torch's; nothing in them is executed."""
    import torch

    from devrf.flow.weights_file import read_weights

    try:
        if path.suffix == ".npz":
            return {key: torch.from_numpy(value) for key, value in read_npz(path).items()}
        state = read_weights(path)
    except ArrayError as error:
        raise ReconstructError(f"{error}; get the file again") from error
    except DevrfError as error:
        raise ReconstructError(str(error)) from error
    except OSError as error:
        raise ReconstructError(f"{path}: cannot be read ({_short(error)})") from error
    except Exception as error:  # torch and numpy raise errors of many kinds
        raise ReconstructError(
            f"{path}: damaged, or holds more than weights, and is not used; get the file again"
        ) from error
    if not isinstance(state, Mapping):
        raise ReconstructError(
            f"{path}: holds a {type(state).__name__}, expected weights by name (a state dict)"
        )
    return state


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
        raise ReconstructError(f"{url}: could not be downloaded ({_short(error)})") from error
    finally:
        socket.setdefaulttimeout(patience)


def _short(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__
