"""Stage `scene` with mattes: who gets them, what they do to background and box, what rows say."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.judged import fired, judged, named
from tests.refused import refused

from devrf.calibration.colour.colours import Colours
from devrf.calibration.colour.match import Apart
from devrf.calibration.extent.bounds import Bounds, Silhouettes, scene_bounds
from devrf.calibration.extent.motion_masks import MotionMask
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, write_rig
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture import view_axes
from devrf.capture.camera import Camera
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.frames import CameraFrames, FrameRecord, FrameSet
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.capture.system.errors import CaptureError, HealthError
from devrf.capture.system.progress import no_progress
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.box_rows import box_measures
from devrf.pipelines.health.matte_rows import matte_measures
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.scene import captured_scene
from devrf.pipelines.stages.scene import scene_stage as stage
from devrf.pipelines.stages.scene.scene_mattes import scene_mattes

WIDTH, HEIGHT, FOCAL = 64, 48, 70.0
BALL = np.array([0.1, 0.0, 0.05])
RADIUS = 0.3
GREEN = np.array([40, 170, 80], np.uint8)


def look_at(angle: float, height: float = 0.5, distance: float = 2.5) -> Camera:
    """A camera around the origin; z is up."""
    eye = distance * np.array([np.cos(angle), np.sin(angle), height])
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(WIDTH, HEIGHT, K, view_axes.look_at(eye, np.zeros(3)))


def ball(camera: Camera, centre: np.ndarray) -> np.ndarray:
    """Where a camera sees the ball."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.directions(np.stack([u, v], axis=-1))
    return np.linalg.norm(np.cross(rays, centre - camera.centre), axis=-1) < RADIUS


