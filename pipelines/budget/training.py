"""What training needs, as the reconstruction predicts it; before scene and model are known, of what is planned."""

from dataclasses import replace
from typing import TYPE_CHECKING

from devrf.capture.errors import ReconstructError
from devrf.capture.scene import Scene
from devrf.pipelines.budget.material import Material, Trained
from devrf.pipelines.budget.need import BudgetError, Need
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.training_options import planned_options
from devrf.reconstruct.options import PRESETS, CanonicalOptions, MotionOptions, PresetName

if TYPE_CHECKING:
    from devrf.reconstruct.footprint import SceneSize

BASE = 420_000_000  # bytes: Python with NumPy, SciPy, OpenCV and PyTorch; 0.36 to 0.41 GB
FLOAT = 4  # bytes
SHELL_NUMBERS = 4  # of each of its vertices: density and colour
CHECKPOINT = 3  # copies of a trained grid in a checkpoint: values, and moments, which most vertices have
GOOD = 1  # and one more of the scene at rest: as it was at its last good point
OLD_AND_NEW = 2  # checkpoints on the disk while one is written
PACKED = 0.35  # bytes on disk of each number of a model; the example's 0.32

FEW_S = 5.0  # loading libraries, reading, writing

# Seconds on two CPU cores beside other jobs, of the example session with all that the preset has; `reference` was
# never measured
SECONDS: dict[str, dict[str, float]] = {
    "canonical": {"tiny": 200.0, "fast": 890.0},
    "deformation": {"tiny": 130.0, "fast": 1140.0},
}
EXAMPLE_TIMES = 43  # pictures of each of its cameras


def training_need(stage: str, config: SceneConfig, material: Material, device: str) -> Need:
    """Of stage canonical or deformation, with the options that scene.yaml asks for."""
    from devrf.reconstruct.footprint import footprint

    options = _options(stage, config, material)
    held = footprint(_size(material), options, device, BASE)
    if isinstance(options, CanonicalOptions):
        model = rest_numbers(config, material)
        state = (CHECKPOINT + GOOD) * model
    else:  # of the motion there are no moments between two key times; those of its fine-tuning lie beside
        motion, tuned = motion_numbers(config, material), tuned_numbers(config, material)
        model, state = motion + tuned, motion + CHECKPOINT * tuned
    return Need(
        stage,
        held.main_bytes,
        gpu=held.gpu_bytes,
        left=int(PACKED * model),
        passing=OLD_AND_NEW * FLOAT * state,
        seconds=None if device == "cuda" else _seconds(stage, config.preset, options, _times(material)),
    )


def fitted_training(
    need: Need, config: SceneConfig, material: Material, device: str, allowed: int
) -> tuple[Need, tuple[str, ...]]:
    """The need with options that keep within `allowed` bytes of main memory, and what is changed, one line each.

    Raises:
        BudgetError: Even the smallest training takes more.
    """
    from devrf.reconstruct.memory_fit import Limits, fitted

    asked = _options(need.stage, config, material)
    try:
        found = fitted(_size(material), asked, Limits(allowed), device, BASE)
    except ReconstructError as error:
        raise BudgetError(str(error)) from None
    return replace(need, base=found.need.main_bytes), tuple(map(str, found.decisions))


def rest_numbers(config: SceneConfig, material: Material) -> int:
    """Numbers in the grids of the scene at rest and of its surroundings."""
    made = _at_rest(config, material)
    plain = material.scene is not None and material.scene.background != "shell"
    return made.vertices * (1 + made.channels) + (0 if plain else made.around**3 * SHELL_NUMBERS)


def tuned_numbers(config: SceneConfig, material: Material) -> int:
    """Numbers in the grids of the scene at rest that follow the motion, where there is fine-tuning."""
    made = _at_rest(config, material)
    tuned = planned_options(config).motion.fine_tuning and material.in_motion
    return made.vertices * (1 + made.channels) if tuned else 0


def motion_numbers(config: SceneConfig, material: Material) -> int:
    """Numbers in the finest field of motion, both ways."""
    if not material.in_motion:
        return 0
    made = material.trained.get("deformation")
    if made is not None:
        return 2 * 3 * made.keys * made.vertices
    motion = planned_options(config).motion
    return 2 * 3 * _keys(motion, _times(material)) * motion.levels[-1] ** 3


def model_bytes(config: SceneConfig, material: Material) -> int:
    """The trained model in memory."""
    copies = 2 if planned_options(config).motion.fine_tuning and material.in_motion else 1
    return FLOAT * (copies * rest_numbers(config, material) + motion_numbers(config, material))


def _at_rest(config: SceneConfig, material: Material) -> Trained:
    """The scene at rest, trained or planned."""
    rest = planned_options(config).canonical
    planned = Trained(rest.resolution**3, 0, rest.channels, rest.shell_resolution)
    return material.trained.get("canonical", planned)


def _seconds(
    stage: str, preset: PresetName, options: CanonicalOptions | MotionOptions, times: int
) -> float | None:
    """What the preset took for the example, in proportion to the work that is asked for (docs/budgets.md)."""
    measured = SECONDS[stage].get(preset)
    if measured is None:
        return None
    usual = PRESETS[preset].canonical if stage == "canonical" else PRESETS[preset].motion
    return FEW_S + (measured - FEW_S) * _work(options, times) / _work(usual, EXAMPLE_TIMES)


def _work(options: CanonicalOptions | MotionOptions, times: int) -> int:
    """What the time of a training grows with: iterations; of the motion, whose samples nothing bounds, rays drawn."""
    if isinstance(options, CanonicalOptions):
        return options.iterations
    return options.rays * (_keys(options, times) * sum(options.iterations) + options.fine_tuning)


def _keys(motion: MotionOptions, times: int) -> int:
    """Key times of the motion, before pictures may show that fewer do."""
    return motion.keys or min(motion.most_keys, max(2, times))


def _options(stage: str, config: SceneConfig, material: Material) -> CanonicalOptions | MotionOptions:
    forward = material.scene is not None and material.scene.ndc is not None
    options = planned_options(config, forward=forward)
    if stage == "canonical":
        return options.canonical
    made = material.trained.get("canonical")
    if made is None:
        return options.motion
    return replace(options.motion, resolution=round(made.vertices ** (1 / 3)))


def _size(material: Material) -> "Scene | SceneSize":
    """The scene, or what is planned of it: cameras that stand still, each with one lens, and surroundings."""
    from devrf.reconstruct.footprint import SceneSize

    if material.scene is not None:
        return material.scene
    clip = material.pixels * _times(material)
    seen = material.pixels * material.cameras
    return SceneSize(
        still_pixels=material.pixels * material.at_rest,
        moving_pixels=material.pixels * material.in_motion,
        still_lenses=material.pixels,
        moving_lenses=seen,
        views=seen,
        largest_clip=clip,
        times=_times(material),
        cameras=material.cameras,
        plain=False,
    )


def _times(material: Material) -> int:
    """Pictures of one camera."""
    return material.in_motion // max(1, material.cameras)
