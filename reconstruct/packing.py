"""Grids packed for the disk: only vertices that samples can touch, and one byte per number where that is enough.

A byte counts steps between the smallest and the largest value of its group: a channel of all kept vertices, or
a channel of a block of 8^3 vertices of a smooth field, whose values differ little. The error is at most half a step.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

STEPS = 255
BLOCK = 8  # vertices along each axis of a block of a motion field


def bits_of(mask: Bool[Tensor, "X Y Z"]) -> UInt8[Tensor, " B"]:
    """One bit per vertex."""
    return torch.from_numpy(np.packbits(mask.cpu().numpy().reshape(-1)))


def mask_of(bits: UInt8[Tensor, " B"], shape: tuple[int, int, int]) -> Bool[Tensor, "X Y Z"]:
    """What `bits_of` packed.

    Raises:
        ValueError: The bits are not as many as the shape needs.
    """
    count = shape[0] * shape[1] * shape[2]
    if bits.numel() != -(-count // 8):
        raise ValueError(f"{bits.numel()} bytes of bits for {count} vertices")
    return torch.from_numpy(np.unpackbits(bits.numpy(), count=count).astype(bool).reshape(shape))


def to_bytes(values: Float[Tensor, "G N C"]) -> dict[str, Tensor]:
    """Values as `codes` [G, N, C], and `low` and `step` [G, 1, C] of each group's channels."""
    if not values.shape[1]:
        nothing = values.new_zeros(values.shape[0], 1, values.shape[2])
        return {"codes": values.to(torch.uint8), "low": nothing, "step": nothing.clone()}
    low, high = values.amin(1, keepdim=True), values.amax(1, keepdim=True)
    step = (high - low) / STEPS
    codes = ((values - low) / step.clamp_min(torch.finfo(step.dtype).tiny)).round().clamp(0, STEPS)
    return {"codes": codes.to(torch.uint8), "low": low, "step": step}


def from_bytes(packed: dict[str, Tensor]) -> Float[Tensor, "G N C"]:
    """What `to_bytes` packed, to half a step."""
    return packed["low"] + packed["codes"].float() * packed["step"]


def field_to_bytes(field: Float[Tensor, "T X Y Z 3"]) -> dict[str, Tensor]:
    """A smooth field in blocks, each with its own range; what is zero throughout stays exactly zero."""
    keys = [to_bytes(_blocks(key[None])) for key in field]  # all at once would need the memory thrice
    return {part: torch.cat([key[part] for key in keys]) for part in keys[0]}


def field_from_bytes(
    packed: dict[str, Tensor], shape: tuple[int, int, int, int]
) -> Float[Tensor, "T X Y Z 3"]:
    """What `field_to_bytes` packed; `shape` is T, X, Y, Z."""
    T, *size = shape
    counts = [-(-n // BLOCK) for n in size]
    field = torch.empty(*shape, 3)
    per_key = counts[0] * counts[1] * counts[2]
    for t in range(T):
        part = {name: value[t * per_key : (t + 1) * per_key] for name, value in packed.items()}
        blocks = from_bytes(part).reshape(*counts, BLOCK, BLOCK, BLOCK, 3)
        whole = blocks.permute(0, 3, 1, 4, 2, 5, 6).reshape(*(n * BLOCK for n in counts), 3)
        field[t] = whole[: size[0], : size[1], : size[2]]
    return field


def _blocks(field: Float[Tensor, "T X Y Z 3"]) -> Float[Tensor, "G N 3"]:
    """Blocks of 8^3 vertices; those at the far sides are filled up with their last vertices."""
    T = field.shape[0]
    for axis in (1, 2, 3):
        last = field.narrow(axis, field.shape[axis] - 1, 1)
        missing = -field.shape[axis] % BLOCK
        field = torch.cat([field, last.repeat_interleave(missing, dim=axis)], dim=axis)
    counts = [n // BLOCK for n in field.shape[1:4]]
    parts = field.reshape(T, counts[0], BLOCK, counts[1], BLOCK, counts[2], BLOCK, 3)
    return parts.permute(0, 1, 3, 5, 2, 4, 6, 7).reshape(-1, BLOCK**3, 3)