class Session:
    """A run folder up to `rig`: a ball at rest for a sweep, and in motion for one fixed camera."""

    def __init__(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch, step: float = 0.004, behind: np.ndarray = GREEN
    ) -> None:
        self.folder, self.run, self.behind = folder, folder / "run", behind
        self.sweep = [look_at(a, 0.3 + 0.2 * (n % 3)) for n, a in enumerate(np.linspace(0, 6, 10))]
        self.fixed = look_at(0.4)
        self.true: dict[str, np.ndarray] = {}
        ingest = self.run / "ingest"
        cameras = {"static": self._filmed("static", [(c, BALL) for c in self.sweep], "sweep")}
        path = [(self.fixed, BALL + [0, step * n, 0]) for n in range(6)]
        cameras["cam0"] = self._filmed("cam0", path, "camera")
        FrameSet(cameras).write(ingest)
        (self.run / "static_poses").mkdir()
        (self.run / "static_poses" / "static_poses.json").write_text("{}")
        monkeypatch.setattr(captured_scene, "read_static_poses", lambda folder: self._model())
        (self.run / "rig").mkdir()
        write_rig(self.run / "rig" / "rig.json", Rig({"cam0": RigCamera(self.fixed, "given")}, ARBITRARY))
        (self.run / "colour").mkdir()
        Colours(self.run / "colour", None, {}, Apart(0, None, None)).write()
        (self.run / "sync").mkdir()
        clock = {
            "offset_s": 0.0,
            "drift_ppm": 0.0,
            "std_s": None,
            "method": "none",
            "confidence": 1.0,
            "basis": "",
        }
        (self.run / "sync" / "sync.json").write_text(json.dumps({"cameras": {"cam0": clock}}))

    def _filmed(self, name: str, views: list[tuple[Camera, np.ndarray]], role: Any) -> CameraFrames:
        rng, records = np.random.default_rng(len(name)), []
        (self.run / "ingest" / "frames" / name).mkdir(parents=True)
        for n, (camera, centre) in enumerate(views):
            mask = ball(camera, centre)
            picture = np.where(mask[..., None], [190, 60, 70], self.behind).astype(np.int16)
            picture += rng.integers(-3, 4, picture.shape)
            file = f"frames/{name}/{n:06d}.png"
            write_png(self.run / "ingest" / file, picture.clip(0, 255).astype(np.uint8))
            self.true[file] = mask
            records.append(FrameRecord(n, None if role == "sweep" else n / 10, 1.0, True, file))
        return CameraFrames(role, f"{name}.mp4", WIDTH, HEIGHT, 10.0, False, False, None, 0, tuple(records))

    def _model(self) -> SweepModel:
        """Points on the ball and far around it; every camera sees all that lies in its picture."""
        rng = np.random.default_rng(0)
        on = rng.normal(size=(40, 3))
        on = BALL + 0.8 * RADIUS * on / np.linalg.norm(on, axis=1, keepdims=True)
        around = rng.uniform(-1, 1, (200, 3))
        around = 6 * around / np.linalg.norm(around, axis=1, keepdims=True)
        xyz = np.concatenate([on, around])
        pairs = []
        for n, camera in enumerate(self.sweep):
            pixel = np.nan_to_num(camera.project(xyz), nan=-1.0)
            seen = ((pixel >= 0) & (pixel < [WIDTH, HEIGHT])).all(1)
            pairs += [(p, n) for p in np.flatnonzero(seen)]
        point, image = np.array(pairs).T
        names = tuple(f"static/{n:06d}.png" for n in range(len(self.sweep)))
        count = len(xyz)
        return SweepModel(
            names, tuple(self.sweep), xyz, np.zeros((count, 3), np.uint8), np.zeros(count), point, image,
            np.zeros((len(point), 2)), np.zeros((len(point), 128), np.uint8), {},
        )  # fmt: skip

    def write_mattes(self, folder: str, *names: str) -> None:
        """The true mattes as people would bring them."""
        for file, mask in self.true.items():
            _, name, picture = file.split("/")
            if name in names:
                (self.folder / folder / name).mkdir(parents=True, exist_ok=True)
                write_png(self.folder / folder / name / picture, mask.astype(np.uint8) * 255)

    def scene(self, mattes: object) -> tuple[Scene, dict[str, Any], Path]:
        """Run the stage: the scene as it is read again, its rows, its folder."""
        capture = {"static": "static.mp4", "cameras": {"cam0": "cam0.mp4"}, "mattes": mattes}
        config = SceneConfig.model_validate({"name": "ball", "capture": capture})
        out = self.run / f"scene{len(list(self.run.glob('scene*')))}"
        out.mkdir()
        context = StageContext(config, self.folder, self.run, out, lambda done, text: None, "cpu")
        stage.run(context)
        return read_scene(out), named(context.health), out


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Session:
    return Session(tmp_path, monkeypatch)


@pytest.mark.parametrize("method", ["given", pytest.param("chroma", marks=pytest.mark.full)])
def test_mattes_of_every_picture_make_the_background_plain(session: Session, method: str) -> None:
    session.write_mattes("mattes", "static", "cam0")
    scene, rows, out = session.scene("mattes" if method == "given" else "chroma")
    assert scene.background == "white"
    assert all(row.verdict == "ok" for name, row in rows.items() if name != "box-unexplained"), rows
    for frame in scene.frames:
        true = session.true[f"frames/{frame.camera_name}/{frame.path.name}"]
        assert frame.matte is not None
        assert frame.matte == (out / "mattes" / frame.camera_name / frame.path.name).resolve()
        # an edge that is off by one pixel all around
        ring = cv2.dilate(true.astype(np.uint8), np.ones((3, 3))) - cv2.erode(
            true.astype(np.uint8), np.ones((3, 3))
        )
        wrong = (read_pixels(frame.matte)[..., 0] > 127) != true
        assert not (wrong & (ring == 0)).any()
        assert (load_image(frame, 1.0, scene.background)[~true & (ring == 0)] == 255).all()
    # the box holds the ball and hardly more; the points are those on the ball
    corners = (scene.aabb[1] - scene.aabb[0]) / np.linalg.norm(scene.box_from_world[0, :3])
    assert (2 * RADIUS < corners).all() and (corners < 2 * RADIUS * 1.6).all(), corners
    assert scene.points is not None and 30 <= len(scene.points.xyz) <= 40
    assert np.linalg.norm(scene.points.xyz - BALL, axis=1).max() < RADIUS


