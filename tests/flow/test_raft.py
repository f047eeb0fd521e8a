"""RAFT: real weights on Middlebury, both layouts of weights of both sizes, lookups without a volume, bad files."""

import re

import numpy as np
import pytest
import torch
from PIL import Image
from tests.flow.test_estimator import UNKNOWN, read_flo, textured

from devrf.capture.errors import InputError
from devrf.flow import correlation
from devrf.flow.consistency import endpoint_error
from devrf.flow.correlation import CorrelationPyramid
from devrf.flow.raft import RaftFlow
from devrf.flow.raft_network import LARGE, SMALL, Raft
from devrf.flow.raft_weights import load_raft

TENSORS = {
    SMALL: (106, 990_162),
    LARGE: (169, 5_257_536),
}  # number of tensors without doubles; of weights, as torchvision states


@pytest.fixture(scope="module")
def small(data_dir) -> RaftFlow:
    return RaftFlow(data_dir / "weights" / "raft-small.pth")


# the authors' program with these weights: 0.320 and 0.373 px; the issue's goals
@pytest.mark.parametrize(("pair", "most"), [("RubberWhale", 0.33), ("Venus", 0.38)])
def test_middlebury_endpoint_error(data_dir, small, pair, most):
    folder = data_dir / "middlebury_flow" / pair
    first, second = (np.array(Image.open(folder / f"frame{n}.png").convert("RGB")) for n in (10, 11))
    truth = read_flo(folder / "flow10.flo")
    known = (np.abs(truth) < UNKNOWN).all(-1)
    assert endpoint_error(small.estimate(first, second)[known], truth[known]).mean() <= most


def test_any_size_and_a_batch(small):
    pictures = np.stack([textured(50, 171, seed) for seed in range(2)])
    later = np.roll(pictures, 4, axis=2)
    flow = small.estimate(pictures, later)
    assert flow.shape == (2, 50, 171, 2)
    np.testing.assert_array_equal(flow[1], small.estimate(pictures[1], later[1]))
    assert np.abs(np.median(flow[:, 10:-10, 20:-20], axis=(0, 1, 2)) - [4, 0]).max() < 0.5


@pytest.fixture(params=[SMALL, LARGE], ids=["small", "large"])
def network(request) -> Raft:
    torch.manual_seed(0)
    made = Raft(request.param)
    for name, buffer in made.named_buffers():  # as if it had been trained
        if name.endswith("running_mean"):
            buffer.uniform_(-0.1, 0.1)
    return made.eval()


def as_authors(weights: dict) -> dict:
    """As the authors' data parallel training saves them: the norm of a shortcut is there twice."""
    out = {f"module.{name}": value for name, value in weights.items()}
    for name, value in weights.items():
        if ".downsample.1." in name:
            out["module." + name.replace(".downsample.1.", ".norm3.")] = value
    return out


def as_torchvision(weights: dict) -> dict:
    """By torchvision's module tree (models/optical_flow/raft.py), written down apart from the code's table."""
    out = {}
    for name, value in weights.items():
        part, rest = name.split(".", 1)
        if part in ("fnet", "cnet"):
            new = {"fnet": "feature_encoder", "cnet": "context_encoder"}[part]
            if rest.startswith("conv2"):
                rest = rest.replace("conv2", "conv", 1)
            elif not rest.startswith("layer"):
                rest = {"conv1": "convnormrelu.0", "norm1": "convnormrelu.1"}[rest[:5]] + rest[5:]
            elif "downsample" not in rest:
                layer, block, unit, kind = rest.split(".")
                rest = (
                    f"{layer}.{block}.convnormrelu{unit[4]}.{'0' if unit.startswith('conv') else '1'}.{kind}"
                )
        else:
            where, rest = rest.split(".", 1)
            new = "update_block"
            if where == "encoder":
                unit, kind = rest.split(".")
                unit = unit.replace("convc", "convcorr").replace("convf", "convflow")
                rest = f"motion_encoder.{unit}.0.{kind}"
            elif where == "gru":
                unit, kind = rest.split(".")
                rest = f"recurrent_block.convgru{unit[5:] or '1'}.{unit[:5]}.{kind}"
            elif where == "mask":
                new = "mask_predictor"
                rest = {"0": "convrelu.0", "2": "conv"}[rest[0]] + rest[1:]
            else:
                rest = f"flow_head.{rest}"
        out[f"{new}.{rest}"] = value
    return out


TORCHVISION_HAS = (
    "feature_encoder.convnormrelu.0.weight",
    "feature_encoder.layer2.0.convnormrelu1.0.bias",
    "context_encoder.layer3.0.downsample.0.weight",
    "context_encoder.conv.bias",
    "update_block.motion_encoder.convcorr1.0.weight",
    "update_block.motion_encoder.convflow2.0.weight",
    "update_block.motion_encoder.conv.0.bias",
    "update_block.recurrent_block.convgru1.convz.weight",
    "update_block.flow_head.conv2.bias",
)


