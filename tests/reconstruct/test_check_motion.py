"""The motion against the pictures it was learned from: the ball's true motion, and what can be wrong with it."""

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tests.judged import fired
from tests.make.models import NDC, canonical, still
from tests.reconstruct.conftest import true_motion

from devrf.capture.scene import PosedFrame
from devrf.pipelines.health.training_rows import in_motion_measures
from devrf.reconstruct.evaluation.check_motion import (
    FEWEST_PICTURES,
    SHIFTS,
    MotionFit,
    _seen_by_others,
    better_shift,
    check_motion,
)
from devrf.reconstruct.evaluation.error_curves import error_curves
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.ndc import CUBE
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.retimed import retimed

GAP = 0.25  # from one of the ball's pictures to the next


@pytest.fixture(scope="module")
def true(ball, rest: RestModel) -> DynamicModel:
    """The ball at rest as it was learned, with the motion that it really has."""
    return moved(ball, rest, 1.0)


def moved(ball, rest: RestModel, way: float) -> DynamicModel:
    return DynamicModel(rest, true_motion(ball.scene, way * ball.travel))


def warnings(fits: dict[str, MotionFit]) -> list[str]:
    """Names of the rows that are not ok."""
    return list(fired(in_motion_measures(fits)))


def test_the_true_motion_fires_nothing(ball, true: DynamicModel) -> None:
    fits = check_motion(ball.scene, true)
    assert list(fits) == ["cam0", "cam1", "cam2"]
    assert all(f.gain_db > 5 and f.unreachable < 0.1 and f.better_at == 0 for f in fits.values()), fits
    assert all(fit.unmoved < 0.03 for fit in fits.values()), fits
    assert warnings(fits) == []


@pytest.mark.parametrize("way", [0.0, -1.0])
def test_no_motion_and_motion_the_other_way_gain_nothing(ball, rest: RestModel, way: float) -> None:
    fits = check_motion(ball.scene, moved(ball, rest, way))
    assert all(fit.gain_db < 0.1 for fit in fits.values())
    assert any(name.startswith("motion-gain") for name in warnings(fits))
    assert all(fit.unmoved > 0.3 if way == 0 else fit.unmoved < 0.1 for fit in fits.values()), fits
    assert any(name.startswith("motion-still") for name in warnings(fits)) == (way == 0)


def test_a_box_that_holds_little_of_the_motion_cannot_explain_it(ball, rest: RestModel) -> None:
    """A small box in a corner of the scene, which the ball never enters."""
    corner = copy(rest.canonical)
    corner.aabb = 0.1 * rest.canonical.aabb + 0.85
    model = moved(ball, replace(rest, canonical=corner), 1.0)
    assert model.motion is not None
    model.motion.aabb = corner.aabb
    fits = check_motion(ball.scene, model)
    assert all(fit.unreachable > 0.9 and fit.alone is None for fit in fits.values()), fits
    assert all(fit.unmoved < 0.01 for fit in fits.values()), fits
    assert any(name.startswith("motion-empty") for name in warnings(fits))


def test_what_others_see_of_a_ball(ball, true: DynamicModel) -> None:
    """Far cameras see half of a ball each: one a quarter turn away shares half of that, one on either side all of it,
    one opposite nothing. These stand 5.8 radii away and see 80 degrees to each side of the middle, 78 of every 160 in
    common at the height of the middle.
    """
    fits = check_motion(ball.scene, true)
    # cam0, cam1 and cam2 stand at 0, 90 and 180 degrees
    alone = {name: fit.alone for name, fit in fits.items()}
    assert alone["cam0"] == pytest.approx(0.5, abs=0.15) and alone["cam2"] == pytest.approx(0.5, abs=0.15)
    assert alone["cam1"] is not None and alone["cam1"] < 0.15
    one = replace(ball.scene, dynamic=tuple(f for f in ball.scene.dynamic if f.camera_name == "cam0"))
    fits = check_motion(one, true)
    assert fits["cam0"].alone == 1.0
    assert any(name.startswith("motion-one-sided") for name in warnings(fits))


def test_a_late_clock_is_named(ball, true: DynamicModel) -> None:
    """cam1's pictures are said to be half a gap later than they are: they fit the true motion half a gap earlier.

    The last one is then said to be of a time that is not modelled, and is left out, as `scene` does.
    """
    late = retimed(ball.scene, {"cam1": GAP / 2})
    fits = check_motion(late, true)
    assert fits["cam1"].better_at == -0.5 and fits["cam0"].better_at == fits["cam2"].better_at == 0.0
    assert "motion-late cam1" in warnings(fits)