def test_mattes_of_the_moving_cameras_leave_the_surroundings(session: Session) -> None:
    session.write_mattes("mattes", "cam0")
    scene, rows, _ = session.scene("mattes")
    assert scene.background == "shell"
    assert all(f.matte is None for f in scene.static) and all(f.matte is not None for f in scene.dynamic)
    for frame in (scene.static[0], scene.dynamic[0]):
        np.testing.assert_array_equal(load_image(frame, 1.0, "shell"), read_pixels(frame.path))


def test_without_mattes_nothing_changes(session: Session) -> None:
    scene, rows, out = session.scene(None)
    assert scene.background == "shell" and all(f.matte is None for f in scene.frames)
    assert not (out / "mattes").exists()


def test_swapped_mattes_are_used_and_said(session: Session) -> None:
    session.write_mattes("mattes", "static", "cam0")
    for file in (session.folder / "mattes" / "cam0").glob("*.png"):
        write_png(file, 255 - read_pixels(file)[..., 0])
    scene, rows, _ = session.scene("mattes")
    row = rows["matte-empty"]
    assert row.verdict == "warn" and "cam0" in row.value and "static" not in row.value
    assert "capture.mattes.inverted" in row.remedy
    true = session.true["frames/cam0/000000.png"]
    matte = scene.dynamic[0].matte
    assert matte is not None
    np.testing.assert_array_equal(read_pixels(matte)[..., 0] > 127, true)


@pytest.mark.parametrize(("name", "level"), [("cam0", 0), ("static", 255)])
def test_mattes_that_tell_nothing_have_a_row(session: Session, name: str, level: int) -> None:
    session.write_mattes("mattes", "static", "cam0")
    for file in (session.folder / "mattes" / name).glob("*.png"):
        write_png(file, np.full((HEIGHT, WIDTH), level, np.uint8))
    about = "sweep" if name == "static" else name
    row = session.scene("mattes")[1][f"matte-empty {about}"]
    assert (row.verdict, row.value) == ("warn", 1.0)


@pytest.mark.full
def test_a_common_colour_is_no_screen_unless_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(tmp_path, monkeypatch, behind=np.array([170, 130, 30], np.uint8))
    row = session.scene("chroma")[1]["screen-colour"]
    assert row.verdict == "fail" and isinstance(row.value, str)
    assert f"({row.value})" in row.remedy
    assert re.fullmatch("static #[0-9a-f]{6}, cam0 #[0-9a-f]{6}", row.value)
    assert "screen-colour" not in session.scene({"method": "chroma", "colour": "#aa821e"})[1]


