"""Stage `colour` through the command line: fixed cameras and a test camera of known colours."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from tests.calibration import coloured_room as room
from tests.conftest import Command

from devrf.calibration.colour.colours import CameraColour, Colours, read_colours
from devrf.calibration.colour.match import Apart
from devrf.calibration.rigs.rig import Rig, RigCamera, Scale, write_rig
from devrf.capture.colour.correction import Look
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.frames import SWEEP, CameraFrames, FrameRecord, FrameSet
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import load_image
from devrf.capture.system.progress import no_progress
from devrf.capture.video.video_writer import write_video
from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.health.colour_rows import colour_measures
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import colour

FRAMES, FPS = 12, 10.0
LOOKS = {
    "cam0": np.eye(3),
    "cam1": 0.65 * np.eye(3),
    "cam2": np.diag([1.25, 1.0, 0.7]),
    "witness": 0.7 * np.eye(3),
}
SIZE = (320, 240)
STANDS = {
    "cam0": room.camera(0.6, size=SIZE),
    "cam1": room.camera(0.8, -1.3, SIZE),
    "cam2": room.camera(1.0, -1.7, SIZE),
    "witness": room.camera(0.7, -1.6, SIZE),
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene file of a session whose cameras and clocks are given."""
    folder = tmp_path_factory.mktemp("coloured")
    for n, name in enumerate(STANDS):
        write_video(folder / f"{name}.mp4", _film(name, n), FPS, {"crf": "12"})
    cameras = {name: RigCamera(camera, "given") for name, camera in STANDS.items()}
    write_rig(folder / "given.json", Rig(cameras, Scale(True, "given", 1.0, None), "given"))
    content = {
        "name": "coloured",
        "output": "run",
        "preset": "tiny",
        "capture": {
            "cameras": {name: f"{name}.mp4" for name in ("cam0", "cam1", "cam2")},
            "test_cameras": {"witness": "witness.mp4"},
        },
        "calibration": {"sync": {"method": "none"}, "rig": {"given": "given.json"}},
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(content))
    return folder / "scene.yaml"


