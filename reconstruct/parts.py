"""The parts of the model and of its training that can be left out, one by one: what `bench parts` measures.

A part is left out of a preset as it stands, and everything else stays. What departs from the published recipe for
speed goes back to the published value. A part that a preset does not have, or that means nothing for a scene, is
not in use there.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from devrf.capture.scene import Scene
from devrf.reconstruct.key_times import offered_keys
from devrf.reconstruct.options import FEWEST_COARSE, CanonicalOptions, MotionOptions, Options
from devrf.reconstruct.pictures import training

Setup = tuple[Scene, Options]
ON_A_KEY = 1e-6  # of the spacing of key times: as near as numbers get


@dataclass(frozen=True)
class Part:
    """One part.

    Attributes:
        name: On the command line and in results.
        stage: Of the training that it belongs to: `rest` or `motion`.
        what: It does, in words.
        without: The scene and the options that leave it out; the same scene, and equal options, where it is not in use.
        needs: Whether it can have an effect on a scene.
    """

    name: str
    stage: Literal["rest", "motion"]
    what: str
    without: Callable[[Scene, Options], Setup]
    needs: Callable[[Scene, Options], bool] = lambda scene, options: True

    def in_use(self, scene: Scene, options: Options) -> bool:
        """Whether leaving it out changes anything."""
        if not self.needs(scene, options):
            return False
        other, changed = self.without(scene, options)
        return other is not scene or changed != options


def _rest(**changes: Any) -> Callable[[Scene, Options], Setup]:
    return lambda scene, o: (scene, replace(o, canonical=replace(o.canonical, **changes)))


def _motion(**changes: Any) -> Callable[[Scene, Options], Setup]:
    return lambda scene, o: (scene, replace(o, motion=replace(o.motion, **changes)))


def _published(of: type, *names: str) -> dict[str, Any]:
    """Values of the published recipe: the options' defaults."""
    return {name: of.__dataclass_fields__[name].default for name in names}


def _around(scene: Scene, options: Options) -> bool:
    return scene.background == "shell"


def _plain(scene: Scene, options: Options) -> bool:
    return scene.background != "shell"


def _levels(chosen: slice) -> Callable[[Scene, Options], Setup]:
    def without(scene: Scene, o: Options) -> Setup:
        levels, iterations = o.motion.levels[chosen], o.motion.iterations[chosen]
        return (scene, o) if not levels else _motion(levels=levels, iterations=iterations)(scene, o)

    return without


def _ends_only(scene: Scene, o: Options) -> Setup:
    ends = (0, -1) if len(o.motion.levels) > 1 else (0,)
    levels, iterations = (tuple(of[n] for n in ends) for of in (o.motion.levels, o.motion.iterations))
    return _motion(levels=levels, iterations=iterations)(scene, o)


def _times_of_keys(scene: Scene, o: Options) -> Setup:
    """Every training picture is taken to be of the key time nearest to it; the scene itself, if all are at one."""
    times = [f.time or 0.0 for f in training(scene.dynamic)]
    first, spacing = min(times), (max(times) - min(times)) / (_keys(scene, o) - 1)

    def rounded(time: float) -> float:
        return first + round((time - first) / spacing) * spacing

    if all(abs(rounded(time) - time) <= ON_A_KEY * spacing for time in times):
        return scene, o
    dynamic = tuple(
        replace(f, time=rounded(f.time or 0.0)) if f.split == "train" else f for f in scene.dynamic
    )
    return replace(scene, dynamic=dynamic), o


def _keys(scene: Scene, o: Options) -> int:
    return offered_keys(training(scene.dynamic), o.motion)