@pytest.mark.parametrize("found", ["none", "doubtful"])
@pytest.mark.parametrize("cameras", [2, 3])
def test_a_camera_without_its_screen_is_left_out_where_others_are_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cameras: int, found: str
) -> None:
    """It stands before a wall: no screen is found, or a large cloth of another colour is taken for one."""
    session = Session(tmp_path, monkeypatch)
    filmed, moving = FrameSet.read(session.run / "ingest"), []
    for n in range(1, cameras):
        session.behind = (
            GREEN if n < cameras - 1 else np.array([[90, 90, 90], [170, 60, 160]][found == "doubtful"])
        )
        view = look_at(0.4 + n)
        clip = session._filmed(f"cam{n}", [(view, BALL)] * 3, "camera")
        filmed.cameras[f"cam{n}"] = clip
        moving += [frame_of(session, view, f"cam{n}", k) for k in range(3)]
    moving += [frame_of(session, session.fixed, "cam0", k) for k in range(6)]
    capture = {"static": "static.mp4", "cameras": {n: f"{n}.mp4" for n in filmed.moving}, "mattes": "chroma"}
    config = SceneConfig.model_validate({"name": "ball", "capture": capture})
    out = session.folder / "out"
    out.mkdir()
    context = StageContext(config, session.folder, session.run, out, lambda done, text: None, "cpu")
    last = f"cam{cameras - 1}"
    if cameras == 2 and found == "none":
        with refused("key-colour-unfound", f"'{last}'", kind=HealthError):
            scene_mattes(context, filmed, (), tuple(moving), no_progress)
        return
    mattes = scene_mattes(context, filmed, (), tuple(moving), no_progress)
    assert mattes is not None
    kept = {frame.camera_name for frame in mattes.dynamic}
    assert kept == set(mattes.cameras) == set(filmed.moving) - ({last} if cameras == 3 else set())
    rows = fired([*context.measures, *matte_measures(mattes)])
    assert ("screen-colour" in rows) == (cameras == 2)
    assert [row.about for row in rows.values() if row.code == "camera-left-out"] == [last] * (cameras == 3)


def frame_of(session: Session, view: Camera, name: str, n: int) -> PosedFrame:
    path = session.run / "ingest" / f"frames/{name}/{n:06d}.png"
    return PosedFrame(path, view, name, n, n / 10, n / 10, "train")


def test_a_missing_matte_is_named(session: Session) -> None:
    session.write_mattes("mattes", "static", "cam0")
    (session.folder / "mattes" / "cam0" / "000003.png").unlink()
    with refused("matte-missing", "cam0: ", " 1 of ", " 6 ", "000003.png", kind=CaptureError):
        session.scene("mattes")


# --- the box ---