def test_another_time_must_be_clearly_better() -> None:
    rng = np.random.default_rng(0)
    shifts = np.array(SHIFTS)
    right = 1 + 0.3 * shifts**2 + np.zeros((6, 1))
    assert better_shift(right) == 0.0
    assert better_shift(1 + 0.3 * (shifts + 1) ** 2 + np.zeros((6, 1))) == -1.0
    assert better_shift(right[:1]) == 0.0  # one picture tells nothing
    noise = 1 + 0.2 * rng.standard_normal((6, len(SHIFTS)))
    assert better_shift(noise) == 0.0
    # sure, and not worth a word
    assert better_shift(1 + 1e-3 * (shifts - 0.5) ** 2 + np.zeros((6, 1))) == 0.0


def test_few_pictures_of_noise_are_better_at_another_time_by_chance_alone() -> None:
    """Four pictures, the fewest that are asked: no shift is better, and 2.3 % of either side are said to be."""
    rng = np.random.default_rng(0)
    noise = 1 + 0.2 * rng.standard_normal((2000, FEWEST_PICTURES, len(SHIFTS)))
    # only half a picture is in question
    noise[:, :, np.abs(SHIFTS) != 0.5] += np.abs(SHIFTS[np.abs(SHIFTS) != 0.5])
    assert np.mean([better_shift(curves) != 0 for curves in noise]) < 2 * 0.023 + 3 * np.sqrt(0.046 / 2000)
    late = 1 + 0.3 * (SHIFTS - 0.5) ** 2 + np.zeros((FEWEST_PICTURES, 1))
    assert better_shift(late) == 0.5 and better_shift(late[1:]) == 0.0
    late[0, 4] = late[1, 0] = np.nan  # beyond the motion
    assert better_shift(late) == 0.5


def test_a_flicker_is_not_asked_to_be_explained(ball, true: DynamicModel, tmp_path: Path) -> None:
    """cam2 sees the scene at rest all the time, but for two by two pixels of one picture."""
    own = [f for f in ball.scene.dynamic if f.camera_name == "cam2"]
    flicker = cv2.imread(str(own[0].path), cv2.IMREAD_UNCHANGED)
    assert flicker is not None
    flicker[2:4, 2:4] = 0, 0, 0, 255
    cv2.imwrite(str(tmp_path / "flicker.png"), flicker)

    def quiet(frame: PosedFrame) -> PosedFrame:
        if frame.camera_name != "cam2":
            return frame
        return replace(frame, path=tmp_path / "flicker.png" if frame.index == own[2].index else own[0].path)

    scene = replace(ball.scene, dynamic=tuple(quiet(f) for f in ball.scene.dynamic))
    assert list(check_motion(scene, true)) == ["cam0", "cam1"]
    alone = replace(scene, dynamic=tuple(f for f in scene.dynamic if f.camera_name == "cam2"))
    assert check_motion(alone, true) == {}


def test_a_camera_that_moves_is_not_asked_but_sees(ball, true: DynamicModel, monkeypatch) -> None:
    """cam2 stands elsewhere in each picture; its pictures are not rendered, and cam1 still is not alone."""

    def walks(frame: PosedFrame) -> PosedFrame:
        if frame.camera_name != "cam2":
            return frame
        there = frame.camera.cam_from_world.copy()
        there[0, 3] += 1e-3 * frame.index
        return replace(frame, camera=replace(frame.camera, cam_from_world=there))

    rendered: list[int] = []

    def counted(*arguments: Any) -> Any:
        def box_at(model: DynamicModel, rays_o: torch.Tensor, *others: torch.Tensor) -> Any:
            rendered.append(len(rays_o))
            return true_box_at(model, rays_o, *others)

        with monkeypatch.context() as patch:
            patch.setattr(DynamicModel, "box_at", box_at)
            return error_curves(*arguments)

    true_box_at = DynamicModel.box_at
    monkeypatch.setattr("devrf.reconstruct.evaluation.check_motion.error_curves", counted)
    fits = check_motion(replace(ball.scene, dynamic=tuple(walks(f) for f in ball.scene.dynamic)), true)
    assert list(fits) == ["cam0", "cam1"] and len(rendered) == 2 * 5
    assert fits["cam1"].alone is not None and fits["cam1"].alone < 0.15


