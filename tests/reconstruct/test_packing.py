"""What is packed comes back, to half a step, and no larger than it needs to be."""

import pytest
import torch

from devrf.reconstruct.storage.packing import (
    STEPS,
    bits_of,
    field_from_stream,
    field_to_stream,
    from_bytes,
    mask_of,
    to_bytes,
)


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 5, 7), (8, 8, 8)])
def test_masks(shape: tuple[int, int, int]) -> None:
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < 0.4
    assert torch.equal(mask_of(bits_of(mask), shape), mask)
    with pytest.raises(
        ValueError, match=f"^{bits_of(mask).numel()} .* {(shape[0] + 8) * shape[1] * shape[2]} "
    ):
        mask_of(bits_of(mask), (shape[0] + 8, *shape[1:]))


def test_bytes_are_within_half_a_step_of_each_channel() -> None:
    values = torch.randn(50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1.0, 100.0, 0.0])
    packed = to_bytes(values)
    assert packed["codes"].dtype == torch.uint8
    steps = (values.amax(0) - values.amin(0)) / STEPS
    assert ((from_bytes(packed) - values).abs().amax(0) <= 0.501 * steps + 1e-7).all()
    assert from_bytes(to_bytes(torch.zeros(0, 3))).shape == (0, 3)


@pytest.mark.parametrize("size", [(4, 5, 6), (8, 16, 8), (9, 17, 3), (1, 1, 1)])
@pytest.mark.parametrize("largest", [0.0, 0.3, 40.0])
def test_fields_are_within_half_a_step(size: tuple[int, int, int], largest: float) -> None:
    """Of either sign, of any length, in any order."""
    field = largest * torch.randn(3, *size, 3, generator=torch.Generator().manual_seed(2))
    back = field_from_stream(field_to_stream(field, 1e-3), (3, *size), 1e-3)
    assert back.shape == field.shape and (back - field).abs().max() <= 0.501e-3 + 1e-6 * largest


def test_what_is_smooth_is_small_and_what_does_not_move_nothing() -> None:
    axes = [torch.linspace(0, 1, 40)] * 3
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    smooth = 0.3 * torch.stack([x, x * y, torch.sin(3 * z)], dim=-1)[None]
    bytes_of = {}
    for name, field in {
        "still": torch.zeros_like(smooth),
        "smooth": smooth,
        "one corner": torch.where((x < 0.2)[..., None], smooth, 0.0),
        "rough": 0.3 * torch.rand(smooth.shape, generator=torch.Generator().manual_seed(3)),
    }.items():
        bytes_of[name] = len(field_to_stream(field, 1e-3)["stream"]) / smooth.numel()
    assert bytes_of["still"] < 0.5 * bytes_of["smooth"]
    assert bytes_of["smooth"] < 0.1 < 0.8 < bytes_of["rough"]
    assert bytes_of["one corner"] < bytes_of["smooth"]
