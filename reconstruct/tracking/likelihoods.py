"""How likely pictures are if a surface point is where it rests, and if something else is seen in its place.

A point's look is five numbers of the logarithm of brightness. Three are paint: fine pattern and two of chromaticity.
Two are light: coarse pattern and brightness, which shade changes, too. If the point is there, it looks as at rest up
to noise, or has its own paint in the light of its surroundings. If something else is there, it looks like any place
around the point or anywhere in the picture at rest: a kernel density (Parzen, 1962). Where surroundings look like the
point, both are equally likely and the picture tells nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.views.film import DARK, REFERENCE_SIDE, CameraFilm, blurred, sampled
from devrf.reconstruct.tracking.views.sight import Sight

MOMENTS = 24
# Standard deviations in pixels at the longest side `REFERENCE_SIDE`: the pattern between the first two is fine, that
# between the second and the third is coarse; a contact shadow is wider than fine pattern.
FINEST_PX, FINE_PX, COARSE_PX = 0.7, 2.0, 6.0
CHROMA_PX, BRIGHTNESS_PX = 1.5, 1.0
PAINT, BRIGHTNESS = 3, 4  # the first numbers are paint; the last is brightness
LEAST_NOISE = 0.01  # of a logarithm: 8 bits and compression
JITTER_PX = 0.15  # by which a place in a picture is known
AROUND, ANYWHERE = 32, 16  # places that something else may look like
NEAREST_PX, FARTHEST_PX = 2.0, 60.0  # of those around the point, evenly in the logarithm
KERNEL = 1.5  # width of the density's kernel, in standard deviations of the noise
LEAST = 1e-4  # density of any look, over that of the likeliest
UNEXPLAINED = 0.02  # share of looks of a point that is there that are as if something else were
OTHER_LIGHT = 0.5  # share of them in the light of the surroundings: light alone changes as likely as not
AT_ONCE = 1 << 16  # points that are looked up together, in half a gigabyte

Look = Float32[np.ndarray, "h w 5"]


@dataclass(frozen=True)
class Likelihoods:
    """Logarithms, of each camera, moment and surface point; 0 where a camera shows nothing of a point.

    Attributes:
        there: Of what is shown if the point is where it rests.
        other: If something else is seen there.
        known: Whether the camera saw the point at rest and has a picture of the moment.
    """

    there: Float32[np.ndarray, "cameras moments n"]
    other: Float32[np.ndarray, "cameras moments n"]
    known: Bool[np.ndarray, "cameras moments n"]


def likelihoods(surface: SurfacePoints, films: Sequence[CameraFilm], rest_time: float) -> Likelihoods:
    """Compare pictures of evenly spread moments with those at rest.

    Args:
        surface: At rest.
        films: Of the fixed cameras; what stands in them is not looked at.
        rest_time: Of the scene, in [0, 1].
    """
    moments = np.linspace(min(f.times[0] for f in films), max(f.times[-1] for f in films), MOMENTS)
    within = max(float(np.diff(f.times).max()) for f in films)
    shape = len(films), MOMENTS, len(surface)
    out = Likelihoods(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool))
    for c, film in enumerate(films):
        at_rest = film.nearest(rest_time, float(np.diff(film.times).max()))
        taken = [film.nearest(moment, within) for moment in moments]
        if at_rest is None:
            continue
        sight = Sight(film, surface)
        ids = np.flatnonzero(sight.seen)
        pictures = {n: _look(film, n) for n in taken if n is not None}
        if not len(ids) or not pictures:
            continue
        compared = _compared(film, _look(film, at_rest), pictures, sight.at[ids])
        for moment, n in enumerate(taken):
            if n is not None:
                out.there[c, moment, ids], out.other[c, moment, ids] = compared[n]
                out.known[c, moment, ids] = True
    return out


def _look(film: CameraFilm, n: int) -> Look:
    """Of every pixel of a picture."""
    scale = max(film.camera.width, film.camera.height) / REFERENCE_SIDE
    log = np.log(film.picture(n) + DARK)
    grey = log.mean(-1)
    middle = blurred(grey, FINE_PX * scale)
    chroma = blurred(log[..., ::2] - log[..., 1:2], CHROMA_PX * scale)
    fine, coarse = blurred(grey, FINEST_PX * scale) - middle, middle - blurred(grey, COARSE_PX * scale)
    return np.dstack([fine, chroma, coarse, blurred(grey, BRIGHTNESS_PX * scale)])


def _compared(
    film: CameraFilm, at_rest: Look, pictures: dict[int, Look], at: Float[np.ndarray, "p 2"]
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Of each picture the logarithms of how likely it is: points there, something else there."""
    apart = np.stack([look - at_rest for look in pictures.values()])
    exposures = np.median(apart[..., BRIGHTNESS], axis=(1, 2))
    apart[..., BRIGHTNESS] -= exposures[:, None, None]
    noise = np.maximum(1.4826 * np.median(np.abs(apart), axis=(0, 1, 2)), LEAST_NOISE)
    slope = np.stack([np.hypot(*np.gradient(at_rest[..., k])) for k in range(at_rest.shape[-1])], -1)
    noise = np.sqrt(noise**2 + (JITTER_PX * sampled(slope, at)) ** 2).astype(np.float32)
    out = {n: (np.empty(len(at), np.float32), np.empty(len(at), np.float32)) for n in pictures}
    for first in range(0, len(at), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        own, others = sampled(at_rest, at[some]), _others(film, at_rest, at[some])
        for (n, picture), exposure in zip(pictures.items(), exposures, strict=True):
            now = sampled(picture, at[some])
            now[:, BRIGHTNESS] -= exposure
            paint, light = _agree((now - own) / noise[some])
            paints, lights = _agree((now[:, None] - others) / (KERNEL * noise[some, None]))
            other = np.maximum((paints * lights).mean(1), LEAST)
            lit = (1 - OTHER_LIGHT) * light + OTHER_LIGHT * np.maximum(lights.mean(1), LEAST)
            there = (1 - UNEXPLAINED) * paint * lit + UNEXPLAINED * other
            out[n][0][some], out[n][1][some] = np.log(there), np.log(other)
    return out


def _others(film: CameraFilm, at_rest: Look, at: Float[np.ndarray, "p 2"]) -> Float32[np.ndarray, "p k 5"]:
    """What something else at each point may look like."""
    rng = np.random.default_rng(0)
    size = np.array([film.camera.width, film.camera.height])
    scale = size.max() / REFERENCE_SIDE
    nearest, farthest = np.log([NEAREST_PX * scale, FARTHEST_PX * scale])
    away = np.exp(rng.uniform(nearest, farthest, (len(at), AROUND)))
    angle = rng.uniform(0, 2 * np.pi, (len(at), AROUND))
    around = at[:, None] + away[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    around = around.clip(0.5, size - 0.5)  # centres of pixels
    anywhere = rng.uniform(0.5, size - 0.5, (len(at), ANYWHERE, 2))
    places = np.concatenate([around, anywhere], axis=1)
    return sampled(at_rest, places.reshape(-1, 2)).reshape(*places.shape[:2], -1)


def _agree(off: Float32[np.ndarray, "... 5"]) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians, 1 at most, of differences in standard deviations: of paint and of light."""
    square = off**2
    return np.exp(-0.5 * square[..., :PAINT].sum(-1)), np.exp(-0.5 * square[..., PAINT:].sum(-1))
