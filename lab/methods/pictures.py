"""The pictures of a task as rays to train on, and the space that rays go through.

Before a plain background all methods are told, as DeVRF finds for itself, where the subject can be at some time: the
visual hull of its silhouettes. Elsewhere nothing is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.scene import PosedFrame, Scene, plain_colour
from devrf.lab.methods.protocol import MethodTask
from devrf.reconstruct.adapt.hull import box_of, visual_hull
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.pixel_flow import PixelFlow

OUTER = 1e3  # box units: surroundings end here
HULL, MARGIN = 64, 1.05  # vertices along a side of the grid of silhouettes; of the box around what they leave


class TaskPictures:
    """Training pictures of a task.

    Attributes:
        moments: Times of the moving cameras' pictures, each once, rising.
        rest_time: Time at which the sweep shows the scene: when the clips show it so, else the first moment.
        flow: Of the moving pictures; None where there is none.
    """

    def __init__(self, task: MethodTask) -> None:
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

    def draw(
        self, n: int, generator: torch.Generator, static_share: float, one_moment: bool = False
    ) -> RayBatch:
        """Draw `n` rays, a share of them of the sweep where there is one; those in motion of all moments, or of one."""
        still = round(n * static_share) if self.static is not None else 0
        frames = self._of_one(generator) if one_moment else None
        moving = self.moving.draw(n - still, generator, frames) if n > still else None
        if not still or self.static is None:
            assert moving is not None
            return moving
        swept = at_rest(self.static.draw(still, generator), self.rest_time)
        return swept if moving is None else swept.joined(moving)

    def _of_one(self, generator: torch.Generator) -> Int[Tensor, " f"]:
        """Pictures of a moment drawn at random."""
        moment = self.moments[int(torch.randint(len(self.moments), (1,), generator=generator))]
        return (self.moving.times == moment).nonzero()[:, 0]


def at_rest(rays: RayBatch, rest_time: float) -> RayBatch:
    """Rays of the scene at rest: of no moving picture, which their number -1 says."""
    return replace(rays, time=torch.full_like(rays.time, rest_time), frame=torch.full_like(rays.frame, -1))


@dataclass(frozen=True)
class Space:
    """Where along rays something may be.

    Attributes:
        low, high: Corners of the box: the scene's, or before a plain background around what can hold the subject.
        near: Nearest content, box units.
        behind: Colour behind a subject before a plain background; None: real surroundings.
        hull: Vertices over the box at which the subject can be; None: everywhere.
    """

    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]
    near: float
    behind: Float[Tensor, " 3"] | None
    hull: Bool[Tensor, "X Y Z"] | None = None

    @staticmethod
    def of(task: MethodTask) -> "Space":
        """That of a task, in the box frame."""
        scene, device = task.boxed, task.device
        colour, whole = plain_colour(scene.background), torch.tensor(scene.aabb, dtype=torch.float32)
        if colour is None:
            return Space(whole[0].to(device), whole[1].to(device), scene.near, None)
        moments = _moments(task)
        box = box_of(_swept(moments, whole, scene), whole, MARGIN)
        box = whole if box is None else box
        hull = _swept(moments, box, scene)
        low, high = box.to(device)
        return Space(low, high, scene.near, torch.tensor(colour, device=device), hull.to(device))

    @property
    def surrounded(self) -> bool:
        """Whether surroundings are seen."""
        return self.behind is None

    @property
    def filled(self) -> float:
        """Share of the box that can hold something."""
        return 1.0 if self.hull is None else float(self.hull.float().mean())

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

    def may_hold(self, y: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Contracted places at which something can be."""
        if self.hull is None:
            return torch.ones_like(y[:, 0], dtype=torch.bool)
        last = torch.tensor(self.hull.shape, device=y.device) - 1
        at = ((self.expanded(y) - self.low) / (self.high - self.low) * last).round().long()
        return self.hull[tuple(torch.minimum(at.clamp(min=0), last).T)]

    def expanded(self, y: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Back from [-1, 1]."""
        half, middle = (self.high - self.low).max() / 2, (self.low + self.high) / 2
        if not self.surrounded:
            return middle + half * y
        largest = (2 * y).abs().amax(-1, keepdim=True).clamp(1, 2 - 1 / OUTER)
        return middle + half * (2 * y / largest) / (2 - largest)


def _moments(task: MethodTask) -> list[list[PosedFrame]]:
    """Training pictures of the sweep, and those of each moment."""
    static, moving = ([f for f in fs if f.split == "train"] for fs in (task.boxed.static, task.boxed.dynamic))
    times = sorted({f.time for f in moving if f.time is not None})
    swept = [] if task.regime == "dynamic" or not static else [static]
    return [*swept, *([f for f in moving if f.time == time] for time in times)]


def _swept(
    moments: Sequence[Sequence[PosedFrame]], box: Float[Tensor, "2 3"], scene: Scene
) -> Bool[Tensor, "X Y Z"]:
    """Vertices over a box at which the subject can be at some time."""
    hulls = [visual_hull(frames, box, (HULL, HULL, HULL), scene.background) for frames in moments]
    return torch.stack(hulls).any(0)
