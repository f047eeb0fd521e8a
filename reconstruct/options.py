"""What can be chosen about training, and the presets: points on one curve, speed against accuracy.

`reference` holds the published numbers (DeVRF's paper and program; where they differ, the program's), `tiny` is
sized for two cores without a GPU, `fast` lies between. Lengths are relative to the box or to a voxel, so no
number depends on a scene's scale.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

PresetName = Literal["tiny", "fast", "reference"]
OWN_MOTION = (
    "devrf.motion"  # group of entry points by which installed packages add motion models (`own_motion.py`)
)
# longest side of the published objects, world units; the motion's rates are meant for it
REFERENCE_EXTENT = 2.5
STEP_AT_REST = 0.5  # along rays, in voxels of the scene at rest: as published; no preset gains by another
# Seconds of motion that `together` and the moments of shading are meant for, as the captures have that they were chosen
# on; where motion lasts longer both are more in proportion, up to so many times.
MEANT_S, MOST_LONGER = 3.0, 8.0
CHUNK = 1 << 14  # rays rendered at once: the march's table stays below a hundred megabytes


@dataclass(frozen=True)
class CanonicalOptions:
    """Stage 1, the scene at rest.

    Attributes:
        resolution: R; the grid has the volume of R^3 voxels, in proportion to the box.
        iterations: Steps of the optimiser.
        rays: Most rays per iteration.
        rays_given: They stay as they are at other resolutions, too.
        samples: Samples per iteration to aim at: fewer rays are drawn while space is still translucent.
        channels: Colour features per voxel.
        mlp_width: Width of the two hidden layers behind them.
        deferred: The MLP sees the mean features of each ray once, not those of each sample.
        scale_at: Shares of the iterations after which the number of voxels doubles.
        planes: Of a forward-facing scene in normalised device coordinates: vertices along its depth, at all levels.
        shell_resolution: Vertices along each axis of the surroundings.
        alpha_threshold, weight_threshold: Samples at or below are dropped.
        lr_grid: Initial learning rate of the grids; falls by 10 over all iterations, as the MLP's does.
        learning_rate: Factor on both.
        entropy, per_point, opacity: Weights of the losses beside the re-rendering loss.
        variation: Weight of the total variation of density and features.
        shell_variation: Of the surroundings' colours, before the last level; of their density a tenth.
        parts: In how many parts, one after the other, an iteration's rays are rendered: the same gradient, less memory.
        coarse_iterations, coarse_rays, coarse_size: The first, coarse model where surroundings are modelled, or where
            it searches the box: iterations, rays per iteration, vertices along each axis.
        box_search: How the tight box is found before a plain background: from silhouettes, or, as published, by a
            coarse model; then only rays that meet what it found are drawn.
        hull_resolution: Vertices along the longest side of the grid of silhouettes.
        occupancy_every: Iterations between rebuilds of the occupancy.
        adapt: Take fewer voxels where the pictures show no more (`sizing.py`).
        seed: Of every random draw.
    """

    resolution: int
    iterations: int
    rays: int
    rays_given: bool = False
    samples: int = 1 << 20
    channels: int = 12
    mlp_width: int = 128
    deferred: bool = False
    scale_at: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2)
    planes: int = 128
    shell_resolution: int = 256
    alpha_threshold: float = 1e-4
    weight_threshold: float = 1e-4
    lr_grid: float = 0.1
    learning_rate: float = 1.0
    entropy: float = 1e-3
    per_point: float = 1e-2
    opacity: float = 0.0
    variation: float = 0.0
    shell_variation: float = 3e-4
    parts: int = 1
    coarse_iterations: int = 1000
    coarse_rays: int = 8192
    coarse_size: int = 128
    box_search: Literal["silhouettes", "coarse"] = "silhouettes"
    hull_resolution: int = 64
    occupancy_every: int = 500
    adapt: bool = False
    seed: int = 0


@dataclass(frozen=True)
class MotionOptions:
    """Stage 2, the motion.

    Attributes:
        levels: Resolution of each level of the pyramid, as `resolution` of stage 1.
        iterations: Steps per key time at each level.
        resolution: R of the scene at rest for which the levels are meant.
        rays: Rays per iteration.
        rays_given: They stay as they are at other resolutions, too.
        most_keys: Most key times; a scene with fewer distinct times has fewer.
        keys: Number of key times where it is given.
        adapt: Take fewer key times and coarser levels where the scene needs no more, and none of its time where nothing
            moves (`key_times.py`, `sizing.py`, `static_keys.py`).
        lr: Learning rate at the first level, for a box of REFERENCE_EXTENT; at level k of K+1: lr * 0.1^(k/K).
        learning_rate: Factor on it and on fine-tuning's.
        one_camera: Each step draws from one camera, the cameras in turn, as published.
        importance: Share of rays drawn where the pictures change over time (0: uniform, as published). Above 0 nothing
            is trained where they never do.
        cycle, flow, variation, entropy, per_point: Weights of the losses beside the re-rendering loss.
        flow_confidence: A vector of flow counts by its confidence and by how far the pictures agree with it
            (`checked_flow.py`; False: all valid ones alike, as published).
        fine_tuning: Iterations in which the scene at rest follows all pictures, its motion known (`fine_tune.py`).
        together: Iterations in which what stands and parts that were tracked are trained (`train_movers.py`), of motion
            of MEANT_S or less; 0: motion is a field, as published.
        together_rays: Rays of each.
        stepsize: Step along rays, in voxels of the scene at rest.
        alpha_threshold, weight_threshold: Samples at or below are dropped.
        seed: Of every random draw.
    """

    levels: tuple[int, ...]
    iterations: tuple[int, ...]
    rays: int
    rays_given: bool = False
    resolution: int = 160
    most_keys: int = 50
    keys: int | None = None
    adapt: bool = False
    lr: float = 1e-3
    learning_rate: float = 1.0
    one_camera: bool = False
    importance: float = 0.0
    cycle: float = 100.0
    flow: float = 0.005
    flow_confidence: bool = False
    variation: float = 1.0
    entropy: float = 0.01
    per_point: float = 0.1
    fine_tuning: int = 0
    together: int = 0
    together_rays: int = 4096
    stepsize: float = 0.5
    alpha_threshold: float = 1e-4
    weight_threshold: float = 1e-4
    seed: int = 0

    def __post_init__(self) -> None:
        if len(self.levels) != len(self.iterations) or not self.levels:
            raise ValueError(f"levels {self.levels} and iterations {self.iterations} must pair up")


@dataclass(frozen=True)
class TrainingOptions:
    """Both stages."""

    canonical: CanonicalOptions
    motion: MotionOptions


FEWEST_RAYS, FEWEST_SAMPLES = 512, 1 << 14  # per iteration: fewer make it noisy, not quicker
FEWEST_COARSE = 400  # iterations in which a coarse voxel can get from transparent to opaque, at its rate

QUICK_CANONICAL: dict[str, Any] = {
    "scale_at": (0.15, 0.3, 0.45, 0.6),
    "mlp_width": 64,
    "lr_grid": 0.3,
    "opacity": 0.1,
    "occupancy_every": 50,
    "alpha_threshold": 1e-3,
    "weight_threshold": 1e-3,
}
QUICK_MOTION: dict[str, Any] = {
    "lr": 8e-3,
    "importance": 0.8,
    "flow": 0.02,
    "flow_confidence": True,
    "together": 300,
    "stepsize": 1.0,
    "alpha_threshold": 5e-3,
    "weight_threshold": 1e-2,
}
"""What `tiny` and `fast` have in common: few iterations, so large steps, and samples only where they count."""

PRESETS: dict[str, TrainingOptions] = {
    "tiny": TrainingOptions(
        CanonicalOptions(
            resolution=112,
            iterations=600,
            rays=4096,
            samples=32768,
            shell_resolution=224,
            coarse_iterations=400,
            coarse_rays=2048,
            coarse_size=96,
            hull_resolution=48,
            deferred=True,
            **QUICK_CANONICAL,
        ),
        MotionOptions(
            levels=(7, 14, 28),
            iterations=(50, 30, 20),
            rays=1536,
            resolution=112,
            most_keys=25,
            **QUICK_MOTION,
        ),
    ),
    "fast": TrainingOptions(
        CanonicalOptions(
            resolution=160,
            iterations=700,
            rays=24_000,
            samples=200_000,
            coarse_iterations=400,
            deferred=True,
            adapt=True,
            **QUICK_CANONICAL,
        ),
        MotionOptions(
            levels=(10, 20, 40, 80),
            iterations=(100, 60, 40, 20),
            rays=8192,
            most_keys=100,
            adapt=True,
            fine_tuning=200,
            **QUICK_MOTION,
        ),
    ),
    "reference": TrainingOptions(
        CanonicalOptions(
            resolution=160,
            iterations=20000,
            rays=8192,
            coarse_iterations=5000,
            coarse_size=100,
            box_search="coarse",
        ),
        MotionOptions(
            levels=(10, 20, 40, 80, 160), iterations=(200, 100, 100, 50, 50), rays=8192, most_keys=400,
            one_camera=True,
        ),
    ),
}  # fmt: skip

FORWARD: dict[str, dict[str, Any]] = {
    "tiny": {"resolution": 96, "planes": 48, "opacity": 0.1, "variation": 0.0},
    "fast": {"resolution": 192, "planes": 96},
    "reference": {"resolution": 256, "planes": 128, "iterations": 25000, "rays": 4096},
}
"""What differs at rest for a forward-facing scene in normalised device coordinates, beside PUBLISHED_FORWARD."""
PUBLISHED_FORWARD: dict[str, Any] = {
    "channels": 9,
    "mlp_width": 64,
    "scale_at": (0.08, 0.16, 0.24, 0.32),
    "alpha_threshold": 1e-3,
    "weight_threshold": 1e-3,
    "opacity": 0.0045,
    "variation": 1e-5,
}


def longer(seconds: float) -> float:
    """How many times more there is to learn of motion that lasts so long than of MEANT_S."""
    return min(max(1.0, seconds / MEANT_S), MOST_LONGER)


def resized(canonical: CanonicalOptions, ratio: float) -> CanonicalOptions:
    """The tight box at another resolution; where training adapts, with the rays that its surfaces then need."""
    rays, samples = canonical.rays, canonical.samples
    if canonical.adapt:
        samples = max(FEWEST_SAMPLES, round(ratio**2 * samples))
        rays = rays if canonical.rays_given else max(FEWEST_RAYS, round(ratio**2 * rays))
    resolution, planes = round(ratio * canonical.resolution), max(8, round(ratio * canonical.planes))
    return replace(canonical, resolution=resolution, planes=planes, rays=rays, samples=samples)


def resized_whole(canonical: CanonicalOptions, ratio: float) -> CanonicalOptions:
    """Box, surroundings and coarse model at another resolution."""
    return replace(
        resized(canonical, ratio),
        coarse_size=max(16, round(ratio * canonical.coarse_size)),
        shell_resolution=max(16, round(ratio * canonical.shell_resolution)),
    )


def resized_motion(motion: MotionOptions, ratio: float) -> MotionOptions:
    """Levels for another resolution at rest; where training adapts, with the rays that its pictures then need."""
    rays = motion.rays
    if motion.adapt and not motion.rays_given:
        rays = max(FEWEST_RAYS, round(ratio**2 * rays))
    levels = tuple(max(4, round(level * ratio)) for level in motion.levels)
    return replace(motion, levels=levels, resolution=round(ratio * motion.resolution), rays=rays)


@dataclass(frozen=True)
class Overrides:
    """Single numbers in place of a preset's; None: as the preset has it.

    Attributes:
        resolution: R of the canonical grid; every other grid keeps its proportion to it.
        rays: Rays per iteration, both stages.
        canonical_iterations: Of stage 1's fine model; the coarse model's keep their proportion to it.
        motion_iterations: Of stage 2, per key time, over all levels; fine-tuning's keep their proportion to it.
        key_times: How many, where it is not to be decided by the scene.
        adapt: Whether to decide by the scene what is not given here.
        seed: Of both stages.
    """

    resolution: int | None = None
    rays: int | None = None
    canonical_iterations: int | None = None
    motion_iterations: int | None = None
    key_times: int | None = None
    adapt: bool | None = None
    seed: int = 0


def preset(name: str, given: Overrides | None = None, *, forward: bool = False) -> TrainingOptions:
    """A preset with single numbers replaced.

    Args:
        name: tiny, fast or reference.
        given: What is replaced.
        forward: The scene is modelled in normalised device coordinates.
    """
    given = given or Overrides()
    if name not in PRESETS:
        raise ValueError(f"preset is {name!r}, expected one of {', '.join(PRESETS)}")
    canonical, motion = PRESETS[name].canonical, PRESETS[name].motion
    inward = canonical.resolution
    if forward:
        canonical = replace(canonical, **(PUBLISHED_FORWARD | FORWARD[name]))
        motion = replace(motion, resolution=canonical.resolution)
    if given.adapt is not None:
        canonical, motion = replace(canonical, adapt=given.adapt), replace(motion, adapt=given.adapt)
    if given.resolution is not None:
        ratio = given.resolution / inward
        motion = resized_motion(motion, ratio)
        canonical = replace(resized_whole(canonical, ratio), adapt=False)
    if (rays := given.rays) is not None:
        canonical = replace(
            canonical,
            rays=rays,
            rays_given=True,
            coarse_rays=max(64, round(rays * canonical.coarse_rays / canonical.rays)),
        )
        motion = replace(
            motion,
            rays=rays,
            rays_given=True,
            together_rays=max(64, round(rays * motion.together_rays / motion.rays)),
        )
    if given.canonical_iterations is not None:
        ratio = given.canonical_iterations / PRESETS[name].canonical.iterations
        least = FEWEST_COARSE if canonical.box_search == "coarse" else 1
        canonical = replace(
            canonical,
            iterations=max(1, round(ratio * canonical.iterations)),
            coarse_iterations=max(least, round(ratio * canonical.coarse_iterations)),
            occupancy_every=max(10, round(ratio * canonical.occupancy_every)),
        )
    if given.motion_iterations is not None:
        ratio = given.motion_iterations / sum(motion.iterations)
        motion = replace(
            motion,
            iterations=tuple(max(1, round(n * ratio)) for n in motion.iterations),
            fine_tuning=round(ratio * motion.fine_tuning),
            together=round(ratio * motion.together),
        )
    seed = given.seed
    return TrainingOptions(replace(canonical, seed=seed), replace(motion, keys=given.key_times, seed=seed))