PARTS: tuple[Part, ...] = (
    Part("cycle", "motion", "forth and back leads to the same place (DeVRF Eq. 5)", _motion(cycle=0.0)),
    Part("flow", "motion", "optical flow (DeVRF Eq. 6)", _motion(flow=0.0)),
    Part("flow_confidence", "motion", "vectors of flow by their confidence", _motion(flow_confidence=False),
         lambda scene, o: o.motion.flow > 0),
    Part("variation", "motion", "total variation of the motion (DeVRF Eq. 7)", _motion(variation=0.0)),
    Part("entropy", "motion", "rays in motion end in the box or pass", _motion(entropy=0.0)),
    Part("per_point", "motion", "each sample in motion has its ray's colour", _motion(per_point=0.0),
         lambda scene, o: not o.canonical.deferred),
    Part("importance", "motion", "rays drawn where pictures change", _motion(importance=0.0)),
    Part("coarsest_level", "motion", "first level, with its iterations", _levels(slice(1, None))),
    Part("middle_levels", "motion", "levels between first and last, with their iterations", _ends_only),
    Part("finest_level", "motion", "last level, with its iterations", _levels(slice(None, -1))),
    Part("key_times", "motion", "every second key time; without: interpolated",
         lambda scene, o: _motion(keys=max(2, (_keys(scene, o) + 1) // 2))(scene, o),
         lambda scene, o: not o.motion.adapt),
    Part("exact_times", "motion", "pictures between key times, at their own times", _times_of_keys),
    Part("fine_tuning", "motion", "the scene at rest follows all pictures", _motion(fine_tuning=0)),
    Part("motion_adapt", "motion", "key times and levels by the scene", _motion(adapt=False)),
    Part("movers", "motion", "parts are tracked, and trained with what stands", _motion(together=0), _around),
    Part("one_camera", "motion", "each step draws from one camera, as published", _motion(one_camera=False)),
    Part("motion_rate", "motion", "learning rate; without: the published one",
         _motion(**_published(MotionOptions, "lr"))),
    Part("motion_steps", "motion", "step along rays; without: the published one",
         _motion(**_published(MotionOptions, "stepsize"))),
    Part("motion_thresholds", "motion", "thresholds of samples; without: the published ones",
         _motion(**_published(MotionOptions, "alpha_threshold", "weight_threshold"))),
    Part("rest_entropy", "rest", "rays end in the box or pass", _rest(entropy=0.0)),
    Part("rest_per_point", "rest", "each sample has its ray's colour", _rest(per_point=0.0),
         lambda scene, o: not o.canonical.deferred or _around(scene, o)),
    Part("rest_opacity", "rest", "rays pass where mattes say so", _rest(opacity=0.0), _plain),
    Part("rest_variation", "rest", "total variation of density and features", _rest(variation=0.0)),
    Part("shell_variation", "rest", "surroundings plain before the last level", _rest(shell_variation=0.0), _around),
    Part("growing", "rest", "voxels double while training; without: all from the start, surroundings never plain first",
         _rest(scale_at=())),
    Part("late_growing", "rest", "when they double; without: as published",
         _rest(**_published(CanonicalOptions, "scale_at"))),
    Part("coarse_model", "rest", "training of the coarse model; without: one step of it",
         _rest(coarse_iterations=1), _around),
    Part("sparse_points", "rest", "lines of sight of the sweep's points carve",
         lambda scene, o: (scene if scene.points is None else replace(scene, points=None), o), _around),
    Part("surroundings", "rest", "background shell; without: white outside the box",
         lambda scene, o: (replace(scene, background="white"), o), _around),
    Part("silhouettes", "rest", "tight box from silhouettes; without: from a coarse model, as published",
         lambda scene, o: _rest(
             box_search="coarse", coarse_iterations=max(FEWEST_COARSE, o.canonical.coarse_iterations)
         )(scene, o) if o.canonical.box_search == "silhouettes" else (scene, o), _plain),
    Part("deferred", "rest", "colours once per ray; without: per sample", _rest(deferred=False)),
    Part("rest_adapt", "rest", "voxels by what pictures show", _rest(adapt=False)),
    Part("small_mlp", "rest", "narrow MLP; without: the published width",
         _rest(**_published(CanonicalOptions, "mlp_width"))),
    Part("rest_rate", "rest", "learning rate of grids; without: the published one",
         _rest(**_published(CanonicalOptions, "lr_grid"))),
    Part("rest_thresholds", "rest", "thresholds of samples; without: the published ones",
         _rest(**_published(CanonicalOptions, "alpha_threshold", "weight_threshold"))),
)  # fmt: skip
"""In this order they are measured."""
