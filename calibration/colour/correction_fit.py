"""The simplest linear correction that two cameras' colours of the same points support.

Candidates, from simple to rich: none, one gain, three gains, a 3×3 matrix, all in linear light. Each is fitted to log
light with a Cauchy loss: relative errors count, points that shine or are mistaken do not pull. A richer one is taken
only where it predicts points that it has not seen better, clearly and by an amount that is worth it.

A matrix is fitted both ways, forth to the reference and back: noise in the colours that a fit starts from makes a
one-way fit lose saturation, and where most points are grey almost all of it. A prior holds what points leave open.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from devrf.capture.colour.srgb import srgb_from_linear

Kind = Literal["none", "gain", "diagonal", "matrix"]

FLOOR = 0.01  # added to linear light before the logarithm: 8-bit steps and black levels below it do not count
LEAST = 1e-3  # linear light, 3 of 255: keeps the logarithm of a dark channel finite
# 10 % of the light: what angle of view and shading leave between two views of a matt surface
LOSS_SCALE = 0.1
FOLDS = 4
WORTH = 0.05  # a richer correction must lower the error by this share ...
SIGMAS = 2.0  # ... and by this many standard errors of the difference
MIXING = 0.1  # share of one channel in another by which sRGB cameras differ: prior of a matrix
UNKNOWNS = {"none": 0, "gain": 1, "diagonal": 3, "matrix": 9}
SPARE = 1.2  # points that say something of their own, for each unknown


@dataclass(frozen=True)
class ColourCorrection:
    """Linear light of the reference = matrix · linear light of the camera.

    Attributes:
        kind: What was fitted.
        matrix: It [3, 3].
    """

    kind: Kind
    matrix: Float[np.ndarray, "3 3"]


def fit_correction(
    colours: Float[np.ndarray, "n 3"],
    wanted: Float[np.ndarray, "n 3"],
    place: Float[np.ndarray, "n 2"],
    alike: int,
) -> ColourCorrection:
    """Fit the correction that takes `colours` to `wanted`.

    Args:
        colours, wanted: Linear light of the same points in the camera and in the reference.
        place: Where the camera sees them, shares of its width: neighbours are held back together.
        alike: Points that say as much as one alone.
    """
    kinds = [kind for kind in get_args(Kind) if len(colours) >= needed(kind, alike)]
    fold = folds(place, FOLDS)
    seen_not = {kind: _predicted_error(colours, wanted, fold, kind, alike) for kind in kinds}
    best: Kind = "none"
    for kind in kinds[1:]:
        gained = seen_not[best] - seen_not[kind]
        if gained.mean() > max(WORTH * seen_not[best].mean(), SIGMAS * gained.std() / np.sqrt(len(gained))):
            best = kind
    return ColourCorrection(best, _fitted(colours, wanted, best, alike))


def needed(kind: Kind, alike: int) -> float:
    """Fewest points that a correction is fitted to."""
    return SPARE * alike * UNKNOWNS[kind]


def brighter_by(
    colours: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "n 3"], alike: int
) -> tuple[float, float]:
    """By how much a camera is brighter, stops (log2 of green light, the median), and its standard deviation."""
    own, other = (np.log2(np.maximum(c[:, 1], LEAST)) for c in (colours, wanted))
    stops = own - other
    spread = 1.4826 * np.median(np.abs(stops - np.median(stops)))
    independent = max(1.0, len(stops) / alike)
    return float(np.median(stops)), float(spread * np.sqrt(np.pi / 2 / independent))


def difference(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How far two colours in linear light lie apart, as root mean square over sRGB channels in [0, 1]."""
    apart = srgb_from_linear(np.clip(a, 0, 1)) - srgb_from_linear(np.clip(b, 0, 1))
    return np.sqrt(np.square(apart).mean(axis=1))


def folds(place: Float[np.ndarray, "n 2"], count: int) -> Int[np.ndarray, " n"]:
    """A number below `count` for each point; the same within a tile of a sixteenth of the picture's width."""
    tile = np.floor(16 * place).astype(int)
    return (tile[:, 0] + 2 * tile[:, 1] + tile[:, 1] // count) % count


def _predicted_error(
    colours: Float[np.ndarray, "n 3"],
    wanted: Float[np.ndarray, "n 3"],
    fold: Int[np.ndarray, " n"],
    kind: Kind,
    alike: int,
) -> Float[np.ndarray, " n"]:
    """Error of each point under a fit to the points of the other folds."""
    error = np.zeros(len(colours))
    for held in np.unique(fold):
        out = fold == held
        matrix = _fitted(colours[~out], wanted[~out], kind, alike)
        error[out] = difference(colours[out] @ matrix.T, wanted[out])
    return error


def _fitted(
    colours: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "n 3"], kind: Kind, alike: int
) -> Float[np.ndarray, "3 3"]:
    """The matrix of one kind."""
    if kind == "none" or not len(colours):
        return np.eye(3)
    shift = np.median(_log(wanted) - _log(colours), axis=0)
    if kind == "gain":
        start = np.exp(np.median(shift, keepdims=True))
    else:
        start = np.exp(shift) if kind == "diagonal" else np.diag(np.exp(shift)).ravel()
    noise = 1.4826 * float(np.median(np.abs(_log(wanted) - _log(colours) - shift)))
    weight = np.sqrt(alike) * noise / MIXING  # a point is worth 1 / (alike · noise²), the prior 1 / MIXING²

    def residual(values: np.ndarray) -> np.ndarray:
        matrix = _matrix(values)
        forth = _log(colours @ matrix.T) - _log(wanted)
        back = _log(wanted @ np.linalg.inv(matrix).T) - _log(colours)
        mixing = matrix / np.maximum(np.diag(matrix), 1e-3)[:, None] - np.eye(3)
        return np.concatenate([forth.ravel(), back.ravel(), weight * mixing.ravel()])

    return _matrix(least_squares(residual, start, loss=_loss, f_scale=LOSS_SCALE).x)  # pyright: ignore[reportArgumentType]: a function will do


def _loss(z: Float[np.ndarray, " m"]) -> Float[np.ndarray, "3 m"]:
    """Cauchy's loss of squared residuals, and its derivatives; plain squares for the prior, which is last."""
    rho = np.stack([np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2])
    rho[:, -9:] = np.stack([z[-9:], np.ones(9), np.zeros(9)])
    return rho


def _matrix(values: np.ndarray) -> np.ndarray:
    return values.reshape(3, 3) if len(values) == 9 else np.diag(np.broadcast_to(values, 3))


def _log(light: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    return np.log(np.maximum(light, 0) + FLOOR)