@pytest.mark.parametrize("layout", [dict, as_authors, as_torchvision])
def test_every_layout_loads_strictly(network, layout, tmp_path):
    weights = network.state_dict()
    assert len(weights) == TENSORS[network.sizes][0]
    learned = sum(p.numel() for p in network.parameters())
    assert learned == TENSORS[network.sizes][1]
    path = tmp_path / "raft.pth"
    saved = layout(weights)
    if layout is as_authors and network.sizes == LARGE:
        assert len(saved) == 179  # five numbers of each of two norms are there twice
    if layout is as_torchvision:
        assert saved.keys() >= set(TORCHVISION_HAS)
    torch.save(saved, path)
    loaded = load_raft(path)
    assert loaded.sizes == network.sizes and not loaded.training
    for name, value in weights.items():
        torch.testing.assert_close(loaded.state_dict()[name], value, rtol=0, atol=0)
    picture = torch.rand(3, 128, 136) * 2 - 1
    with torch.inference_mode():
        flow = loaded(picture, picture.roll(2, 2), 2)
        torch.testing.assert_close(flow, network(picture, picture.roll(2, 2), 2))
    assert flow.shape == (2, 128, 136) and flow.isfinite().all()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda w: w.pop("fnet.conv2.bias"), "missing fnet.conv2.bias"),
        (lambda w: w.update(extra=torch.zeros(1)), "surplus extra"),
        (lambda w: w.update({"cnet.conv2.bias": torch.zeros(3)}), r"another shape cnet.conv2.bias \[3\] for"),
        (lambda w: w.pop("fnet.conv1.weight"), "no RAFT: fnet.conv1.weight is absent"),
    ],
)
def test_weights_that_do_not_fit_are_named(network, change, expected, tmp_path):
    weights = dict(network.state_dict())
    change(weights)
    torch.save(weights, tmp_path / "raft.pth")
    with pytest.raises(InputError, match=f"raft.pth.*{expected}"):
        load_raft(tmp_path / "raft.pth")


class Harmful:
    def __reduce__(self):
        return (print, ("run",))


def test_code_in_a_file_is_not_run(tmp_path, capsys):
    torch.save({"fnet.conv1.weight": Harmful()}, tmp_path / "raft.pth")
    with pytest.raises(InputError, match="raft.pth: not a file of plain weights"):
        load_raft(tmp_path / "raft.pth")
    assert capsys.readouterr().out == ""
    (tmp_path / "raft.pth").write_bytes(b"nothing")
    with pytest.raises(InputError, match="raft.pth: not a file of plain weights"):
        load_raft(tmp_path / "raft.pth")
    torch.save([1, 2], tmp_path / "raft.pth")
    with pytest.raises(InputError, match="holds no state dict"):
        load_raft(tmp_path / "raft.pth")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path}: no such file")):
        load_raft(tmp_path)


def test_lookup_without_a_volume_is_the_same(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.randn(16, 20, 24, generator=generator) for _ in range(2))
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    points = torch.stack([x, y], dim=-1) + 6 * torch.randn(20, 24, 2, generator=generator)
    whole = CorrelationPyramid(first, second, 3)
    volumes = [level.dim() == 4 for level in whole.levels]
    monkeypatch.setattr(correlation, "VOLUME_BYTES", 480 * 6 * 5 * 4)  # levels 2 and 3 fit
    monkeypatch.setattr(correlation, "CHUNK_BYTES", 16 * 49 * 4 * 100)  # several chunks
    bounded = CorrelationPyramid(first, second, 3)
    assert volumes == [True] * 4 and [v.dim() == 4 for v in bounded.levels] == [False, False, True, True]
    # dot products of 16 numbers of size 1 in single precision, in another order: 1e-6 times their size
    torch.testing.assert_close(bounded.around(points), whole.around(points), rtol=1e-4, atol=1e-5)


def test_lookup_by_hand():
    """Feature c of the second map is 1 at one place only: the correlation there is the first map's, by sqrt(C)."""
    second = torch.zeros(4, 16, 16)
    second[1, 5, 3] = 1.0  # y = 5, x = 3
    first = torch.arange(4.0)[:, None, None].expand(4, 16, 16).contiguous()
    seen = CorrelationPyramid(first, second, 1).around(torch.tensor([2.0, 4.0]).expand(16, 16, 2))
    finest = seen[:9, 0, 0].view(3, 3)  # x outside, y inside
    expected = torch.zeros(3, 3)
    expected[2, 2] = 1.0 / 4**0.5  # one right of and one below (2, 4)
    torch.testing.assert_close(finest, expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_half_precision_on_a_gpu_is_near(data_dir, small):
    picture = textured(200, 264)
    moved = np.roll(picture, 4, axis=1)
    on_gpu = RaftFlow(data_dir / "weights" / "raft-small.pth", "cuda").estimate(picture, moved)
    assert endpoint_error(on_gpu, small.estimate(picture, moved)).mean() < 0.05
