"""`devrf-pipeline render` with options, on a run whose model is known."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from tests.pipelines.film_folder import AABB, RADIUS, TRAVEL, WORLD_PER_BOX, halves_model, write_ball_run
from tests.refused import refused

from devrf.capture.camera import Camera
from devrf.capture.errors import InputError
from devrf.capture.formats.flow_files import read_flow_file
from devrf.pipelines import run_command
from devrf.pipelines.console import Talk
from devrf.pipelines.film import command
from devrf.pipelines.film.asked import Asked
from devrf.pipelines.film.draw import Drawer
from devrf.reconstruct.model_io import save_deformation

SMALL = {"size": "48x36", "fps": 4.0, "seconds": 1.0}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run; nobody changes it."""
    return write_ball_run(tmp_path_factory.mktemp("film"))


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> Path:
    """A copy of the run."""
    shutil.copytree(made.parent, tmp_path / "copy")
    return tmp_path / "copy" / "scene.yaml"


def film(scene: Path, **options: object) -> Path:
    """Make a film in this process; its folder."""
    job = run_command.prepare(Talk("normal"), scene, None, None, None, check_files=False)
    return command.film(job.talk, job, Asked(**{**SMALL, **options}), "cpu")  # type: ignore[arg-type]


def about(folder: Path) -> dict:
    return json.loads((folder / "film.json").read_text())


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize(
    "path", ["orbit", "spiral", "dolly", "vertigo", "between", "between:cam2,witness", "still:witness"]
)
def test_every_path_shows_the_ball(scene: Path, path: str) -> None:
    folder = film(scene, path=path, seconds=0.5)
    pictures = decoded(folder / "colour.mp4")
    assert pictures.shape == (2, 36, 48, 3)
    assert (pictures.min(axis=(1, 2, 3)) < 180).all() and (pictures[:, :3, :3] > 245).all()
    assert sorted(path.name for path in folder.iterdir()) == ["colour.mp4", "film.json"]
    assert folder.parent == scene.parent / "run" / "films"


def test_layers_hold_depth_in_millimetres_and_motion_in_pixels(scene: Path) -> None:
    """The ball's nearest point and its way are known in closed form."""
    folder = film(scene, path="still:cam1", layers="flow,depth,colour", format="png")
    found = about(folder)
    assert list(found["layers"]) == ["colour", "depth", "flow"]
    assert found["layers"]["depth"]["unit"] == 0.001 and found["layers"]["depth"]["metres"] is True
    depth = np.array(Image.open(folder / "depth" / "000000.png"))
    assert depth.dtype == np.uint16 and depth[0, 0] == 0
    assert depth[18, 24] == pytest.approx(1000 * WORLD_PER_BOX * (3.0 - RADIUS), abs=60)  # a voxel is 43
    times = [entry["render_time"] for entry in found["camera_path"]]
    assert times == pytest.approx([0, 1 / 3, 2 / 3, 1])
    flow, known = read_flow_file(folder / "flow" / "000002.npz")
    pose = np.array(found["camera_path"][0]["camera_to_world"]).reshape(4, 4) @ np.diag([1, -1, -1, 1])
    K = np.array([[50.0, 0, 24], [0, 50, 18], [0, 0, 1]])
    camera = Camera(48, 36, K, np.linalg.inv(pose)[:3])
    now, before = (camera.project(WORLD_PER_BOX * (TRAVEL * t)) for t in times[2:0:-1])
    at = tuple(np.floor(now).astype(int)[::-1])
    assert known[at] and np.abs(flow[at] - (before - now)).max() < 0.6
    assert not read_flow_file(folder / "flow" / "000000.npz")[1].any()