@pytest.mark.parametrize(
    ("z", "apart", "behind", "seen"),
    [
        (1.5, 0.3, 2, True),
        (1.5, 0.3, 10, False),
        (6.0, 1.2, 2, True),
        (6.0, 1.2, 10, False),
        (1.5, 0.02, 2, False),
    ],
)
def test_what_others_see_of_a_wall_in_a_forward_scene(
    ball, z: float, apart: float, behind: int, seen: bool
) -> None:
    """Points two voxels behind the wall are seen, ten behind are not, however many metres deep voxels are there; and
    none from right beside, where a pixel is metres of depth.
    """
    n = 48
    at_rest = canonical(CUBE, n, planes=n, ndc=NDC)
    wall = 1 - 2 / z
    at_rest.density.copy_(torch.where(torch.linspace(-1, 1, n) >= wall, 30.0, -30.0)[:, None])
    at_rest.rebuild_occupancy()
    at_rest.net.requires_grad_(False)
    model = DynamicModel(RestModel(at_rest, None, "white", 0.3, 9.0, {}), still(CUBE, 2, 4))
    at = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    two = []
    for side, frame in enumerate(
        f for f in ball.scene.dynamic if f.time == 0 and f.camera_name in ("cam0", "cam1")
    ):
        ahead = np.eye(4)[:3].copy()
        ahead[0, 3] = apart * side
        two.append(replace(frame, camera=replace(frame.camera, cam_from_world=ahead)))
    rays = RaySet(tuple(two), 1.0, "white")
    deep = torch.full((200, 1), wall + behind * 2 / (n - 1))
    points = NDC.to_world(torch.cat([at, deep], dim=1))
    first = torch.zeros(200, dtype=torch.int64)
    seen_from = rays.centres[:1].expand(200, 3)
    others = _seen_by_others(model, rays, first, seen_from, points, torch.zeros(200))
    assert others.float().mean() == float(seen)


def test_cameras_side_by_side_do_not_tell_depth(ball, true: DynamicModel) -> None:
    """cam1 moved to within 3 degrees of cam0, as seen from the middle: both see the same, from one side."""
    first = {f.index: f for f in ball.scene.dynamic if f.camera_name == "cam0"}
    middle = np.array(ball.scene.aabb).mean(axis=0)
    turn = cv2.Rodrigues(np.radians([0.0, 3.0, 0.0]))[0]
    about = np.concatenate([turn, (middle - turn @ middle)[:, None]], axis=1)

    def beside(frame: PosedFrame) -> PosedFrame:
        was = first[frame.index]
        pose = was.camera.cam_from_world
        moved = np.concatenate([pose[:, :3] @ about[:, :3], pose[:, :3] @ about[:, 3:] + pose[:, 3:]], axis=1)
        return replace(was, camera_name="cam1", camera=replace(was.camera, cam_from_world=moved))

    kept = tuple(f for f in ball.scene.dynamic if f.camera_name == "cam0")
    fits = check_motion(replace(ball.scene, dynamic=(*kept, *map(beside, kept))), true)
    assert all(fit.alone is not None and fit.alone > 0.95 for fit in fits.values()), fits
    assert any(name.startswith("motion-one-sided") for name in warnings(fits))


FINE = MotionFit(gain_db=4.0, unreachable=0.1, unmoved=0.02, alone=0.2, better_at=0.0)


@pytest.mark.parametrize(
    ("wrong", "codes"),
    [
        ({"gain_db": 1.4}, ["motion-gain right"]),
        ({"unreachable": 0.6}, ["motion-empty right"]),
        ({"unmoved": 0.1}, ["motion-still right"]),
        ({"better_at": -0.5}, ["motion-late right"]),
        ({"alone": None}, []),
    ],
)
def test_what_is_too_much(wrong: dict[str, Any], codes: list[str]) -> None:
    assert warnings({"left": FINE, "right": replace(FINE, **wrong)}) == codes


def test_what_cannot_be_told_is_not_asked() -> None:
    assert list(in_motion_measures({})) == []
    without_surface = in_motion_measures({"left": replace(FINE, alone=None)})
    assert [m.code for m in without_surface] == ["motion-gain", "motion-empty", "motion-still", "motion-late"]
