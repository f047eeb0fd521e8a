"""What training needs, before the scene is known."""

from devrf.pipelines.budget.material import Material
from devrf.pipelines.budget.need import Need
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.training_options import planned_options
from devrf.reconstruct.options import CanonicalOptions

FLOAT = 4  # bytes
SHELL_NUMBERS = 4  # of each of its vertices: density and colour
TRAINED = 8  # copies of a grid while it is trained: values, gradients, two moments, and of each meanwhile
WORK = 300_000_000  # bytes for samples of rays, and compiled kernels
REST_PIXEL, MOVING_PIXEL = 3, 11  # bytes of a training picture's pixel; with flow and confidence
CHECKPOINT = 3  # copies of a grid in a checkpoint: values and two moments
PACKED = 0.35  # bytes on disk of each number of a model; the example's 0.32

# Seconds on two CPU cores beside other jobs, of the example session; `reference` was never measured
SECONDS: dict[str, dict[str, float]] = {
    "canonical": {"tiny": 200.0, "fast": 890.0},
    "deformation": {"tiny": 130.0, "fast": 1140.0},
}


def model_numbers(config: SceneConfig) -> int:
    """Numbers in the grids of the scene at rest and of its surroundings."""
    rest: CanonicalOptions = planned_options(config).canonical
    return rest.resolution**3 * (1 + rest.channels) + rest.shell_resolution**3 * SHELL_NUMBERS


def motion_numbers(config: SceneConfig, material: Material) -> int:
    """Numbers in the finest field of motion, both ways."""
    motion = planned_options(config).motion
    if not material.in_motion:
        return 0
    keys = motion.keys or min(motion.most_keys, max(2, material.in_motion // max(1, material.cameras)))
    return 2 * 3 * keys * motion.levels[-1] ** 3


def model_bytes(config: SceneConfig, material: Material) -> int:
    """The trained model in memory."""
    copies = 2 if planned_options(config).motion.fine_tuning and material.in_motion else 1
    return FLOAT * (copies * model_numbers(config) + motion_numbers(config, material))


def training_need(stage: str, config: SceneConfig, material: Material, device: str, base: int) -> Need:
    """Of stage canonical or deformation.

    Args:
        stage: Which.
        config, material: The scene.
        device: cpu or cuda.
        base: Bytes of the process without it.
    """
    rest, motion = model_numbers(config), motion_numbers(config, material)
    if stage == "canonical":
        held = FLOAT * TRAINED * rest + REST_PIXEL * material.pixels * material.at_rest
        trained = rest
    else:
        held = model_bytes(config, material) + FLOAT * TRAINED * motion
        held += MOVING_PIXEL * material.pixels * material.in_motion
        trained = motion
    held += WORK
    there = device == "cuda"
    return Need(
        stage,
        2 * base if there else base + held,
        gpu=held if there else 0,
        left=int(PACKED * trained),
        passing=FLOAT * CHECKPOINT * trained,
        seconds=None if there else SECONDS[stage].get(config.preset),
    )
