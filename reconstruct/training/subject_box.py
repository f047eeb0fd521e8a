"""The box to model, and where in it the subject can be: by a coarse model, as published, or by silhouettes.

Only before a plain background: surroundings fill the box that the scene brings. A forward-facing scene has the whole
cube of normalised device coordinates.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.adapt.hull import box_of, visual_hull
from devrf.reconstruct.fields.grids import grid_shape, grown
from devrf.reconstruct.fields.ndc import CUBE, Ndc
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.training.canonical_state import Hull
from devrf.reconstruct.training.coarse_box import find_subject
from devrf.reconstruct.training.loop import TrainingRun

BOX_MARGIN = 1.2  # by which the tight box is enlarged about its centre: silhouettes may miss a thin edge


def subject_box(
    scene: Scene,
    rays: RaySet,
    options: CanonicalOptions,
    generator: torch.Generator,
    log: TrainingLog,
    run: TrainingRun,
) -> tuple[Float[Tensor, "2 3"], Hull | None]:
    """The box to model, and where in it the subject can be, over a box of its own, where that is known.

    Args:
        scene: In the box frame.
        rays: Of the sweep's training pictures.
        options: What can be chosen.
        generator: Of the coarse model's training, as `log`.
        log: Of all of stage 1.
        run: Of the search.
    Raises:
        ReconstructError: Nothing is found.
    """
    aabb = torch.tensor(scene.aabb, dtype=torch.float32)
    if scene.ndc is not None:
        return CUBE, _hull_in_planes(rays.frames, Ndc(*scene.ndc), rays, scene.background, options)
    if scene.background == "shell":
        return aabb, None
    if options.box_search == "coarse":
        kept = find_subject(scene, rays, options, generator, log, run.part("box"))
        near_kept = grown(kept)
    else:
        kept = visual_hull(rays.frames, aabb, grid_shape(aabb, options.hull_resolution), scene.background)
        near_kept = grown(grown(kept))
    tight = box_of(kept, aabb, BOX_MARGIN)
    if tight is None:
        remedy = (
            "check poses and background (dataset.background), "
            "or train longer (reconstruct.canonical_iterations)"
        )
        raise ReconstructError("subject-not-found", f"the scene box was found empty: {remedy}")
    return tight, (near_kept, aabb)


def _hull_in_planes(
    frames: tuple[PosedFrame, ...], ndc: Ndc, rays: RaySet, background: str, options: CanonicalOptions
) -> Hull | None:
    """Where the subject can be by its mattes; None without, or as published, which looks everywhere."""
    if rays.opacity is None or options.box_search == "coarse":
        return None
    shape = (options.hull_resolution, options.hull_resolution, options.planes)
    kept = visual_hull(frames, CUBE, shape, background, ndc=ndc)
    return (grown(kept), CUBE) if bool(kept.any()) else None
