"""Expected errors of rendered pictures: what is seen less is less sure, and errors fall as confidence rises."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.confidence import Confidence, every_nth
from devrf.reconstruct.confidence_curve import PER_PICTURE, curve, errors
from devrf.reconstruct.confidence_subject import subject_confidence
from devrf.reconstruct.error_map import confidence_picture
from devrf.reconstruct.evaluate import LpipsNets, evaluate
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.ndc import CUBE, Ndc
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.shell import Shell

SOLID = 0.9  # opacity of pixels that surely show the ball


@pytest.fixture(scope="module")
def moving(ball, rest: RestModel) -> DynamicModel:
    """The ball at rest as it was learned, moved as it truly moves."""
    keys, travel = 5, torch.tensor(ball.travel, dtype=torch.float32)
    motion = MotionField.still(
        torch.tensor([[-1.0] * 3, [1.0] * 3]), keys, 4, t_first=0.0, t_last=1.0, rest_key=0, device="cpu"
    )
    shares = torch.linspace(0, 1, keys)[:, None, None, None, None] * travel
    motion.forward += shares
    motion.backward -= shares
    return DynamicModel(rest, motion)


@pytest.fixture(scope="module")
def known(ball, moving: DynamicModel) -> Confidence:
    return Confidence(ball.scene, moving)


def shown(confidence: Confidence, camera: Camera, time: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Expected errors of a view, and where it surely shows the ball."""
    layers = confidence.render(camera, time)
    return confidence.expected(camera, time, layers), layers[2] > SOLID


def only(scene: Scene, names: set[str]) -> Scene:
    """The scene with only these cameras to train on, besides the sweep."""
    return replace(
        scene, dynamic=tuple(f for f in scene.dynamic if f.camera_name in names or f.split == "test")
    )


def test_a_part_that_fewer_cameras_see_is_less_sure(ball, known: Confidence, moving: DynamicModel) -> None:
    view = next(f for f in ball.scene.dynamic if f.camera_name == "cam1" and f.time == 1.0).camera
    layers = known.render(view, 1.0)
    across = Confidence(only(ball.scene, {"cam2"}), moving)
    all_see, one_sees = (c.seen(view, 1.0, layers) for c in (known, across))
    ball_there = all_see.opacity > SOLID
    assert all_see.moves[ball_there].mean() > 0.9
    hidden = (one_sees.in_motion == 0) & (all_see.in_motion > 0) & ball_there
    assert hidden.sum() > 5
    assert np.median(one_sees.expected[hidden] / all_see.expected[hidden]) > 1.5**2
    assert (one_sees.in_motion <= all_see.in_motion)[ball_there].all()
    nobody = ~all_see.moves | (all_see.in_motion == 0)
    at_rest = known.seen(view, None, known.render(view, None))
    assert not at_rest.moves.any() and not at_rest.in_motion.any() and nobody.any()


def test_each_of_many_cameras_witnesses_more_than_the_scene_at_rest_and_the_end(
    ball, moving: DynamicModel
) -> None:
    clip = [f for f in ball.scene.dynamic if f.camera_name == "cam0"]
    six = tuple(replace(f, camera_name=f"cam{n}") for n in range(6) for f in clip)
    known = Confidence(replace(ball.scene, static=(), dynamic=six), moving)
    assert [[w.time for w in each] for each in known.fixed.values()] == [[0, 0.5, 1]] * 6


def test_a_part_that_no_sweep_picture_shows_is_less_sure(ball, rest: RestModel) -> None:
    front = tuple(f for f in ball.scene.static if f.camera.centre[0] > 0)
    known = Confidence(replace(ball.scene, static=front, dynamic=()), DynamicModel(rest))
    sides = {
        side: next(f.camera for f in ball.scene.static if side * f.camera.centre[0] > 2) for side in (1, -1)
    }
    before, behind = (shown(known, sides[side], None) for side in (1, -1))
    assert np.median(behind[0][behind[1]]) > 1.5 * np.median(before[0][before[1]])


