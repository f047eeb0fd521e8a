"""Splats in few bytes, for a page that carries them (pipelines/player/splats.js unpacks them).

Places are floats of 32 bits, since surroundings may be far; what moves goes on in 16-bit steps of its own extent, as
differences from key time to key time whose rounding does not add up. On nodes (rigid parts) it has no ways: a byte says
which node each is on, from 1, its place is from the node's own, and at each key time each node has a quaternion and a
place, as floats. Orientations are four bytes, logarithms of the
scales, opacities and colours one byte each. 16-bit numbers are stored with all low bytes before all high ones, which
deflates better.
"""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from devrf.reconstruct.splats.gaussians import Gaussians
from devrf.reconstruct.splats.moving import Nodes

STEPS = (1 << 15) - 2  # of the longest way of all: its differences fit, wherever it leads
DEFLATE = 9
BYTES, BYTES_PER_KEY = 23, 6  # of a splat, and for each key time after the first if it moves by itself
NODE_BYTES = 28  # of a node and a key time


@dataclass(frozen=True)
class PackedSplats:
    """Splats as a page carries them.

    Attributes:
        about: What a reader needs to know, for JSON.
        data: Deflated (zlib).
    """

    about: dict[str, Any]
    data: bytes


def pack(gaussians: Gaussians, ways: Float[Tensor, "K M 3"], nodes: Nodes | None = None) -> PackedSplats:
    """Pack splats.

    Args:
        gaussians: Those that move first; their own places count for those that do not, and on nodes.
        ways: Places of those that move, at the key times.
        nodes: On which they do, if that is so.
    """
    places = gaussians.places.cpu().numpy().astype("<f4")
    paths = ways.cpu().numpy().astype(np.float64)
    keys, moving = paths.shape[:2]
    mine = np.zeros(0, np.uint8) if nodes is None else nodes.part[:moving].cpu().numpy().astype(np.uint8)
    places[:moving] = paths[0] if nodes is None else places[:moving] - nodes.middles.cpu().numpy()[mine]
    log_scales = gaussians.log_scales.cpu().numpy().astype(np.float64)
    scales = float(log_scales.min()), float(log_scales.max())
    quats = gaussians.quats.cpu().numpy().astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    parts = [
        places,
        _bytes(quats * 127 + 128),
        _bytes((log_scales - scales[0]) / max(scales[1] - scales[0], 1e-9) * 255),
        _bytes(gaussians.logits.sigmoid().cpu().numpy() * 255),
        _bytes(gaussians.colours.cpu().numpy() * 255),
    ]
    about = {"count": len(places), "moving": moving, "keys": keys, "scales": scales}
    if nodes is None:
        away = paths - paths[0]
        step = 2 * float(np.abs(away).max(initial=0.0)) / STEPS or 1.0
        parts += [_words(way) for way in np.diff(np.round(away / step).astype(np.int64), axis=0)]
        about |= {"step": step}
    else:
        courses = torch.cat([nodes.quats, nodes.places], dim=2)[:, 1:]
        parts += [mine, courses.cpu().numpy().astype("<f4")]
        about |= {
            "nodes": courses.shape[1],
            "swept": _swept(places[:moving], mine, courses[..., 4:].numpy(force=True)),
        }
    return PackedSplats(about, zlib.compress(b"".join(part.tobytes() for part in parts), DEFLATE))


def _swept(
    places: Float[np.ndarray, "M 3"], node: UInt8[np.ndarray, " M"], middles: Float[np.ndarray, "K P 3"]
) -> list[list[float]]:
    """Ends of a box that holds what is on nodes, between the key times too: middles go straight, the rest turns."""
    if not len(places):
        return [[0.0] * 3, [0.0] * 3]
    radius = np.zeros(middles.shape[1])
    np.maximum.at(radius, node.astype(int) - 1, np.linalg.norm(places, axis=1))
    used, lo, hi = np.unique(node).astype(int) - 1, middles - radius[:, None], middles + radius[:, None]
    return [lo[:, used].min((0, 1)).tolist(), hi[:, used].max((0, 1)).tolist()]


def size_at_most(count: int, moving: int, keys: int, nodes: int = 0) -> int:
    """Bytes that splats take at most, packed; on as many nodes, if any."""
    motion = BYTES_PER_KEY * moving * max(0, keys - 1) if not nodes else moving + NODE_BYTES * nodes * keys
    return round(1.001 * (BYTES * count + motion)) + 64


def _words(codes: Int[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n6"]:
    """The low bytes of 16-bit numbers, then the high ones; negative numbers as two's complement."""
    flat = codes.reshape(-1)
    return np.concatenate([flat & 255, (flat >> 8) & 255]).astype(np.uint8)


def _bytes(values: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
