"""Expected errors of rendered pictures: what is seen less is less sure, and errors fall as confidence rises."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.confidence import Confidence
from devrf.reconstruct.confidence_curve import PER_PICTURE, ErrorCurve
from devrf.reconstruct.confidence_regions import weakest_regions
from devrf.reconstruct.error_causes import CAUSES, surface_of
from devrf.reconstruct.error_map import confidence_picture
from devrf.reconstruct.evaluate import LpipsNets, evaluate
from devrf.reconstruct.evidence import Evidence
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


def seen(confidence: Confidence, camera: Camera, time: float | None) -> tuple[np.ndarray, np.ndarray]:
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
    across = Confidence(only(ball.scene, {"cam2"}), moving)
    across.budget = known.budget  # the same factors: only what is seen differs
    (all_see, ball_there), (one_sees, _) = (seen(c, view, 1.0) for c in (known, across))
    surfaces = [surface_of(c.evidence, view, 1.0, known.render(view, 1.0)) for c in (known, across)]
    asked = np.ix_(surfaces[0].rows, surfaces[0].columns)
    all_see, one_sees, ball_there = (x[asked].reshape(-1) for x in (all_see, one_sees, ball_there))
    all_count, one_count = (s.motion.count for s in surfaces if s.motion is not None)
    hidden = (one_count == 0) & (all_count > 0) & ball_there
    assert hidden.sum() > 5
    assert known.budget.factors["place"] > 0
    assert np.median(one_sees[hidden] / all_see[hidden]) > 1.5
    assert (one_sees[ball_there] >= all_see[ball_there] * 0.999).mean() > 0.9


def test_each_of_many_cameras_witnesses_more_than_the_scene_at_rest_and_the_end(
    ball, moving: DynamicModel
) -> None:
    clip = [f for f in ball.scene.dynamic if f.camera_name == "cam0"]
    six = tuple(replace(f, camera_name=f"cam{n}") for n in range(6) for f in clip)
    evidence = Evidence(replace(ball.scene, static=(), dynamic=six), moving)
    assert [[w.frame.index for w in each] for each in evidence.fixed.values()] == [[0, 2, 4]] * 6


def test_a_part_that_no_sweep_picture_shows_is_less_sure(ball, rest: RestModel) -> None:
    front = tuple(f for f in ball.scene.static if f.camera.centre[0] > 0)
    model = DynamicModel(rest)
    known = Confidence(replace(ball.scene, static=front, dynamic=()), model)
    sides = {
        side: next(f.camera for f in ball.scene.static if side * f.camera.centre[0] > 2) for side in (1, -1)
    }
    before, behind = (seen(known, sides[side], None) for side in (1, -1))
    assert np.median(behind[0][behind[1]]) > 1.5 * np.median(before[0][before[1]])


def test_errors_fall_with_confidence(ball, known: Confidence) -> None:
    curve = ErrorCurve()
    for frame in (f for f in ball.scene.dynamic if f.split == "test"):
        true = load_image(frame, 1.0, "white").astype(np.float32) / 255
        layers = known.render(frame.camera, frame.time)
        curve.add(known.expected(frame.camera, frame.time, layers), layers[0], true)
    found = curve.summary("")
    measured = [part["measured_rms"] for part in found["bins"]]
    assert found["spearman"] > 0.5
    assert measured[-1] > 3 * np.mean(measured[:5])
    assert found["ause"] < 0.5 * found["ause_random"]
    # the motion is the true one even where nobody could see it: there, more is expected than comes
    assert 1 < found["expected_rms"] / found["measured_rms"] < 4
    assert found["bins"][-2]["expected_rms"] == pytest.approx(found["bins"][-2]["measured_rms"], rel=0.5)


def test_test_pictures_are_never_read(ball, known: Confidence, moving: DynamicModel, tmp_path: Path) -> None:
    def spoilt(frames: tuple[PosedFrame, ...]) -> tuple[PosedFrame, ...]:
        return tuple(f if f.split == "train" else replace(f, path=tmp_path / "missing.png") for f in frames)

    scene = replace(ball.scene, static=spoilt(ball.scene.static), dynamic=spoilt(ball.scene.dynamic))
    other = Confidence(scene, moving)
    assert other.budget == known.budget
    assert not {f"{f.camera_name} {f.index}" for f in scene.frames if f.split == "test"} & {
        f"{name} {index}" for name, index in known.budget.fitted_on
    }
    test = next(f for f in ball.scene.dynamic if f.split == "test" and f.time == 1.0)
    np.testing.assert_array_equal(seen(other, test.camera, 1.0)[0], seen(known, test.camera, 1.0)[0])


def test_pictures_and_curves_are_written(ball, known: Confidence, tmp_path: Path) -> None:
    out = evaluate(
        ball.scene,
        lambda camera, time: known.render(camera, time)[0],
        LpipsNets.load(None),
        tmp_path,
        confidence=known,
    )
    curves = out["confidence"]
    assert curves["test"]["pixels"] > curves["test_moving"]["pixels"] > 0
    assert curves["test_static"]["pixels"] == 2 * 48 * 40 and curves["test_static"] != curves["test"]
    assert sum(part["share"] for part in curves["test"]["bins"]) == pytest.approx(1)
    rows = [row for row in out["per_view"] if "error" in row]
    assert len(rows) == 7 and all("confidence" in row for row in rows)
    picture = np.asarray(Image.open(tmp_path / rows[-1]["confidence"]))
    assert picture.dtype == np.uint8 and picture.ndim == 2
    assert picture[0, 0] > picture[20, 24] > 0  # plain background is surer than the ball
    known.budget.save(tmp_path / "confidence.json")
    assert '"fitted_on"' in (tmp_path / "confidence.json").read_text()


def test_regions_name_what_no_moving_camera_sees(ball, known: Confidence, moving: DynamicModel) -> None:
    found = weakest_regions(ball.scene, known)
    assert found["moves"] and found["as_seen_by"] == "cam0"
    assert sum(region["share"] for region in found["regions"]) > 0.9
    one = Confidence(only(ball.scene, {"cam0"}), moving)
    one.budget = known.budget
    fewer = weakest_regions(ball.scene, one)
    sides = {
        side: np.mean([r["expected_rms"] for r in fewer["regions"] if side in r["where"]])
        for side in ("front", "back")
    }
    assert sides["back"] > 1.2 * sides["front"]  # cam0 looks at the front
    assert fewer["regions"][0]["cameras"] < found["regions"][-1]["cameras"]
    # All around a ball, three cameras in half a turn leave a quarter and less, one leaves more than half.
    assert found["unseen_share"] < 0.35 and 0.5 < fewer["unseen_share"] < 0.8


def test_a_stray_floater_is_not_the_subject(ball, rest: RestModel) -> None:
    """A quiet scene in which a few points of the surface moved: regions are of all that is in the box."""
    at_rest = Confidence(replace(ball.scene, dynamic=()), DynamicModel(rest))
    motion = MotionField.still(
        torch.tensor([[-1.0] * 3, [1.0] * 3]), 2, 16, t_first=0.0, t_last=1.0, rest_key=0, device="cpu"
    )
    motion.backward[1, 10, 8, 8] += 0.2  # a vertex on the ball's surface
    motion.forward[1, 10, 8, 8] -= 0.2
    found = weakest_regions(ball.scene, Confidence(ball.scene, DynamicModel(rest, motion)))
    assert not found["moves"] and found["unseen_share"] is None
    quiet = weakest_regions(replace(ball.scene, dynamic=()), at_rest)
    of = [sum(r["share"] * r["cameras"] for r in regions["regions"]) for regions in (found, quiet)]
    assert of[0] == pytest.approx(of[1], rel=0.1)  # pictures of the sweep, as the report says


def test_causes_of_displacement_together_are_bounded(ball, known: Confidence) -> None:
    """However far off: the picture is no more wrong than by two pixels that have nothing to do with each other."""
    view = next(f for f in ball.scene.dynamic if f.split == "test" and f.time == 1.0).camera
    layers, budget = known.render(view, 1.0), known.budget
    surface = surface_of(known.evidence, view, 1.0, layers)
    surface = replace(surface, places=replace(surface.places, cycle=np.ones(len(surface.places.now))))
    known.budget = replace(budget, factors={**dict.fromkeys(CAUSES, 0.0), "place": 1e9, "cycle": 1e9})
    expected = known.expected_of(surface, view, layers)
    known.budget = budget
    assert (expected.astype(float) ** 2).max() == pytest.approx(budget.ground.unrelated, rel=0.01)


def test_a_scene_at_rest(ball, rest: RestModel, tmp_path: Path) -> None:
    scene = replace(ball.scene, dynamic=())
    known = Confidence(scene, DynamicModel(rest))
    out = evaluate(
        scene, lambda c, t: known.render(c, t)[0], LpipsNets.load(None), tmp_path, confidence=known
    )
    assert out["confidence"]["test"]["spearman"] > 0.5
    assert out["confidence"]["test_static"] == out["confidence"]["test"]
    assert out["confidence"]["test_moving"] == {"pixels": 0, "why": "nothing moves in this capture"}
    assert not weakest_regions(scene, known)["moves"]


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
        shell = Shell.new(aabb, 12, 12, near=0.3, far=9.0, centres=torch.zeros(1, 3), device="cpu")
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
    assert set(known.budget.factors) == set(CAUSES) and min(known.budget.factors.values()) >= 0
    surface = surface_of(known.evidence, frame.camera, 0.5, layers)
    assert surface.rest.count[surface.opacity.reshape(-1) > SOLID].mean() > 1
    assert np.isfinite(weakest_regions(scene, known)["low_share"])


def test_curve_of_known_errors() -> None:
    rng = np.random.default_rng(0)
    expected = rng.uniform(0.01, 0.2, (60, 50))
    true = np.zeros((60, 50, 3))
    rendered = np.repeat(expected[..., None], 3, axis=2)
    curve = ErrorCurve()
    curve.add(expected, rendered, true)
    found = curve.summary("")
    assert found["spearman"] == pytest.approx(1) and found["ause"] == pytest.approx(0, abs=1e-12)
    for part in found["bins"]:
        assert part["expected_rms"] == pytest.approx(part["measured_rms"])
    blind = ErrorCurve()
    blind.add(rng.permutation(expected.reshape(-1)).reshape(expected.shape), rendered, true)
    worse = blind.summary("")
    assert abs(worse["spearman"]) < 0.1
    assert worse["ause"] == pytest.approx(worse["ause_random"], rel=0.1)
    assert ErrorCurve().summary("none held out") == {"pixels": 0, "why": "none held out"}


def test_a_curve_keeps_only_its_pixels_of_a_picture() -> None:
    expected, picture = np.full((400, 500), 0.1, np.float32), np.zeros((400, 500, 3), np.float32)
    curve = ErrorCurve()
    tracemalloc.start()
    for _ in range(5):
        curve.add(expected, picture, picture)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert curve.summary("")["pixels"] == 5 * PER_PICTURE
    assert held < 1.5 * 5 * PER_PICTURE * 16  # two numbers of eight bytes for each


def test_grey_of_expected_errors() -> None:
    db = np.array([[5.0, 10.0, 25.0, 40.0, 60.0]])
    np.testing.assert_array_equal(confidence_picture(10 ** (-db / 20)), [[0, 0, 128, 255, 255]])