@pytest.mark.parametrize("moves", [True, False])
def test_what_is_less_sure_is_more_wrong(
    ball, rest: RestModel, moving: DynamicModel, moves: bool, tmp_path: Path
) -> None:
    """Measured against the test pictures, which are not read before: ranks of all pixels, and of the ball's own."""
    scene = ball.scene if moves else replace(ball.scene, dynamic=())
    spoilt = replace(
        scene,
        static=tuple(_without_picture(f, tmp_path) for f in scene.static),
        dynamic=tuple(_without_picture(f, tmp_path) for f in scene.dynamic),
    )
    known = Confidence(spoilt, moving if moves else DynamicModel(rest))
    out = evaluate(
        scene,
        lambda camera, time: known.render(camera, time)[0],
        LpipsNets.load(None),
        tmp_path,
        confidence=known,
    )
    curves = out["confidence"]
    for name in ("test", "test_static") + ("test_moving",) * moves:
        found = curves[name]
        measured = [part["measured_rms"] for part in found["bins"]]
        assert found["spearman"] > 0.4, name
        assert np.mean(measured[-2:]) > 1.5 * np.mean(measured[:5]), name
        assert sum(part["share"] for part in found["bins"]) == pytest.approx(1)
    # the motion is the true one even where nobody could see it: there, more is expected than comes
    assert 0.7 < curves["test"]["expected_rms"] / curves["test"]["measured_rms"] < 4
    assert curves["test_static"]["pixels"] == 2 * 48 * 40
    if not moves:
        assert curves["test_static"] == curves["test"]
        assert curves["test_moving"] == {"pixels": 0, "why": "nothing moves in this capture"}
    rows = [row for row in out["per_view"] if "error" in row]
    assert len(rows) == (7 if moves else 2) and all("confidence" in row for row in rows)
    picture = np.asarray(Image.open(tmp_path / rows[-1]["confidence"]))
    assert picture.dtype == np.uint8 and picture.ndim == 2
    assert picture[0, 0] > picture[20, 24] > 0  # plain background is surer than the ball


def _without_picture(frame: PosedFrame, folder: Path) -> PosedFrame:
    return frame if frame.split == "train" else replace(frame, path=folder / "missing.png")


def test_what_no_moving_camera_sees_is_counted(ball, known: Confidence, moving: DynamicModel) -> None:
    """All around a ball, three cameras in half a turn leave a quarter and less, one leaves more than half."""
    found = subject_confidence(ball.scene, known)
    fewer = subject_confidence(ball.scene, Confidence(only(ball.scene, {"cam0"}), moving))
    for shares in (found, fewer):
        assert shares["moves"] and sum(part["share"] for part in shares["seen_by"]) == pytest.approx(1)
        assert shares["seen_by"][0] == {
            "cameras": 0,
            "share": shares["unseen_share"],
            "expected_rms": shares["seen_by"][0]["expected_rms"],
        }
        errors = [part["expected_rms"] for part in shares["seen_by"]]
        assert errors[0] == max(errors)
    assert found["unseen_share"] < 0.35 and 0.5 < fewer["unseen_share"] < 0.8
    squared = [sum(p["share"] * p["expected_rms"] ** 2 for p in s["seen_by"]) for s in (found, fewer)]
    assert squared[1] > 1.2 * squared[0] and fewer["low_share"] >= found["low_share"]


