"""The table of parts: none is forgotten, each changes what it says and nothing else; intervals of paired gains."""

from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from scipy.stats import ttest_rel

from devrf.capture.scene import SparsePoints
from devrf.reconstruct.options import CanonicalOptions, MotionOptions, Options, preset
from devrf.reconstruct.paired import paired_gain
from devrf.reconstruct.parts import PARTS

pytestmark = pytest.mark.full

EVERYTHING = Options(
    replace(preset("fast").canonical, variation=1.0, opacity=0.1),
    replace(preset("fast").motion, one_camera=True),
)
NOT_PARTS = {  # sizes, effort, and machinery without which there is no training
    CanonicalOptions: {
        "resolution", "iterations", "rays", "rays_given", "samples", "channels", "planes", "shell_resolution",
        "learning_rate", "parts", "coarse_rays", "coarse_size", "hull_resolution",
        "occupancy_every", "seed",
    },
    MotionOptions: {
        "rays", "rays_given", "resolution", "most_keys", "learning_rate", "fine_tuning_given", "together_rays",
        "seed",
    },
}  # fmt: skip


def by_name(name: str):
    return next(part for part in PARTS if part.name == name)


def changed(before: Options, after: Options) -> set[tuple[str, str]]:
    pairs = ((stage, getattr(before, stage), getattr(after, stage)) for stage in ("canonical", "motion"))
    return {(s, f.name) for s, a, b in pairs for f in fields(a) if getattr(a, f.name) != getattr(b, f.name)}


def test_every_option_is_a_part_or_known_not_to_be_one(ball) -> None:
    reached = set().union(*(changed(EVERYTHING, part.without(ball.scene, EVERYTHING)[1]) for part in PARTS))
    for stage, of in (("canonical", CanonicalOptions), ("motion", MotionOptions)):
        missing = {f.name for f in fields(of)} - {name for s, name in reached if s == stage} - NOT_PARTS[of]
        assert not missing, f"{of.__name__}: {missing} need an entry in reconstruct/parts.py"
        assert NOT_PARTS[of] <= {f.name for f in fields(of)}


def test_names_are_distinct_and_a_part_changes_its_own_stage_alone(ball) -> None:
    assert len({part.name for part in PARTS}) == len(PARTS)
    for part in PARTS:
        stages = {stage for stage, _ in changed(EVERYTHING, part.without(ball.scene, EVERYTHING)[1])}
        assert stages <= {"canonical" if part.stage == "rest" else "motion"}, part.name


@pytest.mark.parametrize("name", ["tiny", "fast", "reference"])
def test_what_a_preset_lacks_is_not_in_use(ball, name: str) -> None:
    options = preset(name)
    used = {part.name for part in PARTS if part.in_use(ball.scene, options)}
    assert {"cycle", "flow", "variation", "entropy", "rest_entropy", "growing"} <= used
    assert ("fine_tuning" in used) == (name == "fast")
    assert ("deferred" in used) == (name != "reference")
    assert ("importance" in used) == ("rest_rate" in used) == ("small_mlp" in used) == (name != "reference")
    assert ("one_camera" in used) == (name == "reference")
    assert not {"rest_variation", "exact_times"} & used


def test_what_means_nothing_for_a_scene_is_not_in_use(ball) -> None:
    around = {"surroundings", "coarse_model", "sparse_points"}
    plain, options = ball.scene, preset("tiny")
    points = SparsePoints(np.zeros((1, 3)), np.zeros(1, np.int64), np.zeros(1, np.int64))
    rooms = replace(plain, background="shell"), replace(plain, background="shell", points=points)
    found = [{p.name for p in PARTS if p.in_use(scene, options)} for scene in (plain, *rooms)]
    assert not around & found[0] and {"silhouettes", "rest_opacity"} <= found[0]
    assert around & found[1] == around - {"sparse_points"} and around <= found[2]
    assert not {"silhouettes", "rest_opacity"} & found[2]
    deferred = preset("fast")  # samples have no colours of their own, but those of the surroundings have
    assert not {"per_point", "rest_per_point"} & {p.name for p in PARTS if p.in_use(plain, deferred)}
    assert {"per_point", "rest_per_point"} & {p.name for p in PARTS if p.in_use(rooms[0], deferred)} == {
        "rest_per_point"
    }