def test_parts_can_be_left_out(scene: Path) -> None:
    save_deformation(scene.parent / "run" / "deformation", halves_model())
    asked = {"path": "still:witness", "time": "0.5", "seconds": 0.25, "format": "png"}

    def dark(without: str | None) -> np.ndarray:
        folder = film(scene, without=without, **asked)
        assert about(folder)["without"] == [int(part) for part in (without or "").split(",") if part]
        return np.asarray(Image.open(folder / "colour" / "000000.png")).min(axis=-1) < 180

    whole, first, second, none = (dark(w) for w in (None, "2", "1", "1,2"))
    assert not none.any() and first.sum() > 20 and second.sum() > 20
    rows = [np.nonzero(part)[0].mean() for part in (second, whole, first)]  # the first part is the lower one
    assert rows[0] < rows[1] - 1 < rows[2] - 2
    assert ((first | second) & whole).sum() > 0.9 * whole.sum()
    with refused("option-out-of-range", "--without 3: expected parts of 1 to 2", kind=InputError):
        film(scene, without="3", **asked)


def test_true_pictures_stand_beside_at_their_own_times(scene: Path) -> None:
    folder = film(scene, path="still:witness", beside="witness", format="png", size=None)
    found = about(folder)
    assert found["beside"] == [["witness", n] for n in (0, 1, 3, 4)]
    assert [entry["render_time"] for entry in found["camera_path"]] == [0, 0.25, 0.75, 1]
    picture = np.array(Image.open(folder / "colour" / "000002.png"))
    true = np.array(Image.open(scene.parent / "pictures" / "witness_3.png"))
    assert picture.shape == (36, 2 * 48 + 4, 3)
    np.testing.assert_array_equal(picture[:, :48], true)
    assert (picture[:, 48:52] == 255).all()


def test_true_pictures_stand_beside_at_the_times_that_were_trained_with(scene: Path) -> None:
    """Training moved a camera's clock by a quarter of the scene: its last picture is beyond the motion."""
    metrics = scene.parent / "run" / "deformation" / "metrics.json"
    metrics.write_text(json.dumps({"clock_offsets_s": {"cam1": 0.5}}))
    found = about(film(scene, path="still:cam1", beside="cam1", format="png", size=None))
    assert found["beside"] == [["cam1", n] for n in (0, 0, 2, 3)]
    assert [entry["render_time"] for entry in found["camera_path"]] == [0.25, 0.25, 0.75, 1]


def test_a_test_camera_whose_clock_is_not_known_is_shown_as_calibrated_and_that_is_said(scene: Path) -> None:
    clock = {"std_s": 0.1, "offset_s": 0.5, "why": ""}
    metrics = scene.parent / "run" / "deformation" / "metrics.json"
    metrics.write_text(json.dumps({"test_clocks": {"witness": clock}}))
    found = about(film(scene, path="still:witness", beside="witness", format="png", size=None))
    assert [entry["render_time"] for entry in found["camera_path"]] == [0, 0.25, 0.75, 1]
    assert any("witness is shown by its clock as it was calibrated" in note for note in found["notes"])


def test_a_film_is_a_camera_path_that_is_filmed_again(scene: Path) -> None:
    """film.json leads to the same pictures, time standing still included."""
    first = film(scene, path="spiral", time="2.0s", format="png")
    entry = about(first)["camera_path"][1]
    assert entry["render_time"] == 0.5 and about(first)["times_s"] == [2.0] * 4
    again = film(scene, path=str(first / "film.json"), format="png", size=None, fps=None, seconds=None)
    for n in range(4):
        one, two = (np.array(Image.open(f / "colour" / f"{n:06d}.png")).astype(int) for f in (first, again))
        assert np.abs(one - two).max() <= 2
    slower = film(scene, path=str(first / "film.json"), format="webp", seconds=2.0)
    with Image.open(slower / "colour.webp") as animated:
        assert getattr(animated, "n_frames", 1) == 8 and animated.size == (48, 36)


