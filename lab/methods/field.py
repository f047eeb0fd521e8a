"""Volume rendering of a field, and training it within a budget: what all neural fields here share.

Quadrature as in NeRF (Mildenhall et al. 2020, Eq. 3). Samples are drawn twice, evenly, and then where the first ones
found something (Section 5.2); one network does both, the first without gradients.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn

from devrf.capture.camera import Camera
from devrf.lab.methods.clock import TrainingClock
from devrf.lab.methods.method_table import Regime, Size
from devrf.lab.methods.pictures import Space, TaskPictures, at_rest
from devrf.lab.methods.protocol import MethodTask, TimeBudget
from devrf.reconstruct.rendering.rays import RayBatch, camera_rays

AT_ONCE = 4096  # rays of a picture
BYTES = 4  # of a parameter
SHARP = 10.0  # density per unit of a network's output: surfaces are thin beside the box


@dataclass(frozen=True)
class FieldPoints:
    """Where and when a field is asked.

    Attributes:
        x: Places in [-1, 1].
        d: Unit directions of view.
        time: In [0, 1].
        rest: 1 where the scene is at rest, else 0.
    """

    x: Float[Tensor, "n 3"]
    d: Float[Tensor, "n 3"]
    time: Float[Tensor, " n"]
    rest: Float[Tensor, " n"]

    def only(self, where: Bool[Tensor, " n"]) -> "FieldPoints":
        """Those that are marked."""
        return FieldPoints(self.x[where], self.d[where], self.time[where], self.rest[where])


@dataclass(frozen=True)
class Sampled:
    """What a field says of points.

    Attributes:
        density: Per box unit, at least 0.
        rgb: In [0, 1].
        more: What the method's own losses need, by name [n, ...].
    """

    density: Float[Tensor, " n"]
    rgb: Float[Tensor, "n 3"]
    more: dict[str, Tensor]


@dataclass(frozen=True)
class RenderedRays:
    """Rays as they look.

    Attributes:
        rgb: Colours.
        depth: Distances along the rays.
        weights: Of the samples.
        t: Their distances.
        x: Their places in [-1, 1].
        more: Of the samples, by name.
    """

    rgb: Float[Tensor, "R 3"]
    depth: Float[Tensor, " R"]
    weights: Float[Tensor, "R n"]
    t: Float[Tensor, "R n"]
    x: Float[Tensor, "R n 3"]
    more: dict[str, Tensor]


@dataclass(frozen=True)
class Settings:
    """How a field is trained.

    Attributes:
        rays: In each step.
        samples: Along a ray: drawn evenly, drawn where the first ones found something.
        rate, last_rate: Of Adam, at the beginning and at the end of the budget, falling exponentially.
        static_share: Of the rays in the sweep's pictures, in regime `joint`.
    """

    rays: int
    samples: tuple[int, int]
    rate: float
    last_rate: float
    static_share: float = 0.5


class RadianceField(nn.Module, ABC):
    """Density and colour of places at times; a method is one of these, with losses of its own.

    Attributes:
        one_moment: Whether each step has pictures of one moment only, because a moment costs much.
    """

    one_moment = False

    @abstractmethod
    def forward(self, points: FieldPoints) -> Sampled:
        """What is there."""

    def losses(self, field: "FieldTraining", rays: RayBatch, seen: RenderedRays) -> dict[str, Tensor]:
        """The method's own losses, weighted, beside that of colours."""
        return {}

    def advance(self, share: float) -> None:
        """So much of the budget is over: anneal."""

    def rates(self) -> list[tuple[float, list[nn.Parameter]]]:
        """Parameters by the share of the rate by which they are trained."""
        return [(1.0, list(self.parameters()))]

    def still(self) -> nn.ParameterList | list[nn.Parameter]:
        """Parameters of what stands, which regime `two-stage` trains first and then keeps."""
        return []

    def weights(
        self, density: Float[Tensor, "R n"], t: Float[Tensor, "R n"], last: Float[Tensor, " R"]
    ) -> Float[Tensor, "R n"]:
        """Of samples at rising distances `t`, the last of which reaches to `last`."""
        return quadrature(density, t, last)


def spread_out(values: Float[Tensor, "k ..."], where: Bool[Tensor, " n"]) -> Float[Tensor, "n ..."]:
    """Values at the marked places among zeros."""
    out = values.new_zeros(len(where), *values.shape[1:])
    out[where] = values
    return out


