"""What is packed comes back, to half a step."""

import pytest
import torch

from devrf.reconstruct.packing import (
    STEPS,
    bits_of,
    field_from_bytes,
    field_to_bytes,
    from_bytes,
    mask_of,
    to_bytes,
)


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 5, 7), (8, 8, 8)])
def test_masks(shape: tuple[int, int, int]) -> None:
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < 0.4
    assert torch.equal(mask_of(bits_of(mask), shape), mask)
    with pytest.raises(ValueError, match="bytes of bits"):
        mask_of(bits_of(mask), (shape[0] + 8, *shape[1:]))


def test_bytes_are_within_half_a_step_of_each_channel() -> None:
    values = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor(
        [1.0, 100.0, 0.0]
    )
    packed = to_bytes(values)
    assert packed["codes"].dtype == torch.uint8
    steps = (values.amax(1) - values.amin(1)) / STEPS
    assert ((from_bytes(packed) - values).abs().amax(1) <= 0.501 * steps + 1e-7).all()
    assert from_bytes(to_bytes(torch.zeros(1, 0, 3))).shape == (1, 0, 3)


@pytest.mark.parametrize("size", [(4, 5, 6), (8, 16, 8), (9, 17, 3)])
def test_smooth_fields_keep_small_differences(size: tuple[int, int, int]) -> None:
    """A shift of one unit across the box: each block's own range makes the error far smaller than 1 / 255."""
    axes = [torch.linspace(0, 1, n) for n in size]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    field = torch.stack([torch.stack([x, x * y, 1e-3 * z], dim=-1), torch.zeros(*size, 3)])
    back = field_from_bytes(field_to_bytes(field), (2, *size))
    assert back.shape == field.shape and torch.equal(back[1], field[1])
    block = torch.tensor([min(1.0, 7 / max(1, n - 1)) for n in size])
    assert (back - field).abs()[0, ..., 0].max() <= 0.51 / STEPS * block[0] + 1e-7
    assert (back - field).abs()[0, ..., 2].max() <= 0.51e-3 / STEPS + 1e-7
