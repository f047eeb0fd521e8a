"""LPIPS gives upstream's values; weights: of both layouts the same numbers; from wrong files, a clear message."""

import pickle
import shutil
import socket
import sys
import urllib.error
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tests.refused import refused

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.evaluation import lpips_weights
from devrf.reconstruct.evaluation.evaluate import LpipsNets
from devrf.reconstruct.evaluation.lpips import Lpips
from devrf.reconstruct.evaluation.lpips_weights import CONVOLUTIONS, HEADS, Net, load_weights

# computed in double precision, with the same half-precision convolutions, by an independent program
EXPECTED: dict[Net, tuple[float, float]] = {"alex": (0.72188, 0.13757), "vgg": (0.56861, 0.42166)}
TORCHVISION = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


def trunk(net: Net, shrink: int = 1) -> dict[str, torch.Tensor]:
    """A trunk of the right shapes, with torchvision's classifier behind it."""
    state, channels = {}, 3
    for n, out, side in CONVOLUTIONS[net]:
        state[f"features.{n}.weight"] = torch.full((out // shrink, channels, side, side), 0.01)
        state[f"features.{n}.bias"] = torch.zeros(out // shrink)
        channels = out // shrink
    return state | {"classifier.6.weight": torch.zeros(10, 4), "classifier.6.bias": torch.zeros(10)}


def heads(net: Net) -> dict[str, torch.Tensor]:
    return {f"lin{n}.model.1.weight": torch.full((1, c, 1, 1), 0.5) for n, c in enumerate(HEADS[net])}


@pytest.fixture
def no_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the package lpips were not installed."""
    monkeypatch.setitem(sys.modules, "lpips", None)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package lpips that cannot be imported, only looked up; its folder of weights."""
    folder = tmp_path / "site" / "lpips" / "weights" / "v0.1"
    folder.mkdir(parents=True)
    (tmp_path / "site" / "lpips" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    return folder


def check_values(net: Net, folder: Path, data_dir: Path) -> None:
    lpips, place = Lpips(net, folder), data_dir / "weights" / "lpips_ref"
    ref, p0, p1 = (
        np.asarray(Image.open(place / f"ex_{n}.png").convert("RGB"), np.float32) / 255
        for n in ("ref", "p0", "p1")
    )
    kept = lpips.features(ref)
    assert lpips.distance(kept, lpips.features(p0)) == pytest.approx(EXPECTED[net][0], abs=1e-4)
    assert lpips(p1, ref) == pytest.approx(EXPECTED[net][1], abs=1e-4) and lpips(ref, ref) == 0


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_values_of_upstreams_example_pictures(net, data_dir) -> None:
    check_values(net, data_dir / "weights", data_dir)


def test_too_small_pictures_are_refused(data_dir):
    small = np.zeros((20, 80, 3), np.float32)
    with refused("picture-too-small", "80x20", kind=ReconstructError):
        Lpips("alex", data_dir / "weights")(small, small)


def real(net: Net, data_dir: Path) -> dict[str, torch.Tensor]:
    with np.load(data_dir / "weights" / f"lpips_{net}_v0.1.npz") as data:
        return {key: torch.from_numpy(data[key].astype(np.float32)) for key in data.files}


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_torchvisions_trunk_and_the_packages_heads(net, data_dir, tmp_path, package) -> None:
    state = {k: torch.nn.Parameter(v) for k, v in real(net, data_dir).items() if k.startswith("features")}
    torch.save(state | {"classifier.6.weight": torch.zeros(1000, 8)}, tmp_path / TORCHVISION[net])
    shutil.copyfile(data_dir / "weights/lpips_ref" / f"lin_v0.1_{net}.pth", package / f"{net}.pth")
    check_values(net, tmp_path, data_dir)


def test_missing_weights_are_named(tmp_path, no_package) -> None:
    torch.save(heads("vgg"), tmp_path / "vgg.pth")  # a layout that is not read
    with refused("weights-missing", tmp_path, "lpips_vgg_v0.1.npz", "vgg16*.pth", kind=ReconstructError):
        load_weights("vgg", tmp_path)
    torch.save(trunk("vgg"), tmp_path / "vgg16-397923af.pth")
    with refused("package-missing", "VGG16", "pip install lpips", kind=ReconstructError):
        load_weights("vgg", tmp_path)
    nets = LpipsNets.load(tmp_path)
    assert not nets.nets and "AlexNet" in nets.why["alex"] and "pip install" in nets.why["vgg"]


class _Code:
    """A pickle that would run code when it is opened."""

    def __reduce__(self) -> tuple[Callable, tuple]:
        return exec, ("raise SystemExit('executed')",)


def _without(state: dict[str, torch.Tensor], key: str) -> dict[str, torch.Tensor]:
    return {k: v for k, v in state.items() if k != key}


NONE = "weights-wrong", ("features.0.weight is missing",)
WRONG: dict[str, tuple[Callable[[Path], object], str, tuple[str, ...]]] = {
    "another network": (
        lambda p: torch.save(trunk("vgg"), p),
        "weights-wrong",
        ("features.0.weight", "[64, 3, 3, 3]"),
    ),
    "narrower": (
        lambda p: torch.save(trunk("alex", 2), p),
        "weights-wrong",
        ("[32, 3, 11, 11]", "[64, 3, 11, 11]"),
    ),
    "missing keys": (
        lambda p: torch.save(_without(trunk("alex"), "features.6.bias"), p),
        "weights-wrong",
        ("features.6.bias is missing", "[384]"),
    ),
    "no tensors": (lambda p: torch.save({"features.0.weight": "x"}, p), *NONE),
    "a list": (lambda p: torch.save([torch.zeros(3)], p), *NONE),
    "not finite": (
        lambda p: torch.save(trunk("alex") | {"features.0.bias": torch.full((64,), torch.nan)}, p),
        "values-not-finite",
        ("features.0.bias",),
    ),
    "damaged": (lambda p: p.write_bytes(b"PK\x03\x04" + b"x" * 500), "file-damaged", ()),
    "text": (lambda p: p.write_text("hello there"), "file-damaged", ()),
    "empty": (lambda p: p.write_bytes(b""), "file-damaged", ()),
    "code": (lambda p: torch.save({"features.0.weight": _Code()}, p), "file-damaged", ()),
    "old pickle with code": (lambda p: p.write_bytes(pickle.dumps(_Code(), 2)), "file-damaged", ()),
}


@pytest.mark.parametrize("kind", list(WRONG))
def test_wrong_trunks_are_refused(kind, tmp_path, no_package) -> None:
    write, code, named = WRONG[kind]
    write(tmp_path / "alexnet-owt-7be5be79.pth")
    with refused(code, "alexnet-owt-7be5be79.pth", *named, kind=ReconstructError):
        load_weights("alex", tmp_path)
    assert "alexnet-owt" in LpipsNets.load(tmp_path).why["alex"]


def test_wrong_heads_are_refused(tmp_path, package) -> None:
    torch.save(trunk("alex"), tmp_path / "alexnet.pth")
    torch.save(heads("vgg"), package / "alex.pth")
    named = "alex.pth", "lin1.model.1.weight", "[1, 128, 1, 1]", "[1, 192, 1, 1]"
    with refused("weights-wrong", *named, kind=ReconstructError):
        load_weights("alex", tmp_path)
    ours: dict[str, Any] = {key: value.numpy() for key, value in trunk("alex").items()}
    np.savez(tmp_path / "lpips_alex_v0.1.npz", **ours)
    with refused("weights-wrong", "alex", "lin0.weight is missing", kind=ReconstructError):
        load_weights("alex", tmp_path)


def test_download_goes_through_torchs_own_cache(package, tmp_path, monkeypatch) -> None:
    torch.save(heads("alex"), package / "alex.pth")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    cached = tmp_path / "cache" / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    cached.parent.mkdir(parents=True)
    torch.save(trunk("alex"), cached)
    convolutions, linear = load_weights("alex", "download")
    assert convolutions["features.0.weight"].shape == (64, 3, 11, 11) and len(linear) == 5


def test_a_failed_download_gives_a_reason(package, tmp_path, monkeypatch) -> None:
    torch.save(heads("alex"), package / "alex.pth")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    asked = []

    def offline(url: str, **options: object) -> None:
        asked.append((url, options["check_hash"], options["weights_only"], socket.getdefaulttimeout()))
        raise urllib.error.URLError("no network")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", offline)
    nets = LpipsNets.load("download")
    assert not nets.nets and nets.why["alex"].startswith(f"{lpips_weights.URLS['alex']}: ")
    assert "no network" in nets.why["alex"] and "pip install lpips" in nets.why["vgg"]
    # checked, without code, given up in time; VGG16 is not fetched where its heads are missing
    assert asked == [(lpips_weights.URLS["alex"], True, True, lpips_weights.PATIENCE_S)]
    assert socket.getdefaulttimeout() is None


def test_a_package_of_the_name_without_weights_is_passed_over(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", ModuleType("lpips"))  # has no spec
    with refused("package-missing", "AlexNet", kind=ReconstructError):
        load_weights("alex", "download")