@pytest.mark.full
def test_a_stopped_film_goes_on_and_a_finished_one_stays(scene: Path, capsys: pytest.CaptureFixture) -> None:
    """Killed at a random moment by the real signal; then no picture is made twice."""
    options = ["--path", "spiral", "--size", "200x150", "--seconds", "3", "--fps", "8", "--speed", "0.5"]
    program = [sys.executable, "-m", "devrf.pipelines.cli", "render", str(scene), *options]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        part = scene.parent / "run/films" / ".spiral-seconds-3-fps-8-speed-0.5-size-200x150.part"
        for _ in range(9000):
            if len(list(part.glob("colour/0*.png"))) > 1 or process.poll() is not None:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and said.endswith("[stopped]\n"), said
    kept = {path: path.stat().st_mtime_ns for path in part.glob("colour/0*.png")}
    assert 2 <= len(kept) < 24 and not (part / "colour.mp4").exists()
    asked = {"path": "spiral", "size": "200x150", "seconds": 3.0, "fps": 8.0, "speed": 0.5}
    next(iter(kept)).write_bytes(b"cut off by a power cut")
    folder = film(scene, **asked)
    assert f"{len(kept)} of 24" in capsys.readouterr().out
    assert about(folder)["rendered"] == 24 - len(kept) + 1
    assert len(decoded(folder / "colour.mp4")) == 24 and not part.exists()
    before = (folder / "film.json").stat().st_mtime_ns
    assert film(scene, **asked) == folder
    assert "nothing to do" in capsys.readouterr().out
    assert (folder / "film.json").stat().st_mtime_ns == before


def test_another_model_is_another_film(scene: Path, capsys: pytest.CaptureFixture) -> None:
    out = scene.parent / "mine"
    film(scene, out=out, path="dolly")
    stamp = scene.parent / "run/canonical/stamp.json"
    stamp.write_text(stamp.read_text().replace("content-canonical", "trained-again"))
    part = out.with_name(".mine.part")
    (part / "colour").mkdir(parents=True)
    (part / "made_from.json").write_text('{"made_from": "another"}')
    (part / "colour" / "000000.png").write_bytes(b"of another film")
    film(scene, out=out, path="dolly")
    said = capsys.readouterr().out
    assert "is gone" in said and about(out)["rendered"] == 4 and not part.exists()


@pytest.mark.parametrize(
    ("options", "refusal", "named"),
    [
        ({"path": "orbt"}, "option-unknown-value", " orbit?"),
        ({"path": "still:cam9"}, "camera-unknown", "cam0, cam1, cam2, witness"),
        ({"path": "between:cam0"}, "cameras-too-few", "between:cam0"),
        ({"path": "between:cam0,cam0"}, "cameras-too-few", "between:cam0,cam0: "),
        ({"path": "between:cam0,nobody"}, "camera-unknown", " nobody"),
        ({"path": "nothing.json"}, "file-missing", "--path nothing.json: "),
        ({"time": "1.5"}, "option-out-of-range", "0 to 1, or 1.000s to 3.000s"),
        ({"time": "4s"}, "option-out-of-range", "4s"),
        ({"time": "noon"}, "option-malformed", "noon"),
        ({"time": "0.5", "ping_pong": True}, "option-misplaced", "--ping-pong"),
        ({"begin": "0.6", "end": "0.4"}, "times-reversed", "--from 0.6 --to 0.4"),
        ({"slow": "0.4"}, "option-malformed", "--slow 0.4: "),
        ({"speed": 1.0, "seconds": 9.0}, "film-too-long", " 2 s; "),
        ({"seconds": 0.0}, "option-out-of-range", "--seconds 0: expected more than 0"),
        ({"fps": 1000.0}, "option-out-of-range", "--fps 1000: expected at least 0.1"),
        ({"size": "641x360"}, "film-sides-odd", "640x360, or --format png"),
        ({"size": "9000x20"}, "option-out-of-range", " 16 to 8192"),
        ({"size": "large"}, "option-malformed", "WIDTHxHEIGHT"),
        ({"path": "still:cam0", "size": "48x48"}, "film-other-shape", "cam0 are 48x36; take 48x36"),
        ({"layers": "colour,normals"}, "option-unknown-value", "colour,depth,flow"),
        ({"format": "avi"}, "option-unknown-value", "mp4, png, webp"),
        ({"beside": "cam9"}, "camera-unknown", "--beside cam9: "),
        ({"beside": "cam0", "layers": "depth"}, "option-misplaced", "--beside cam0: "),
        ({"without": "ball"}, "option-malformed", "--without ball: expected numbers of parts"),
        ({"without": "0"}, "option-malformed", "--without 0: "),
        (
            {"without": "1"},
            "option-misplaced",
            "--without 1: what moves in this scene is not made of parts",
        ),
        ({"fps": 200.0, "seconds": 200.0}, "film-too-long", " 20000 "),
        ({"format": "webp", "fps": 30.0, "seconds": 20.0}, "film-too-long", " 500 "),
    ],
)
def test_bad_options_are_told_before_anything_starts(
    made: Path, options: dict, refusal: str, named: str
) -> None:
    with refused(refusal, named, kind=InputError):
        film(made, **options)
    assert not (made.parent / "run" / "films").exists()


