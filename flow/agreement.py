"""Do two pictures agree with a flow between them? What following it leaves of their difference, told in pixels.

A vector that is off by d leaves about d times the picture's slope. So over a patch, the variance of what following the
flow leaves over that of the slopes is how far its vectors are off; the same of standing still is how far they have to
go. A vector is believed by the share of that way which it explains, if that is most of it: one that leads the wrong
way, nowhere, or anywhere explains next to nothing. Variances, because a patch as a whole may get brighter: shading
changes as things turn.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.ndimage import convolve, uniform_filter

from devrf.flow.checks import MOVING_PX
from devrf.flow.consistency import luma, warp
from devrf.flow.pair import LEAST_NOISE

WINDOW = 7  # pixels of the training size, in which all that a patch holds moves alike
TELLING = 2.0  # times the noise's variance that slopes must have: their own noise is half of it
# Answers to noise, and to no slope or bend along an axis (Immerkaer, Fast noise variance estimation, CVIU 1996).
ROUGH = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32) / 6
KNOWN = 0.5  # share of a patch that must have flow, to be asked
BELIEVED = 0.5  # share of the squared way that a vector has to explain, not to be contradicted
# Share of the vectors asked, of a pair or a camera, from which none is believed. True flow of a subject of a dozen
# pixels is contradicted for up to 55 % (silhouettes jump), reversed for 92 % or more.
MOSTLY_CONTRADICTED = 0.75


@dataclass(frozen=True)
class Agreement:
    """How far two pictures agree with a flow from the one to the other.

    Attributes:
        weight: By which a vector is to be believed, from BELIEVED to 1; 0 where it is contradicted [h, w].
        asked: Pixels whose flow is valid, and where pictures or flow say that something moves.
        contradicted: Of these, those whose vector pictures do not bear out.
    """

    weight: Float32[np.ndarray, "h w"]
    asked: int
    contradicted: int


def agreement(
    current: UInt8[np.ndarray, "h w 3"],
    previous: UInt8[np.ndarray, "h w 3"],
    flow: Float32[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
) -> Agreement:
    """Ask the pictures about each vector; where they have too little texture to tell, the pair as a whole answers.

    Args:
        current, previous: The pictures.
        flow: From the current picture to the previous one, pixels.
        valid: Where there is flow.
    """
    now, then = luma(current), luma(previous)
    left, apart = now - warp(then, flow), now - then
    # Three answers of which each is too high where something moves, the flow is wrong, or texture is fine.
    of_noise = (
        max(LEAST_NOISE, min(_spread(left), _spread(apart), math.sqrt(2) * _spread(convolve(now, ROUGH))))
        ** 2
    )
    known = uniform_filter(valid.astype(np.float32), WINDOW, mode="nearest")
    slopes = sum(_variance(slope, valid, known) for slope in np.gradient(now)) / 2 - of_noise / 2
    tells = (slopes > TELLING * of_noise / 2) & (known >= KNOWN)
    off, way = (np.maximum(_variance(x, valid, known) - of_noise, 0) for x in (left, apart))
    moving = np.maximum(way, MOVING_PX**2 * slopes)  # what moves less is not told from standing still
    asked = valid & tells & (np.maximum(off, way) > MOVING_PX**2 * slopes)
    weight = np.clip(1 - off / np.maximum(moving, 1e-6), 0, 1)
    whole = 1 - float(off[asked].sum()) / float(moving[asked].sum()) if asked.any() else 1.0
    weight = np.where(tells, weight, whole)
    weight = np.where(weight < BELIEVED, 0, weight).astype(np.float32)
    return Agreement(weight, int(asked.sum()), int((asked & (weight == 0)).sum()))


def _spread(x: Float32[np.ndarray, "h w"]) -> float:
    """Standard deviation around 0 of all but what differs."""
    return 1.4826 * float(np.median(np.abs(x)))


def _variance(
    x: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"], known: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Of each pixel's patch, over what has flow: what is hidden says nothing about vectors beside it."""
    share = np.maximum(known, 1e-6)
    mean, square = (uniform_filter(np.where(valid, y, 0), WINDOW, mode="nearest") / share for y in (x, x * x))
    return np.maximum(square - mean * mean, 0)
