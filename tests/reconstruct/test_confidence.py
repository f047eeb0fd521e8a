"""How many cameras see what a model shows: of a ball that moves, of rooms and of forward scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.make.models import NDC, UNIT_BOX, canonical, still, straight

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.evaluation.confidence import Witnesses, every_nth, subject_seen
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.contracted_background import Shell, grey
from devrf.reconstruct.fields.ndc import CUBE
from devrf.reconstruct.rendering.model import DynamicModel

SOLID = 0.9  # opacity of pixels that surely show the ball


@pytest.fixture(scope="module")
def moving(ball, rest: RestModel) -> DynamicModel:
    """The ball at rest as it was learned, moved as it truly moves."""
    return DynamicModel(rest, straight(UNIT_BOX, ball.travel, keys=5))


@pytest.fixture(scope="module")
def known(ball, moving: DynamicModel) -> Witnesses:
    return Witnesses(ball.scene, moving)


def only(scene: Scene, names: set[str]) -> Scene:
    """The scene with only these cameras to train on, besides the sweep."""
    return replace(
        scene, dynamic=tuple(f for f in scene.dynamic if f.camera_name in names or f.split == "test")
    )


def test_one_camera_sees_less_than_three(ball, known: Witnesses, moving: DynamicModel) -> None:
    view = next(f for f in ball.scene.dynamic if f.camera_name == "cam1" and f.time == 1.0).camera
    across = Witnesses(only(ball.scene, {"cam2"}), moving)
    all_see, one_sees = (witnesses.seen(view, 1.0) for witnesses in (known, across))
    ball_there = all_see.opacity > SOLID
    assert all_see.moves[ball_there].mean() > 0.9
    hidden = (one_sees.in_motion == 0) & (all_see.in_motion > 0) & ball_there
    assert hidden.sum() > 5
    assert (one_sees.in_motion <= all_see.in_motion)[ball_there].all()
    at_rest = known.seen(view, None)
    assert not at_rest.moves.any() and not at_rest.in_motion.any()


def test_each_of_many_cameras_witnesses_more_than_the_scene_at_rest_and_the_end(
    ball, moving: DynamicModel
) -> None:
    clip = [f for f in ball.scene.dynamic if f.camera_name == "cam0"]
    six = tuple(replace(f, camera_name=f"cam{n}") for n in range(6) for f in clip)
    known = Witnesses(replace(ball.scene, static=(), dynamic=six), moving)
    assert [[w.time for w in each] for each in known.fixed.values()] == [[0, 0.5, 1]] * 6


def test_a_part_that_no_sweep_picture_shows_is_seen_less(ball, rest: RestModel) -> None:
    front = tuple(f for f in ball.scene.static if f.camera.centre[0] > 0)
    known = Witnesses(replace(ball.scene, static=front, dynamic=()), DynamicModel(rest))
    sides = (next(f.camera for f in ball.scene.static if side * f.camera.centre[0] > 2) for side in (1, -1))
    before, behind = (known.seen(side, None) for side in sides)
    assert np.median(before.in_sweep[before.opacity > SOLID]) >= 3
    assert np.median(behind.in_sweep[behind.opacity > SOLID]) < 1


def test_no_picture_is_read(ball, moving: DynamicModel, tmp_path: Path) -> None:
    """Only poses are asked: of the test pictures, and of those that were trained on."""
    static, dynamic = (
        tuple(replace(f, path=tmp_path / "missing.png") for f in frames)
        for frames in (ball.scene.static, ball.scene.dynamic)
    )
    blind = replace(ball.scene, static=static, dynamic=dynamic)
    assert subject_seen(blind, moving) == subject_seen(ball.scene, moving)


def test_what_no_moving_camera_sees_is_counted(ball, moving: DynamicModel) -> None:
    """All around a ball, three cameras in half a turn leave a quarter and less, one leaves more than half."""
    found = subject_seen(ball.scene, moving)
    fewer = subject_seen(only(ball.scene, {"cam0"}), moving)
    for shares in (found, fewer):
        assert shares["moves"] and sum(part["share"] for part in shares["seen_by"]) == pytest.approx(1)
        assert shares["seen_by"][0] == {"cameras": 0, "share": shares["unseen_share"]}
    assert found["unseen_share"] < 0.35 and 0.5 < fewer["unseen_share"] < 0.8


def test_a_stray_floater_is_not_the_subject(ball, rest: RestModel) -> None:
    """A quiet scene in which a few points of the surface moved: the subject is all that is in the box."""
    motion = still(UNIT_BOX, 2, 16)
    motion.backward[1, 10, 8, 8] += 0.2  # a vertex on the ball's surface
    motion.forward[1, 10, 8, 8] -= 0.2
    found = subject_seen(ball.scene, DynamicModel(rest, motion))
    assert not found["moves"] and found["unseen_share"] is None
    assert max(part["cameras"] for part in found["seen_by"]) > 4  # pictures of the sweep


def test_witnesses_have_the_pixels_of_their_pictures(ball) -> None:
    """Every n-th pixel looks where the whole picture's does."""
    camera = ball.scene.static[0].camera
    small = every_nth(camera, 4)
    at = np.array([[0.5, 0.5], [3.5, 7.5]])
    np.testing.assert_allclose(small.directions(at), camera.directions(4 * at + 0.5), atol=1e-12)
    assert (small.width, small.height) == (12, 10)


@pytest.mark.parametrize("kind", ["room", "forward"])
def test_rooms_and_forward_scenes(ball, kind: str) -> None:
    """Models with surroundings, and those in normalised device coordinates."""
    ndc = NDC if kind == "forward" else None
    aabb = CUBE if ndc else UNIT_BOX
    model = canonical(aabb, planes=16, ndc=ndc)
    model.density += 4 + 2 * torch.randn(model.density.shape, generator=torch.Generator().manual_seed(0))
    model.rebuild_occupancy()
    model.net.requires_grad_(False)
    shell = None
    if ndc is None:
        shell = Shell(aabb, grey(12), 12, near=0.3).begun()
    rest = RestModel(model, shell, "white" if ndc else "shell", 0.3, 9.0, {})
    motion = still(aabb, 3, 4)
    motion.backward[1:] += 0.05
    scene = replace(ball.scene, background=rest.background)
    if ndc is not None:

        def ahead(frames: tuple[PosedFrame, ...]) -> tuple[PosedFrame, ...]:
            """The same pictures, of cameras beside each other that look along +z."""
            cameras = [replace(f.camera, cam_from_world=np.eye(4)[:3].copy()) for f in frames]
            for n, camera in enumerate(cameras):
                camera.cam_from_world[0, 3] = 0.01 * n
            return tuple(replace(f, camera=camera) for f, camera in zip(frames, cameras, strict=True))

        scene = replace(scene, static=ahead(scene.static), dynamic=ahead(scene.dynamic), ndc=(0.6, 0.45))
    frame = next(f for f in scene.dynamic if f.split == "test" and f.time == 0.5)
    seen = Witnesses(scene, DynamicModel(rest, motion)).seen(frame.camera, 0.5)
    assert seen.in_sweep[seen.opacity > SOLID].mean() > 1
    shares = [part["share"] for part in subject_seen(scene, DynamicModel(rest, motion))["seen_by"]]
    assert sum(shares) == pytest.approx(1)