def test_a_film_replaces_nothing_but_a_film(scene: Path) -> None:
    for name, refusal in (("file", "folder-unwritable"), ("folder", "folder-exists")):
        out = scene.parent / name
        if name == "file":
            out.write_text("")
        else:
            out.mkdir()
            (out / "diary.txt").write_text("")
        with refused(refusal, out, kind=InputError):
            film(scene, out=out)
    (scene.parent / "run" / "films").symlink_to(scene.parent)
    with refused("folder-holds-link", scene.parent / "run" / "films", kind=InputError):
        film(scene)


def test_runs_that_are_not_whole_are_shown_as_such(scene: Path, capsys: pytest.CaptureFixture) -> None:
    run = scene.parent / "run"
    row = {
        "check": "loss",
        "value": 9.0,
        "unit": "",
        "warn": 1.0,
        "fail": 2.0,
        "verdict": "fail",
        "remedy": "x",
    }
    (run / "canonical/health.json").write_text(json.dumps({"stage": "canonical", "rows": [row]}))
    shutil.rmtree(run / "deformation")
    with refused("scene-without-motion", "--speed: ", kind=InputError):
        film(scene, speed=0.5)
    folder = film(scene)
    said = capsys.readouterr().out
    assert re.search("canonical .*: loss", said) and "deformation" in said
    assert "render_time" not in about(folder)["camera_path"][0]
    assert any("unhealthy" in note for note in about(folder)["notes"])
    shutil.rmtree(run / "canonical")
    with refused("stage-not-made", run, "canonical", kind=InputError):
        film(scene)


def test_paths_that_leave_the_scene(scene: Path, capsys: pytest.CaptureFixture) -> None:
    """World units are half of the box's: a camera above everything, one in the ball, one far beyond."""

    def path_to(*places: tuple[float, float, float]) -> str:
        poses = [np.column_stack([np.eye(4)[:, :3], [*place, 1]]).tolist() for place in places]
        entries = [{"camera_to_world": pose, "fov": 50, "render_time": 0} for pose in poses]
        file = scene.parent / f"path{len(list(scene.parent.glob('path*')))}.json"
        file.write_text(json.dumps({"camera_path": entries, "render_width": 32, "render_height": 32}))
        return str(file)

    free = {"size": None, "fps": None, "seconds": None, "format": "png"}
    folder = film(scene, path=path_to((1.2, 0, 0.9), (0, 0, 1.5)), **free)
    assert "1 of 2 pictures" in capsys.readouterr().out
    assert about(folder)["notes"][-1].startswith("1 of 2 pictures")
    for place in ((0, 0, 0.05), (0, 0, 30.0)):
        with refused("film-path-blind", "1 of 2 ", "the first is 1 ", kind=InputError):
            film(scene, path=path_to((1.2, 0, 0.9), place), **free)
    assert AABB.max() == 1  # the ball is solid to 0.2 in the world


def test_a_full_disk_costs_no_picture(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw: Callable = Drawer.draw

    def full(self: Drawer, n: int) -> object:
        if n == 2:
            raise OSError(28, "No space left on device")
        return draw(self, n)

    monkeypatch.setattr(Drawer, "draw", full)
    with refused("folder-unwritable", "No space left on device") as error:
        film(scene, path="dolly")
    assert not isinstance(error.value, InputError)
    monkeypatch.undo()
    assert about(film(scene, path="dolly"))["rendered"] == 2


def test_too_large_pictures_are_refused(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "allowed_bytes", lambda config: 1_000_000_000)
    with refused("film-needs-memory", "4096x4096", " 1 GB ", "--size", kind=InputError):
        film(made, size="4096x4096")