def test_a_subject_that_leaves_the_box_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The box is where the ball rests; the ball moves by more than its radius."""
    session = Session(tmp_path, monkeypatch, step=0.08)
    rest = [MotionMask(c, ball(c, BALL)) for c in session.sweep]
    bounds = scene_bounds(session.sweep, [], np.zeros((0, 3)), np.zeros(0), Silhouettes(rest))
    session.write_mattes("mattes", "cam0")
    config = {"static": "static.mp4", "cameras": {"cam0": "cam0.mp4"}, "mattes": "mattes"}
    scene = session.scene("mattes")[0]
    mattes = _mattes(session, config, scene)
    leaving = fired(box_measures(bounds, {}, mattes, scene.dynamic))["box-cuts cam0"]
    assert re.search(r" in [1-5] of 6 pictures", str(leaving.value)) and "scene/mattes/cam0" in leaving.remedy
    wide = replace(bounds, aabb=3 * bounds.aabb)
    assert fired(box_measures(wide, {}, mattes, scene.dynamic)) == {}


def _mattes(session: Session, capture: dict[str, object], scene: Scene) -> Any:
    from devrf.pipelines.stages.scene.scene_mattes import scene_mattes

    config = SceneConfig.model_validate({"name": "ball", "capture": capture})
    context = StageContext(
        config, session.folder, session.run, session.folder / "again", lambda done, text: None, "cpu"
    )
    context.out.mkdir()
    frames = FrameSet.read(session.run / "ingest")
    return scene_mattes(context, frames, scene.static, scene.dynamic, lambda done, text: None)


FIXED = [look_at(a) for a in (0.0, 0.6, 1.2, 1.8)]


@pytest.fixture(scope="module")
def bounds() -> Bounds:
    """The box of the ball before four fixed cameras."""
    masks = [MotionMask(c, ball(c, BALL)) for c in FIXED]
    return scene_bounds(FIXED, FIXED, np.zeros((100, 3)), np.full(100, 2.5), Silhouettes(masks))


def test_changes_outside_the_box_and_blind_corners(bounds: Bounds) -> None:
    moves = {f"cam{n}": MotionMask(c, ball(c, BALL)) for n, c in enumerate(FIXED)}
    masks, frames = list(moves.values()), session_frames(FIXED)
    assert fired(box_measures(bounds, moves, None, frames)) == {}

    passer = masks[2].mask.copy()
    passer[5:40, :20] = True  # somebody walks past one camera
    passed = moves | {"cam2": replace(masks[2], mask=passer)}
    found = fired(box_measures(bounds, passed, None, frames))
    assert list(found) == ["box-unexplained cam2", "box-cuts cam2"]
    assert all("cam2" in row.remedy for row in found.values())

    away = [FIXED[0], *(turned_away(c) for c in FIXED[1:])]
    assert "box-one-sided" in fired(box_measures(bounds, moves, None, session_frames(away)))


@pytest.mark.parametrize(("distance", "verdict"), [(2.5, "ok"), (12.0, "warn")])
def test_a_sweep_that_did_not_come_near_the_box_is_said(
    bounds: Bounds, distance: float, verdict: str
) -> None:
    """Fixed cameras stand 2.5 m away; from 12 m a pixel of the sweep covers several of theirs."""
    ring = session_frames([look_at(a, distance=distance) for a in np.linspace(0, 6, 10)])
    row = judged(box_measures(bounds, {}, None, session_frames(FIXED), ring))["box-not-swept"]
    assert row.verdict == verdict and bool(row.remedy) == (verdict == "warn")


def turned_away(camera: Camera) -> Camera:
    flip = np.diag([-1.0, 1.0, -1.0])
    return replace(camera, cam_from_world=flip @ camera.cam_from_world)


def session_frames(cameras: list[Camera]) -> list[Any]:
    from devrf.capture.scene import PosedFrame

    return [PosedFrame(Path("p.png"), c, f"cam{n}", 0, 0.0, 0.0, "train") for n, c in enumerate(cameras)]


# --- what follows ---


def test_a_scene_with_mattes_is_learned_before_a_plain_background(session: Session) -> None:
    """The box tightens around the ball, corners stay white, and the ball is where it is."""
    from devrf.reconstruct.options import CanonicalOptions
    from devrf.reconstruct.rendering.model import DynamicModel, render_view
    from devrf.reconstruct.training.train_canonical import train_canonical

    session.write_mattes("mattes", "static", "cam0")
    scene = session.scene("mattes")[0]
    options = CanonicalOptions(
        resolution=20, iterations=50, rays=384, samples=8192, channels=6, mlp_width=16, scale_at=(0.5,), opacity=0.1,
        alpha_threshold=1e-3, weight_threshold=1e-3, lr_grid=0.06, learning_rate=5.0, occupancy_every=20,
        hull_resolution=24,
    )  # fmt: skip
    model = train_canonical(scene, options)
    assert model.shell is None
    frame = next(f for f in scene.in_box_frame().static if f.split == "test")
    rendered = render_view(DynamicModel(model), frame.camera, None)
    true = load_image(frame, 1.0, "white") / 255
    assert np.mean((rendered - true) ** 2) < 0.01  # 20 dB
    np.testing.assert_allclose(rendered[0, 0], 1, atol=0.02)


def test_the_report_shows_them(session: Session, tmp_path: Path) -> None:
    from devrf.pipelines.report.capture_section import capture
    from devrf.pipelines.report.run_reader import RunFolder

    def shown(scene: Scene) -> list[tuple[str, list[bool]]]:
        run = RunFolder(tmp_path, ("scene",), {})
        run.__dict__["_scene"] = scene  # as read
        return [(name, [bool(uri) for uri, _ in pictures]) for name, pictures in capture(run)["mattes"]]

    session.write_mattes("mattes", "cam0")
    scene = session.scene("mattes")[0]
    assert shown(scene) == [("cam0", [True] * 3)] and shown(session.scene(None)[0]) == []
    for frame in scene.dynamic:
        assert frame.matte is not None
        frame.matte.unlink()  # a run folder that was tidied up by hand
    assert shown(scene) == [("cam0", [False] * 3)]