def _film(name: str, seed: int) -> Iterator[np.ndarray]:
    view = room.show(STANDS[name], LOOKS[name], noise=0.0).rgb
    rng = np.random.default_rng(seed)
    for n in range(FRAMES):
        picture = view + 2.5 * rng.standard_normal(view.shape)
        picture[70:90, 40 + 5 * n : 60 + 5 * n] = 60  # something that moves
        yield np.clip(picture, 0, 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def matched(devrf: Command, session: Path) -> Path:
    """The run folder, by surface points, up to the scene."""
    result = devrf("run", session, "--until", "scene")
    assert result.code == 0, result.said
    return session.parent / "run"


def again(session: Path, out: Path, *settings: str) -> tuple[Colours, list[HealthRow]]:
    """The stage once more on the same session, with other settings."""
    config = load_scene(session, [f"calibration.colour.{setting}" for setting in settings])
    out.mkdir()
    context = StageContext(config, session.parent, session.parent / "run", out, no_progress, "cpu")
    colour.run(context)
    return read_colours(out), context.health


def miss(colours: Colours, name: str) -> float:
    """How far a camera's correction is from what it should be."""
    return float(np.abs(np.array(colours.cameras[name].matrix) @ LOOKS[name] - np.eye(3)).max())


# --- by surface points ---


@pytest.mark.full
def test_the_looks_are_found(matched: Path) -> None:
    colours = read_colours(matched / "colour")
    assert colours.reference == "cam0"
    assert {name: (c.source, c.kind) for name, c in colours.cameras.items()} == {
        "cam0": ("reference", "none"),
        "cam1": ("points", "gain"),
        "cam2": ("points", "diagonal"),
        "witness": ("none", "none"),
    }
    for name in ("cam1", "cam2"):
        std = colours.cameras[name].stops_std
        assert std is not None and std < 0.01
        assert miss(colours, name) < 4 * std * np.log(2)  # as sure as it says
    for name, camera in colours.cameras.items():
        if name != "cam0":
            assert camera.stops is not None and camera.stops_std is not None
            true = np.log2(LOOKS[name][1, 1])
            # the median of green by noise, and the codec's half level at a mean of 110 of 255: 0.01
            assert abs(camera.stops - true) < 4 * camera.stops_std + 0.01
    # of what is left, noise of a level and the codec's; before: 0.62 stops, 0.32 in red, 0.51 in blue
    assert colours.total.before is not None and colours.total.after is not None
    assert colours.total.after < colours.total.before / 5


@pytest.mark.full
def test_pictures_of_the_scene_carry_them(matched: Path) -> None:
    scene = read_scene(matched / "scene")
    colours = read_colours(matched / "colour")
    for name in LOOKS:
        frame = next(f for f in scene.dynamic if f.camera_name == name)
        assert (frame.look is None) == (name in ("cam0", "witness"))  # of test pictures nothing is changed
        filmed, used, wanted = (
            cv2.resize(p[96:], (40, 18), interpolation=cv2.INTER_AREA).astype(float)  # below what moves
            for p in (
                read_pixels(frame.path)[..., :3],
                load_image(frame, 1.0, "white"),
                room.show(STANDS[name], noise=0.0).rgb,
            )
        )
        if frame.look is None:
            np.testing.assert_array_equal(used, filmed)
            continue
        before, after = (float(np.sqrt(np.square(p - wanted).mean())) for p in (filmed, used))
        # means of 64 pixels with noise of 2.5 levels: 0.3; the codec halves colour's resolution, which moves colours
        # over the edges of discs and of means: 1; a gain of 1.5
        assert after < 1.5 * (0.3 + 1) and after < before / 3, (before, after)
        assert frame.look == Look(colours.cameras[name].matrix)


@pytest.mark.full
def test_a_test_camera_that_differs_is_named(matched: Path) -> None:
    rows = read(matched / "colour" / "health.json")["rows"]
    assert [row["verdict"] for row in rows] == ["ok", "ok", "warn"]
    assert [row["about"] for row in rows] == ["cam1", "cam2", "witness"]
    assert "witness and cam0 (0.51 EV darker than cam0, not corrected)" in rows[2]["remedy"]


@pytest.mark.full
def test_nothing_is_matched_where_that_is_switched_off(matched: Path, session: Path, tmp_path: Path) -> None:
    colours, rows = again(session, tmp_path / "colour", "method=none")
    assert colours.reference is None and all(colours.look(name, 0) is None for name in LOOKS)
    assert list(rows) == []


@pytest.mark.parametrize(("method", "said"), [("chart", "surface points"), ("guess", "'guess'; ")])
def test_methods_that_are_none(session: Path, method: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scene(session, [f"calibration.colour.method={method}"])
    (mistake,) = caught.value.mistakes
    assert "calibration.colour.method: " in mistake and said in mistake


# --- against a sweep ---


@pytest.fixture
def swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., StageContext]:
    """What earlier stages leave of a sweep, and of fixed cameras beside it."""
    model = room.sweep()
    monkeypatch.setattr(colour, "read_static_poses", lambda folder: model)
    ingest, clean = tmp_path / "ingest", tmp_path / "rig" / "clean"
    for folder in (ingest / "frames" / "static", clean, tmp_path / "static_poses"):
        folder.mkdir(parents=True)
    (tmp_path / "static_poses" / "static_poses.json").write_text("{}")
    for n, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
        write_png(ingest / "frames" / name, room.show(camera, seed=n).rgb)

    def with_cameras(*names: str) -> StageContext:
        def frames(role: Any) -> CameraFrames:
            record = FrameRecord(0, 0.0, 10.0, True, "frames/0.png")
            return CameraFrames(role, "clip.mp4", *room.SIZE, 30.0, False, False, None, 0, (record,))

        roles = {name: "test" if name == "witness" else "camera" for name in names}
        FrameSet({SWEEP: frames("sweep")} | {name: frames(role) for name, role in roles.items()}).write(
            ingest
        )
        stands = {name: RigCamera(room.camera(0.5 + 0.2 * n), "self") for n, name in enumerate(names)}
        for n, (name, stand) in enumerate(stands.items()):
            write_png(clean / f"{name}_start.png", room.show(stand.camera, LOOKS[name], seed=50 + n).rgb)
        if names:
            write_rig(tmp_path / "rig" / "rig.json", Rig(stands, Scale(True, "board", 1.0, None)))
        content = {
            "name": "swept",
            "capture": {"static": "s.mp4", "cameras": {"cam1": "a.mp4", "cam2": "b.mp4"}},
        }
        (tmp_path / "scene.yaml").write_text(yaml.safe_dump(content))
        config = load_scene(tmp_path / "scene.yaml", check_files=False)
        (tmp_path / "out").mkdir()
        return StageContext(config, tmp_path, tmp_path, tmp_path / "out", no_progress, "cpu")

    return with_cameras


def test_cameras_are_brought_to_the_look_of_the_sweep(swept: Callable[..., StageContext]) -> None:
    context = swept("cam1", "cam2", "witness")
    colour.run(context)
    colours = read_colours(context.out)
    assert colours.reference == SWEEP
    assert {name: (c.source, c.kind) for name, c in colours.cameras.items()} == {
        SWEEP: ("reference", "none"),
        "cam1": ("points", "gain"),
        "cam2": ("points", "diagonal"),
        "witness": ("none", "none"),
    }
    for name in ("cam1", "cam2"):
        std = colours.cameras[name].stops_std
        assert std is not None and miss(colours, name) < 4 * std * np.log(2)
    assert [row.verdict for row in context.health] == ["ok", "ok", "warn"]
    assert [row.about for row in context.health] == ["cam1", "cam2", "witness"]


# --- rows ---


def rows_of(**camera: Any) -> list[HealthRow]:
    both = {SWEEP: CameraColour("reference"), "cam2": CameraColour(**camera)}
    return judge(colour_measures(Colours(Path(), SWEEP, both, Apart(0, None, None))))


def test_a_camera_that_stays_different() -> None:
    (row,) = rows_of(
        source="points", kind="gain", stops=-0.3, stops_std=0.02, fitted=200, apart=Apart(60, 0.09, 0.06)
    )
    assert "(0.30 EV darker than the sweep, corrected by one gain from points: left of 0.090)" in row.remedy
    assert (row.verdict, row.value, row.warn) == ("warn", 0.06, 0.05)


def test_a_camera_that_few_points_tell_of() -> None:
    rows = rows_of(source="points", stops=0.1, stops_std=0.2, fitted=12, apart=Apart(4, 0.02, 0.02))
    assert [row.verdict for row in rows] == ["ok", "warn"]
    assert "12 points" in rows[1].remedy and "0.2 EV" in str(rows[1].value)


def test_a_camera_without_common_points() -> None:
    (row,) = rows_of(source="none")
    assert row.verdict == "warn" and "cam2 and the sweep" in row.remedy


def test_a_camera_of_equal_look_fires_nothing() -> None:
    (row,) = rows_of(source="points", stops=0.01, stops_std=0.01, fitted=200, apart=Apart(60, 0.012, 0.012))
    assert row.verdict == "ok" and row.about == "cam2"


def test_one_camera_alone_has_nothing_to_compare_with() -> None:
    only = Colours(Path(), "cam0", {"cam0": CameraColour("reference")}, Apart(0, None, None))
    assert list(colour_measures(only)) == []


def read(path: Path) -> Any:
    return json.loads(path.read_text())
