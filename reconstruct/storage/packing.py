"""Grids packed for the disk, to half a step.

Of a grid at rest only vertices that samples can touch are kept, a byte per number: steps between the smallest and
the largest value of its channel. A motion field is smooth: in steps of a set length, what remains of each vertex
after its neighbours have foretold it (the Lorenzo predictor: differences along all three axes, one after the other)
is mostly 0, and deflates well; where nothing moves, to nothing.
"""

import math
import zlib

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

STEPS = 255
LEVEL = 6  # of deflate; more takes long and gains little


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


def to_bytes(values: Float[Tensor, "N C"]) -> dict[str, Tensor]:
    """Values as `codes` [N, C], and `low` and `step` [C] of the channels."""
    if not len(values):
        nothing = values.new_zeros(values.shape[1])
        return {"codes": values.to(torch.uint8), "low": nothing, "step": nothing.clone()}
    low, high = values.amin(0), values.amax(0)
    step = (high - low) / STEPS
    codes = ((values - low) / step.clamp_min(torch.finfo(step.dtype).tiny)).round().clamp(0, STEPS)
    return {"codes": codes.to(torch.uint8), "low": low, "step": step}


def from_bytes(packed: dict[str, Tensor]) -> Float[Tensor, "N C"]:
    """What `to_bytes` packed, to half a step."""
    return packed["low"] + packed["codes"].float() * packed["step"]


def field_to_stream(field: Float[Tensor, "T X Y Z C"], step: float) -> dict[str, Tensor]:
    """A field as `stream` (deflated, key by key) and `ends` [T] of its keys' parts."""
    parts = [_deflated(key.cpu().numpy(), step) for key in field]  # one by one: all at once would be large
    ends = np.cumsum([len(part) for part in parts], dtype=np.int64)
    stream = np.frombuffer(b"".join(parts), np.uint8).copy()
    return {"stream": torch.from_numpy(stream), "ends": torch.from_numpy(ends)}


def field_from_stream(
    packed: dict[str, Tensor], shape: tuple[int, int, int, int], step: float, channels: int = 3
) -> Float[Tensor, "T X Y Z C"]:
    """What `field_to_stream` packed, to half a step; `shape` is T, X, Y, Z.

    Raises:
        ValueError: The stream does not hold a field of this shape.
    """
    T, *size = shape
    if len(packed["ends"]) != T:
        raise ValueError(f"{len(packed['ends'])} parts for {T} key times")
    stream, begin, field = packed["stream"].numpy().tobytes(), 0, torch.empty(*shape, channels)
    for key, end in enumerate(packed["ends"].tolist()):
        field[key] = torch.from_numpy(_inflated(stream[begin:end], (channels, *size), step))
        begin = end
    return field


def _deflated(key: Float[np.ndarray, "X Y Z C"], step: float) -> bytes:
    codes = np.moveaxis(np.rint(key / step).astype(np.int32), -1, 0)
    for axis in (1, 2, 3):
        codes = np.diff(codes, axis=axis, prepend=0)
    positive = (codes << 1) ^ (codes >> 31)  # 0, -1, 1, -2, ... as 0, 1, 2, 3, ...
    planes = positive.astype("<u4").reshape(-1, 1).view(np.uint8).T  # lowest bytes first; the high ones are 0
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), LEVEL)


def _inflated(part: bytes, shape: tuple[int, ...], step: float) -> Float[np.ndarray, "X Y Z C"]:
    count = 4 * math.prod(shape)
    inflate = zlib.decompressobj()
    try:
        planes = inflate.decompress(part, count)  # never more than that, whatever the file says
    except zlib.error as error:
        raise ValueError(f"damaged: {error}") from None
    if len(planes) != count or not inflate.eof:
        raise ValueError(f"a key time of {len(planes)} bytes where {count} were expected")
    positive = (
        np.ascontiguousarray(np.frombuffer(planes, np.uint8).reshape(4, -1).T).view("<u4").reshape(shape)
    )
    codes = (positive >> 1).astype(np.int32) ^ -(positive & 1).astype(np.int32)
    for axis in (1, 2, 3):
        codes = np.cumsum(codes, axis=axis, dtype=np.int32)
    return np.moveaxis(codes, 0, -1).astype(np.float32) * np.float32(step)