def test_levels_are_left_out_with_their_iterations(ball) -> None:
    options = preset("tiny")
    for name, kept in (("coarsest_level", (1, 2)), ("middle_levels", (0, 2)), ("finest_level", (0, 1))):
        motion = by_name(name).without(ball.scene, options)[1].motion
        assert motion.levels == tuple(options.motion.levels[n] for n in kept)
        assert motion.iterations == tuple(options.motion.iterations[n] for n in kept)
    one = replace(options, motion=replace(options.motion, levels=(7,), iterations=(50,)))
    assert not any(
        by_name(n).in_use(ball.scene, one) for n in ("coarsest_level", "middle_levels", "finest_level")
    )


def test_pictures_between_key_times_are_moved_to_the_nearest_and_test_views_are_not(ball) -> None:
    late = {"train": 0.04, "test": 0.03}
    dynamic = tuple(
        replace(f, time=f.time + late[f.split] * (f.camera_name != "cam0")) for f in ball.scene.dynamic
    )
    scene, options = replace(ball.scene, dynamic=dynamic), preset("tiny")
    assert by_name("exact_times").in_use(scene, options)
    rounded, same = by_name("exact_times").without(scene, options)
    assert same == options and len(rounded.dynamic) == len(dynamic)
    spacing = (max(f.time for f in dynamic if f.split == "train")) / 4  # five times of each camera
    for before, after in zip(dynamic, rounded.dynamic, strict=True):
        if before.split == "test":
            assert after == before
        else:
            assert after.time / spacing == pytest.approx(round(after.time / spacing), abs=1e-9)
            assert abs(after.time - before.time) <= spacing / 2 + 1e-9
    half = by_name("key_times").without(scene, options)[1]
    assert half.motion.keys == 3 and asdict(replace(half.motion, keys=None)) == asdict(options.motion)


def test_the_interval_is_students() -> None:
    gain = paired_gain([3.0, 5.0, 7.0], [2.0, 3.0, 4.0])  # 1, 2, 3: mean 2, deviation 1
    assert (gain.mean, gain.by_pair) == (2.0, (1.0, 2.0, 3.0))
    two_degrees_of_freedom = 4.302653  # Student's t at 97.5 %
    assert gain.half == pytest.approx(two_degrees_of_freedom / np.sqrt(3), rel=1e-6)
    assert gain.side() == 0 and not gain.nothing
    rng = np.random.default_rng(0)
    a, b = rng.normal(1.0, 1.0, 5).tolist(), rng.normal(0.0, 1.0, 5).tolist()
    interval = ttest_rel(a, b).confidence_interval(0.95)
    gain = paired_gain(a, b)
    assert gain.half is not None
    assert (gain.mean - gain.half, gain.mean + gain.half) == pytest.approx((interval.low, interval.high))


def test_measures_share_the_doubt() -> None:
    """Of two measures that add nothing at least one is called otherwise in one of twenty cases, not in two."""
    two = np.random.default_rng(0).normal(size=(4000, 2, 3))
    alarms = [any(paired_gain(m.tolist(), [0.0] * 3).side(2) for m in measures) for measures in two]
    assert np.mean(alarms) == pytest.approx(0.05, abs=0.01)


def test_signs_of_gains() -> None:
    assert paired_gain([1.0, 1.1], [0.0, 0.1]).side() == 1
    assert paired_gain([0.0, 0.1], [1.0, 1.1]).side() == -1
    assert paired_gain([1.0, 2.0], [1.0, 2.0]).nothing
    one = paired_gain([5.0], [1.0])
    assert one.half is None and one.side() == 0
    with pytest.raises(ValueError, match="2 and 1"):
        paired_gain([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="0 and 0"):
        paired_gain([], [])