def dense(raw: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """A network's output as a density per box unit: a haze at first."""
    return SHARP * nn.functional.softplus(raw - 2)


def quadrature(
    density: Float[Tensor, "R n"], t: Float[Tensor, "R n"], last: Float[Tensor, " R"]
) -> Float[Tensor, "R n"]:
    """Weights of samples at rising distances `t`; the last one reaches to `last`."""
    gaps = torch.diff(t, dim=1, append=last[:, None]).clamp(min=0)
    alpha = 1 - torch.exp(-density * gaps)
    left = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-10], 1), 1)
    return alpha * left[:, :-1]


def drawn_again(
    steps: Float[Tensor, "R n"], weights: Float[Tensor, "R n"], more: int, generator: torch.Generator | None
) -> Float[Tensor, "R m"]:
    """Places in [0, 1] drawn in proportion to weights around `steps`; evenly spaced ones without a generator."""
    edges = torch.cat([torch.zeros_like(steps[:, :1]), (steps[:, 1:] + steps[:, :-1]) / 2], 1)
    edges = torch.cat([edges, torch.ones_like(steps[:, :1])], 1)
    share = weights + 1e-3 / weights.shape[1]
    below = torch.cumsum(share / share.sum(1, keepdim=True), 1)
    below = torch.cat([torch.zeros_like(below[:, :1]), below], 1)
    if generator is None:
        u = (torch.arange(more, device=steps.device) + 0.5).expand(len(steps), more) / more
    else:
        u = (torch.arange(more) + torch.rand(len(steps), more, generator=generator)).to(steps) / more
    at = torch.searchsorted(below, u.contiguous(), right=True).clamp(1, steps.shape[1])
    low, high = below.gather(1, at - 1), below.gather(1, at)
    within = ((u - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)
    return torch.lerp(edges.gather(1, at - 1), edges.gather(1, at), within)


class FieldTraining:
    """A field with the pictures it is trained on.

    Attributes:
        field: The method.
        pictures, space: Of the task.
        settings: How it is trained.
    """

    def __init__(
        self, task: MethodTask, field: RadianceField, pictures: TaskPictures, settings: Settings
    ) -> None:
        self.task, self.pictures, self.settings = task, pictures, settings
        self.field = field.to(task.device)
        self.space = Space.of(task)
        self.generator = torch.Generator().manual_seed(task.seed)

    def seen(self, rays: RayBatch, t: Float[Tensor, "R n"]) -> tuple[Sampled, Float[Tensor, "R n 3"]]:
        """What the field says of places at distances along rays, and these places."""
        n = t.shape[1]
        x = self.space.contracted((rays.rays_o[:, None] + rays.rays_d[:, None] * t[..., None]).reshape(-1, 3))
        each = (rays.rays_d, rays.time, (rays.frame < 0).to(rays.rays_o))
        points = FieldPoints(x, *(value.repeat_interleave(n, 0) for value in each))
        return self.asked(points), x.reshape(-1, n, 3)

    def asked(self, points: FieldPoints) -> Sampled:
        """What the field says of points; where nothing can be, it is not asked."""
        where = self.space.may_hold(points.x)
        where[:1] = True  # a field is asked of something
        if bool(where.all()):
            return self.field(points)
        found = self.field(points.only(where))
        more = {name: spread_out(v, where) if v.ndim else v for name, v in found.more.items()}
        return Sampled(spread_out(found.density, where), spread_out(found.rgb, where), more)

    def rendered(self, rays: RayBatch, jitter: bool) -> RenderedRays:
        """Rays as they look; with `jitter` samples are drawn at random."""
        even, more = self.settings.samples
        R, last = len(rays.time), self.last(rays)
        middle = torch.rand(R, even, generator=self.generator).to(rays.rays_o) if jitter else 0.5
        steps = (torch.arange(even).to(rays.rays_o) + middle) / even
        steps = steps.expand(R, even)
        if more:
            with torch.no_grad():
                t = self.space.distances(rays.rays_o, rays.rays_d, steps)
                found, _ = self.seen(rays, t)
                weights = self.field.weights(found.density.reshape(R, even), t, last)
            again = drawn_again(steps, weights, more, self.generator if jitter else None)
            steps = torch.cat([steps, again], 1).sort(1)[0]
        t = self.space.distances(rays.rays_o, rays.rays_d, steps)
        found, x = self.seen(rays, t)
        weights = self.field.weights(found.density.reshape(R, -1), t, last)
        rgb, depth = self.composed(weights, found.rgb.reshape(R, -1, 3), t)
        return RenderedRays(rgb, depth, weights, t, x, found.more)

    def composed(
        self, weights: Float[Tensor, "R n"], rgb: Float[Tensor, "R n 3"], t: Float[Tensor, "R n"]
    ) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"]]:
        """Colours and distances of rays, before the plain background where there is one."""
        colour = (weights[..., None] * rgb).sum(1)
        if self.space.behind is not None:
            colour = colour + (1 - weights.sum(1, keepdim=True)) * self.space.behind
        return colour, (weights * t).sum(1)

    def last(self, rays: RayBatch) -> Float[Tensor, " R"]:
        """Where the last sample of each ray ends."""
        return self.space.distances(rays.rays_o, rays.rays_d, torch.ones_like(rays.time)[:, None])[:, 0]

    def train(self, budget: TimeBudget) -> "TrainedField":
        """Train until the budget is spent.

        Raises:
            Diverged: The loss is no number.
        """
        model, clock = TrainedField(self), TrainingClock(budget, self.task.device)
        if self.task.regime == "two-stage":
            self._stage(clock, 1.0, 0.5, model)
            for parameter in self.field.still():
                parameter.requires_grad_(False)
            self._stage(clock, 0.0, 1.0, model)
        else:
            self._stage(clock, self.settings.static_share, 1.0, model)
        return model

    def _stage(self, clock: TrainingClock, static_share: float, until: float, model: "TrainedField") -> None:
        """Train until a share of the budget is spent, with so large a share of rays in the sweep's pictures."""
        settings, fall = self.settings, self.settings.last_rate / self.settings.rate
        groups = [
            {"params": [p for p in of if p.requires_grad], "lr": settings.rate * rate}
            for rate, of in self.field.rates()
        ]
        optimiser = torch.optim.Adam([g for g in groups if g["params"]], betas=(0.9, 0.99), eps=1e-15)
        first = [group["lr"] for group in optimiser.param_groups]
        while (share := clock.share) < until:
            for group, rate in zip(optimiser.param_groups, first, strict=True):
                group["lr"] = rate * fall**share
            self.field.advance(share)
            optimiser.zero_grad()
            rays = self.pictures.draw(settings.rays, self.generator, static_share, self.field.one_moment)
            loss = self.loss(rays)
            loss.backward()
            optimiser.step()
            clock.step(model, settings.rays, loss)

    def loss(self, rays: RayBatch) -> Float[Tensor, ""]:
        """Of a batch: squared errors of colours, and the method's own."""
        seen = self.rendered(rays, jitter=True)
        own = self.field.losses(self, rays, seen)
        return sum(own.values(), start=((seen.rgb - rays.rgb) ** 2).mean())


class TrainedField:
    """A field that renders."""

    def __init__(self, training: FieldTraining) -> None:
        self.training = training

    @property
    def megabytes(self) -> float:
        """Of its parameters."""
        return BYTES * sum(p.numel() for p in self.training.field.parameters()) / 1e6

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float | None
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Colours and distances of a camera in the box frame."""
        training = self.training
        o, d = camera_rays(camera, training.task.device)
        moment = training.pictures.rest_time if time is None else time
        colours, depths = [], []
        for origin, direction in zip(o.split(AT_ONCE), d.split(AT_ONCE), strict=True):
            times = torch.full_like(origin[:, 0], moment)
            numbers = torch.zeros_like(times, dtype=torch.int64)  # of pixels and pictures: not asked here
            rays = RayBatch(origin, direction, torch.zeros_like(origin), None, times, numbers, numbers)
            rays = at_rest(rays, moment) if time is None else rays
            seen = training.rendered(rays, jitter=False)
            colours.append(seen.rgb)
            depths.append(seen.depth)
        size = camera.height, camera.width
        rgb = torch.cat(colours).clamp(0, 1).reshape(*size, 3).cpu().numpy()
        return rgb, torch.cat(depths).reshape(size).cpu().numpy()


@dataclass(frozen=True)
class FieldMethod:
    """A method that is a field.

    Attributes:
        make: The field for a task and its pictures.
        settings: How it is trained, by size.
        regimes: Those that it has.
        only_plain: Why it needs a plain background; None: it does not.
    """

    make: Callable[[MethodTask, TaskPictures], RadianceField]
    settings: Mapping[Size, Settings]
    regimes: Sequence[Regime] = ("joint", "two-stage", "dynamic")
    only_plain: str | None = None

    def why_not(self, task: MethodTask) -> str | None:
        """Why it cannot do a task; None: it can."""
        return self.only_plain if task.scene.background == "shell" else None

    def train(self, task: MethodTask, budget: TimeBudget) -> TrainedField:
        """Train it."""
        torch.manual_seed(task.seed)
        pictures = TaskPictures(task)
        return FieldTraining(task, self.make(task, pictures), pictures, self.settings[task.size]).train(
            budget
        )