def test_a_stray_floater_is_not_the_subject(ball, rest: RestModel) -> None:
    """A quiet scene in which a few points of the surface moved: the subject is all that is in the box."""
    motion = MotionField.still(
        torch.tensor([[-1.0] * 3, [1.0] * 3]), 2, 16, t_first=0.0, t_last=1.0, rest_key=0, device="cpu"
    )
    motion.backward[1, 10, 8, 8] += 0.2  # a vertex on the ball's surface
    motion.forward[1, 10, 8, 8] -= 0.2
    found = subject_confidence(ball.scene, Confidence(ball.scene, DynamicModel(rest, motion)))
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
def test_rooms_and_forward_scenes(ball, kind: str, tmp_path: Path) -> None:
    """Finite numbers for models with surroundings, and for those in normalised device coordinates."""
    ndc = Ndc(0.6, 0.45) if kind == "forward" else None
    aabb = CUBE if ndc else torch.tensor([[-1.0] * 3, [1.0] * 3])
    canonical = Canonical.new(
        aabb, 16, 16, channels=4, mlp_width=8, stepsize=0.5, alpha_init=1e-2, alpha_threshold=1e-4,
        weight_threshold=1e-4, device="cpu", seed=0, planes=16 if ndc else None, ndc=ndc,
    )  # fmt: skip
    canonical.density += 4 + 2 * torch.randn(
        canonical.density.shape, generator=torch.Generator().manual_seed(0)
    )
    canonical.rebuild_occupancy()
    canonical.net.requires_grad_(False)
    shell = None
    if ndc is None:
        shell = Shell.new(aabb, 12, 12, near=0.3, device="cpu")
        shell.rebuild_occupancy()
    model = RestModel(canonical, shell, "white" if ndc else "shell", 0.3, 9.0, {})
    motion = MotionField.still(aabb, 3, 4, t_first=0.0, t_last=1.0, rest_key=0, device="cpu")
    motion.backward[1:] += 0.05
    scene = replace(ball.scene, background=model.background)
    if ndc is not None:

        def ahead(frames: tuple[PosedFrame, ...]) -> tuple[PosedFrame, ...]:
            """The same pictures, of cameras beside each other that look along +z."""
            cameras = [replace(f.camera, cam_from_world=np.eye(4)[:3].copy()) for f in frames]
            for n, camera in enumerate(cameras):
                camera.cam_from_world[0, 3] = 0.01 * n
            return tuple(replace(f, camera=camera) for f, camera in zip(frames, cameras, strict=True))

        scene = replace(scene, static=ahead(scene.static), dynamic=ahead(scene.dynamic), ndc=(0.6, 0.45))
    known = Confidence(scene, DynamicModel(model, motion))
    frame = next(f for f in scene.dynamic if f.split == "test" and f.time == 0.5)
    layers = known.render(frame.camera, 0.5)
    expected = known.expected(frame.camera, 0.5, layers)
    assert np.isfinite(expected).all() and (expected > 0).all() and (expected <= 1).all()
    seen = known.seen(frame.camera, 0.5, layers)
    assert seen.in_sweep[seen.opacity > SOLID].mean() > 1
    assert np.isfinite(subject_confidence(scene, known)["low_share"])


def test_curve_of_known_errors() -> None:
    rng = np.random.default_rng(0)
    expected = rng.uniform(0.01, 0.2, (60, 50))
    true = np.zeros((60, 50, 3))
    rendered = np.repeat(expected[..., None], 3, axis=2)
    found = curve([errors(expected, rendered, true)], "")
    assert found["spearman"] == pytest.approx(1) and found["pixels"] == 3000
    for part in found["bins"]:
        assert part["expected_rms"] == pytest.approx(part["measured_rms"])
    blind = curve([errors(rng.permutation(expected.reshape(-1)).reshape(60, 50), rendered, true)], "")
    assert abs(blind["spearman"]) < 0.1
    assert curve([], "none held out") == {"pixels": 0, "why": "none held out"}


def test_a_curve_keeps_only_its_pixels_of_a_picture() -> None:
    expected, picture = np.full((400, 500), 0.1, np.float32), np.zeros((400, 500, 3), np.float32)
    kept = errors(expected, picture, picture)
    assert kept.shape == (2, PER_PICTURE) and kept.base is None


def test_grey_of_expected_errors() -> None:
    db = np.array([[5.0, 10.0, 25.0, 40.0, 60.0]])
    np.testing.assert_array_equal(confidence_picture(10 ** (-db / 20)), [[0, 0, 128, 255, 255]])
