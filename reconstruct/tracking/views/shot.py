"""What one picture says of the points that its camera sees, and of where they should be."""

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.reconstruct.tracking.offsets import Shown
from devrf.reconstruct.tracking.solver.quadratics import SeenPoints, Sum, derivative, huber_weight
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.views.film import Picture, blurred, sampled
from devrf.reconstruct.tracking.views.sight import Sight
from devrf.reconstruct.tracking.views.templates import LIKE_PX, Templates

LEAST_SIGMA = 0.7  # of a picture that is not blurred, as a weight
CONTRAST = 20.0  # pixels that a brightness of 1 (of the logarithm) is worth
HUBER_FLOW, HUBER_DRAWN, HUBER_CONTRAST = 1.0, 1.5, 0.1  # pixels, pixels, brightness
HUBER_SHOWN = 5.0  # pixels: clocks that are wrong leave more than tracks that are
FEWEST_SEEN, FEWEST_ASKED = 20, 5  # points, of which a camera says something; of those that are asked about
MARGIN_PX = 48  # around points that are asked about
DISTINCT = 0.1  # contrast between a point and what stands behind that tells them apart


class _Contrast(NamedTuple):
    """Brightness of a drawn and of a real picture at points, to first order around their pixels."""

    apart: Float[np.ndarray, "m 3"]
    slope: Float[np.ndarray, "m 3 2"]
    weight: float


class _Placed(NamedTuple):
    """Where optical flow finds points in a picture, in pixels."""

    points: Int[np.ndarray, " m"]
    target: Float[np.ndarray, "m 2"]
    weight: Float[np.ndarray, " m"]


class _Drawn(NamedTuple):
    """Points that were drawn, at which pixels, how they should look there, and contrasts to the real picture."""

    points: Int[np.ndarray, " m"]
    at: Float[np.ndarray, "m 2"]
    look: Float[np.ndarray, "m 3"]
    contrasts: list[_Contrast]


_NOTHING = _Placed(np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0))
_NOT_DRAWN = _Drawn(_NOTHING.points, _NOTHING.target, np.zeros((0, 3)), [])


