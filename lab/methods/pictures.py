"""The pictures of a task as rays to train on, and the space that rays go through."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.scene import Scene, plain_colour
from devrf.lab.methods.protocol import Task
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.pixel_flow import PixelFlow

OUTER = 1e3  # box units: surroundings end here


@dataclass(frozen=True)
class Rays:
    """Rays to train on or to render.

    Attributes:
        o, d: Origins and unit directions.
        time: In [0, 1].
        rest: Whether the scene is at rest: nothing has moved then, whatever `time` says.
        rgb: True colours; None where they are not known.
        frame: Picture of each ray among its task's moving pictures, and its pixel there; -1 in the sweep.
        pixel: See `frame`.
    """

    o: Float[Tensor, "R 3"]
    d: Float[Tensor, "R 3"]
    time: Float[Tensor, " R"]
    rest: Bool[Tensor, " R"]
    rgb: Float[Tensor, "R 3"] | None = None
    frame: Int[Tensor, " R"] | None = None
    pixel: Int[Tensor, " R"] | None = None


class Pictures:
    """Training pictures of a task.

    Attributes:
        moments: Times of the moving cameras' pictures, each once, rising.
        rest_time: Time at which the sweep shows the scene: when the clips show it so, else the first moment.
        flow: Of the moving pictures; None where there is none.
    """

    def __init__(self, task: Task) -> None:
        scene = task.boxed

        def rays(frames: tuple) -> RaySet | None:
            mine = tuple(f for f in frames if f.split == "train")
            return RaySet(mine, scene.image_scale, scene.background, task.device) if mine else None

        self.static = None if task.regime == "dynamic" else rays(scene.static)
        moving = rays(scene.dynamic)
        assert moving is not None  # a benchmark's scene has cameras in motion to train on
        self.moving = moving
        self.moments: Float[Tensor, " t"] = self.moving.times.unique()
        self.rest_time = float(self.moments[0]) if scene.rest_time is None else scene.rest_time
        found = PixelFlow(self.moving, task.flows)
        self.flow = found if found.pictures else None

    def draw(self, n: int, generator: torch.Generator, static_share: float, one_moment: bool = False) -> Rays:
        """Draw `n` rays, a share of them of the sweep where there is one; those in motion of all moments, or of one."""
        still = round(n * static_share) if self.static is not None else 0
        parts = []
        if still and self.static is not None:
            batch = self.static.draw(still, generator)
            parts.append((batch, torch.full_like(batch.time, self.rest_time), True))
        if n > still:
            batch = self.moving.draw(n - still, generator, self._of_one(generator) if one_moment else None)
            parts.append((batch, batch.time, False))

        def joined(values: list[Tensor]) -> Tensor:
            return torch.cat(values)

        return Rays(
            joined([b.rays_o for b, _, _ in parts]),
            joined([b.rays_d for b, _, _ in parts]),
            joined([time for _, time, _ in parts]),
            joined([torch.full_like(time, rest, dtype=torch.bool) for _, time, rest in parts]),
            joined([b.rgb for b, _, _ in parts]),
            joined([torch.full_like(b.frame, -1) if rest else b.frame for b, _, rest in parts]),
            joined([b.pixel for b, _, _ in parts]),
        )

    def _of_one(self, generator: torch.Generator) -> Int[Tensor, " f"]:
        """Pictures of a moment drawn at random."""
        moment = self.moments[int(torch.randint(len(self.moments), (1,), generator=generator))]
        return (self.moving.times == moment).nonzero()[:, 0]


@dataclass(frozen=True)
class Space:
    """Where along rays something may be.

    Attributes:
        low, high: Corners of the box.
        near: Nearest content, box units.
        behind: Colour behind a subject before a plain background; None: real surroundings.
    """

    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]
    near: float
    behind: Float[Tensor, " 3"] | None

    @staticmethod
    def of(scene: Scene, device: str) -> "Space":
        """That of a scene in its box frame."""
        colour = plain_colour(scene.background)
        low, high = (torch.tensor(corner, dtype=torch.float32, device=device) for corner in scene.aabb)
        return Space(low, high, scene.near, None if colour is None else torch.tensor(colour, device=device))

    @property
    def surrounded(self) -> bool:
        """Whether surroundings are seen."""
        return self.behind is None

    def crossed(
        self, o: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"]
    ) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
        """Where rays enter and leave the box; the same twice where they miss it."""
        inverse = 1 / torch.where(d.abs() < 1e-9, 1e-9, d)
        a, b = (self.low - o) * inverse, (self.high - o) * inverse
        enter = torch.minimum(a, b).amax(1).clamp(min=self.near)
        return enter, torch.maximum(torch.maximum(a, b).amin(1), enter)

    def distances(
        self, o: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"], steps: Float[Tensor, "R n"]
    ) -> Float[Tensor, "R n"]:
        """Distances of places in [0, 1] along rays: even in the box; behind it, where surroundings are seen, even in
        disparity."""
        enter, leave = (x[:, None] for x in self.crossed(o, d))
        if not self.surrounded:
            return enter + steps * (leave - enter)
        # Half of the steps from the near plane to the far side of the box, half beyond, in disparity.
        far = torch.where(leave > enter, leave, torch.linalg.norm(o, dim=1, keepdim=True) + 1)
        inner = self.near + 2 * steps.clamp(max=0.5) * (far - self.near)
        outer = 1 / (1 / far + (2 * steps - 1).clamp(min=0) * (1 / OUTER - 1 / far))
        return torch.where(steps < 0.5, inner, outer)

    def contracted(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Places in [-1, 1]: the box fills half of it where surroundings are seen (Mip-NeRF 360, Eq. 10, by the largest
        coordinate), else all."""
        half = (self.high - self.low).max() / 2
        y = (x - (self.low + self.high) / 2) / half
        if not self.surrounded:
            return y
        largest = y.abs().amax(-1, keepdim=True).clamp(min=1)
        return (2 - 1 / largest) * (y / largest) / 2

    def expanded(self, y: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Back from [-1, 1]."""
        half, middle = (self.high - self.low).max() / 2, (self.low + self.high) / 2
        if not self.surrounded:
            return middle + half * y
        largest = (2 * y).abs().amax(-1, keepdim=True).clamp(1, 2 - 1 / OUTER)
        return middle + half * (2 * y / largest) / (2 - largest)
