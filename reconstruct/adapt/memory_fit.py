"""Training options with which a training stays below a limit of memory; what is changed comes as a decision.

First what leaves the result as it is in expectation: an iteration's rays in parts, one after the other. Then fewer rays
(of the motion, whose losses are not sums over rays) and no fine-tuning, then coarser grids.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, TypeVar, cast

from devrf.capture.scene import Scene
from devrf.capture.system.amounts import GB, size_text
from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.adapt.footprint import Footprint, SceneSize, footprints
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.options import FEWEST_RAYS, CanonicalOptions, MotionOptions, resized_whole

Options = TypeVar("Options", bound=CanonicalOptions | MotionOptions)

UNSURE = 0.1  # by how much a training may take more than is predicted (docs/reliability.md)
MOST_PARTS = 16
COARSER = 0.9  # resolution from one try to the next
COARSEST, COARSEST_MOTION = 24, 6  # vertices along an axis: below, nothing is recovered
OF_PICTURES = ("pictures", "flow", "sweep", "surroundings")  # parts of a footprint that are so much a pixel
MATTERS = 0.1  # share of a need below which smaller pictures are no help


@dataclass(frozen=True)
class Limits:
    """Most memory that a training may take, bytes; None: without a limit, or no GPU."""

    main: int | None = None
    gpu: int | None = None

    def hold(self, need: Footprint) -> bool:
        """Whether a training surely stays below."""
        return not _short(need, self)


@dataclass(frozen=True)
class Fitted(Generic[Options]):
    """Options that keep a training below the limits.

    Attributes:
        options: Of the training.
        decisions: What was changed for it.
        need: What it takes.
    """

    options: Options
    decisions: list[Decision]
    need: Footprint


def fitted(
    scene: Scene | SceneSize,
    options: Options,
    limits: Limits,
    device: str = "cpu",
    held: int = 0,
    begun: Options | None = None,
) -> Fitted[Options]:
    """Options that keep a training below the limits.

    Args:
        scene, options, device, held: As `footprint`'s.
        limits: Of main memory and of the GPU's.
        begun: Options that stay as they are where they do.
    Raises:
        ReconstructError: Even the smallest training takes more.
    """
    need_of = footprints(scene, device, held)
    if begun is not None and limits.hold(need := need_of(begun)):
        return Fitted(begun, [], need)
    need = wanted = need_of(options)
    if limits.hold(wanted):
        return Fitted(options, [], wanted)
    for smaller in _smaller_and_smaller(options):
        need = need_of(smaller)
        if limits.hold(need):
            return Fitted(smaller, _decisions(options, smaller, wanted, limits), need)
    raise ReconstructError("training-needs-memory", _too_little(need, limits))


def surely(predicted: int) -> int:
    """What a training takes at most whose peak is predicted, bytes."""
    return round((1 + UNSURE) * predicted)


def _smaller_and_smaller(options: Options) -> Iterator[Options]:
    """Each takes less memory than the one before."""
    found = _at_rest(options) if isinstance(options, CanonicalOptions) else _in_motion(options)
    return cast(Iterator[Options], found)


def _at_rest(options: CanonicalOptions) -> Iterator[CanonicalOptions]:
    while options.parts < MOST_PARTS:
        options = replace(options, parts=2 * options.parts)
        yield options
    ratio = COARSER
    while ratio * options.resolution >= COARSEST:
        yield resized_whole(options, ratio)
        ratio *= COARSER


def _in_motion(options: MotionOptions) -> Iterator[MotionOptions]:
    while options.rays // 2 >= FEWEST_RAYS:
        options = replace(options, rays=options.rays // 2)
        yield options
    for name in ("together", "fine_tuning"):
        if getattr(options, name):
            options = replace(options, **{name: 0})
            yield options
    ratio = COARSER
    while ratio * options.levels[-1] >= COARSEST_MOTION:
        yield replace(options, levels=tuple(max(4, round(ratio * level)) for level in options.levels))
        ratio *= COARSER


def _decisions(wanted: Options, chosen: Options, need: Footprint, limits: Limits) -> list[Decision]:
    reason = "; ".join(map(str, _short(need, limits)))
    named: list[tuple[str, Callable[[Options], object]]] = [
        ("parts of an iteration's rays", lambda o: getattr(o, "parts", 1)),
        ("resolution at rest", lambda o: o.resolution),
        ("rays of an iteration", lambda o: o.rays),
        ("movers", lambda o: "tracked" if getattr(o, "together", 0) else "none"),
        ("fine-tuning", lambda o: getattr(o, "fine_tuning", 0) or "none"),
        ("finest level of the motion", lambda o: o.levels[-1] if isinstance(o, MotionOptions) else 0),
    ]
    return [
        Decision(what, str(value(chosen)), str(value(wanted)), reason)
        for what, value in named
        if value(chosen) != value(wanted)
    ]


@dataclass(frozen=True)
class _Short:
    """A memory of which a training takes more than its limit.

    Attributes:
        key: Of `budget`.
        name: In words.
        parts: Bytes by what they are for.
        limit: Bytes.
    """

    key: str
    name: str
    parts: dict[str, int]
    limit: int

    def __str__(self) -> str:
        # Rounded apart: what is short never looks as if it fitted.
        needed = math.ceil(100 * surely(sum(self.parts.values())) / GB) / 100
        allowed = math.floor(100 * self.limit / GB + 1e-6) / 100
        return f"about {needed:.2f} GB of {self.name} needed with a tenth to spare, {allowed:.2f} GB allowed"


def _short(need: Footprint, limits: Limits) -> list[_Short]:
    """Which memory is short."""
    kinds = (
        ("memory_gb", "main memory", need.main, limits.main),
        ("gpu_memory_gb", "GPU memory", need.gpu, limits.gpu),
    )
    return [
        _Short(key, name, parts, limit)
        for key, name, parts, limit in kinds
        if limit is not None and surely(sum(parts.values())) > limit
    ]


def _too_little(need: Footprint, limits: Limits) -> str:
    short = _short(need, limits)
    first = short[0]
    remedies = "raise it, or close other programs where it is the machine that has no more"
    pictures = sum(first.parts.get(name, 0) for name in OF_PICTURES)
    if pictures >= MATTERS * sum(first.parts.values()):
        remedies += f", or lower reconstruct.image_scale (its pictures and flow take {size_text(pictures)})"
    return (
        f"budget.{first.key}: the smallest training does not fit ({'; '.join(map(str, short))}); {remedies}"
    )