class Shot:
    """One picture at one moment: what it says of the points that its camera sees.

    It is asked about points at the moment. The picture is taken when they have gone a `share` of their way to there.
    """

    def __init__(self, camera: int, templates: Templates, n: int, share: float, before: np.ndarray) -> None:
        """Picture `n` of a camera; `before`: the points at the moment before [p, 3]."""
        self.camera, self.templates, self.film = camera, templates, templates.film
        self.n, self.share, self._before = n, share, before
        self.came = self.flow = _NOTHING
        self.drawn = _NOT_DRAWN

    def sight(self, surface: SurfacePoints) -> Sight:
        """What the camera sees of the points."""
        return Sight(self.film, replace(surface, xyz=self._taken(surface.xyz)))

    def _taken(self, xyz: np.ndarray) -> np.ndarray:
        """Where points are when the picture is taken."""
        return self._before + self.share * (xyz - self._before)

    def come(self, begin: int, surface: SurfacePoints, known: np.ndarray, far: bool = False) -> None:
        """Where optical flow brings `known` points from picture `begin`, in which they are at `surface`, to this one.

        It goes from picture to picture. `far`: by flow that finds longer ways and is less exact. What else was known of
        the picture is forgotten.
        """
        self.drawn, self.flow = _NOT_DRAWN, _NOTHING
        sight = Sight(self.film, surface)
        points = np.flatnonzero(sight.seen & known)
        if len(points) < FEWEST_SEEN:
            return
        film, at, off = self.film, sight.at[points], np.zeros(len(points), np.float32)
        high = film.wide if far else film.sharp
        for n in range(begin, self.n):
            flow, missed = film.flow(*(film.for_flow(film.picture(k), high(k)) for k in (n, n + 1)))
            off += sampled(missed, at) ** 2
            at = at + sampled(flow, at)
        self.came = _Placed(points, at, np.exp(-off))

    def look(
        self,
        surface: SurfacePoints,
        sigmas: tuple[float, ...],
        asked: Bool[np.ndarray, " p"] | None = None,
        again: bool = False,
    ) -> None:
        """Draw what the picture should show with points at `surface`, and hold it against the picture.

        `again`: they hardly moved since the last time, so what flow found then stays. Where only some points are asked
        about, what is around them is looked at, and nothing else is said.
        """
        sight = self.sight(surface)
        points, fewest = self.templates.known(sight), FEWEST_SEEN
        if asked is not None:
            points, fewest = points[asked[points]], FEWEST_ASKED
        if len(points) < fewest:
            self.drawn = _NOT_DRAWN
            self.flow = self.flow if again else _NOTHING
            return
        at = sight.at[points]
        first, cut = np.zeros(2), np.s_[:, :]
        if asked is not None:
            self.came = _NOTHING
            first = np.maximum(at.min(0) - MARGIN_PX, 0).astype(int)
            last = (at.max(0) + MARGIN_PX).astype(int)
            cut = np.s_[first[1] : last[1], first[0] : last[0]]
        film, picture = self.film, self.templates.draw(sight, surface.rgb.astype(np.float32))[cut]
        drawn, real = film.high_pass(picture), np.ascontiguousarray(film.sharp(self.n)[cut])
        inside = at - first
        if not again:
            flow, missed = film.flow(
                film.for_flow(picture, drawn), film.for_flow(film.picture(self.n)[cut], real)
            )
            weight = np.exp(-(sampled(missed, inside) ** 2))
            self.flow = _Placed(points, at + sampled(flow, inside), weight)
        contrasts = []
        for sigma in sigmas:
            one, other = blurred(drawn, sigma), blurred(real, sigma)
            along, down = np.gradient(one + other, axis=1), np.gradient(one + other, axis=0)
            gradient = 0.5 * np.stack([along, down], -1)
            slope = sampled(gradient.reshape(*one.shape[:2], -1), inside).reshape(-1, 3, 2)
            apart = sampled(other, inside) - sampled(one, inside)
            contrasts.append(_Contrast(apart, slope, max(sigma, LEAST_SIGMA)))
        self.drawn = _Drawn(points, at, sampled(blurred(drawn, LIKE_PX), inside), contrasts)

    def likeness(self, xyz: np.ndarray) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Points, and whether the picture shows them, at `xyz`, 1, or what stands behind them, -1.

        Only of points that were drawn when it was last looked at, and look other than what stands.
        """
        points, look = self.drawn.points, self.drawn.look
        if not len(points):
            return points, np.zeros(0)
        at = self.film.camera.project(self._taken(xyz)[points])
        behind = sampled(self.templates.behind, at)
        real = sampled(self._even, at)
        apart = np.linalg.norm(look - behind, axis=1)
        vote = np.linalg.norm(real - behind, axis=1) - np.linalg.norm(real - look, axis=1)
        telling = (apart > DISTINCT) & np.isfinite(at).all(1)
        return points[telling], (vote[telling] / apart[telling]).clip(-1, 1)

    def shown(self, xyz: np.ndarray, known: np.ndarray) -> Shown:
        """Where the picture shows `known` points that are expected at `xyz`."""
        xyz = self._taken(xyz)
        points, target, weight = (values[known[self.flow.points]] for values in self.flow)
        left = target - self.film.camera.project(xyz[points])
        weight = weight * huber_weight(np.linalg.norm(left, axis=1), HUBER_SHOWN)
        fine = np.isfinite(left).all(1)
        return Shown(*(x[fine] for x in (points, left, derivative(self.film.camera, xyz[points]), weight)))

    @cached_property
    def _even(self) -> Picture:
        """The picture as points are compared with it."""
        return blurred(self.film.sharp(self.n), LIKE_PX)

    def pull(self, xyz: np.ndarray, pulls: Sum) -> None:
        """Add what the picture wants of points that are at `xyz`."""
        xyz = self._taken(xyz)
        for placed, huber in ((self.came, HUBER_FLOW), (self.flow, HUBER_DRAWN)):
            pulls.add_places(self._seen(placed.points, xyz), placed.target, placed.weight, huber)
        seen = self._seen(self.drawn.points, xyz)
        for contrast in self.drawn.contrasts:
            weight = contrast.weight * CONTRAST**2
            pulls.add_brightness(seen, contrast.apart, contrast.slope, self.drawn.at, weight, HUBER_CONTRAST)

    def _seen(self, points: Int[np.ndarray, " m"], xyz: np.ndarray) -> SeenPoints:
        camera = self.film.camera
        return SeenPoints(points, xyz[points], camera.project(xyz[points]), camera, self.share)
