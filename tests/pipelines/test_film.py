"""`devrf-pipeline render` with options, on a run whose model is known."""

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from tests.pipelines.film_folder import RADIUS, WORLD_PER_BOX, halves_model, write_ball_run
from tests.refused import refused
from tests.waiting import wait_for

from devrf.capture.formats.parts.export import MARKER
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import no_progress
from devrf.pipelines.budget import memory
from devrf.pipelines.cli import run_command
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.film import film_command as command
from devrf.pipelines.film.film_plan import FilmRequest
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import render
from devrf.pipelines.terminal.console import Talk
from devrf.reconstruct.film import film_maker
from devrf.reconstruct.storage.model_io import save_deformation

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
    return command.film(job, FilmRequest(**{**SMALL, **options}), "cpu")  # type: ignore[arg-type]


def about(folder: Path) -> dict:
    return json.loads((folder / "film.json").read_text())


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize("path", ["orbit", "spiral", "still:witness"])
def test_every_path_shows_the_ball(scene: Path, path: str) -> None:
    folder = film(scene, path=path, seconds=0.5)
    pictures = decoded(folder / "colour.mp4")
    assert pictures.shape == (2, 36, 48, 3)
    assert (pictures.min(axis=(1, 2, 3)) < 180).all() and (pictures[:, :3, :3] > 245).all()
    assert sorted(path.name for path in folder.iterdir()) == [MARKER, "colour.mp4", "film.json"]
    assert folder.parent == scene.parent / "run" / "films"


def test_depth_is_in_millimetres_and_in_colours(scene: Path) -> None:
    """The ball's nearest point is known in closed form."""
    folder = film(scene, path="still:cam1", layers="depth,colour", format="png")
    found = about(folder)
    assert list(found["layers"]) == ["colour", "depth"]
    assert found["layers"]["depth"]["unit"] == 0.001 and found["layers"]["depth"]["metres"] is True
    assert [entry["render_time"] for entry in found["camera_path"]] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    depth = np.array(Image.open(folder / "depth" / "000000.png"))
    assert depth.dtype == np.uint16 and depth[0, 0] == 0
    assert depth[18, 24] == pytest.approx(1000 * WORLD_PER_BOX * (3.0 - RADIUS), abs=60)  # a voxel is 43
    assert len(list((folder / "colour").glob("*.png"))) == found["frames"] == 4
    shown = decoded(film(scene, path="still:cam1", layers="depth") / "depth.mp4")[0]
    assert shown[18, 24].max() > 150 and shown[0, 0].max() < 10  # near is bright, nothing is black


def test_time_runs_as_it_was_or_all_of_it_in_some_seconds(scene: Path) -> None:
    """The clip lasts two seconds."""
    as_it_was = film(scene, format="png", fps=1.25, seconds=None)
    assert about(as_it_was)["times_s"] == pytest.approx([1.0, 1.8, 2.6])
    assert about(film(scene, seconds=0.75))["times_s"] == [1.0, 2.0, 3.0]
    standing = about(film(scene, time="0.25", seconds=None, fps=0.5))
    assert standing["times_s"] == [1.5, 1.5] and standing["seconds"] == 4.0


def test_the_film_of_a_run_plays_through_all_times(scene: Path) -> None:
    """Stage `render`."""
    config, run = load_scene(scene, check_files=False), scene.parent / "run"
    out = run / "render"
    out.mkdir()
    render.run(StageContext(config, scene.parent, run, out, no_progress, "cpu"))
    assert sorted(path.name for path in out.iterdir()) == ["film.json", "orbit.mp4", "poster.png"]
    found, pictures = about(out), decoded(out / "orbit.mp4")
    assert found["frames"] == len(pictures) == len(set(found["times"])) == 48  # two seconds, at half speed
    assert (found["times"][0], found["times"][-1], found["fps"]) == (0, 1, 12)
    poster = np.array(Image.open(out / "poster.png")).astype(int)
    assert poster.shape == (found["height"], found["width"], 3) == pictures.shape[1:]
    still = found["still"]  # the ball goes away all the time: the last moment tells most
    away = [np.abs(pictures[n] - poster).mean() for n in (0, still // 2, still)]
    assert still == 47 and 2 * away[2] < min(away[:2])  # an encoded picture is not the same to the bit
    assert found["hidden"] == 0


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


def test_a_film_is_a_camera_path_that_is_filmed_again(scene: Path) -> None:
    """film.json leads to the same pictures, time standing still included."""
    first = film(scene, path="spiral", time="2.0s", format="png")
    entry = about(first)["camera_path"][1]
    assert entry["render_time"] == 0.5 and about(first)["times_s"] == [2.0] * 4
    again = film(scene, path=str(first / "film.json"), format="png", size=None, fps=None, seconds=None)
    for n in range(4):
        one, two = (np.array(Image.open(f / "colour" / f"{n:06d}.png")).astype(int) for f in (first, again))
        assert np.abs(one - two).max() <= 2
    slower = film(scene, path=str(first / "film.json"), seconds=2.0)
    assert decoded(slower / "colour.mp4").shape == (8, 36, 48, 3)


@pytest.mark.full
def test_a_stopped_film_leaves_nothing_and_an_earlier_one_stands(scene: Path) -> None:
    """By the real signal, in the middle of it."""
    out = scene.parent / "mine"
    film(scene, out=out)
    before = _tree(out)
    options = ["--path", "spiral", "--size", "200x150", "--seconds", "30", "--fps", "8", "--out", str(out)]
    program = [sys.executable, "-m", "devrf.pipelines.cli.main", "render", str(scene), *options]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        part = out.with_name(".new-mine")
        wait_for(lambda: (part / "colour.mp4").exists(), process=process)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and said.endswith("[stopped]\n"), said
    assert _tree(out) == before and not part.exists()


@pytest.mark.parametrize(
    ("options", "refusal", "named"),
    [
        ({"path": "orbt"}, "option-unknown-value", " orbit?"),
        ({"path": "still:cam9"}, "camera-unknown", "cam0, cam1, cam2, witness"),
        ({"path": "between:cam0"}, "option-unknown-value", "--path between: this path is no longer filmed"),
        ({"path": "nothing.json"}, "file-missing", "--path nothing.json: "),
        ({"time": "1.5"}, "option-out-of-range", "0 to 1, or 1.000s to 3.000s"),
        ({"time": "4s"}, "option-out-of-range", "4s"),
        ({"time": "noon"}, "option-malformed", "noon"),
        ({"seconds": 0.0}, "option-out-of-range", "--seconds 0: expected more than 0"),
        ({"fps": 1000.0}, "option-out-of-range", "--fps 1000: expected at least 0.1"),
        ({"size": "641x360"}, "film-sides-odd", "640x360, or --format png"),
        ({"size": "9000x20"}, "option-out-of-range", " 16 to 8192"),
        ({"size": "large"}, "option-malformed", "WIDTHxHEIGHT"),
        ({"path": "still:cam0", "size": "48x48"}, "film-other-shape", "cam0 are 48x36; take 48x36"),
        ({"layers": "colour,normals"}, "option-unknown-value", "--layers normals: expected colour, depth"),
        ({"layers": "flow"}, "option-unknown-value", "--layers flow: films show"),
        ({"format": "avi"}, "option-unknown-value", "mp4, png"),
        ({"format": "webp"}, "option-unknown-value", " ffmpeg"),
        ({"without": "ball"}, "option-malformed", "--without ball: expected numbers of parts"),
        ({"without": "0"}, "option-malformed", "--without 0: "),
        (
            {"without": "1"},
            "option-misplaced",
            "--without 1: what moves in this scene is not made of parts",
        ),
        ({"fps": 200.0, "seconds": 200.0}, "film-too-long", " 20000 "),
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
        "code": "x",
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
    with refused("scene-without-motion", "--time: ", kind=InputError):
        film(scene, time="0.5")
    folder = film(scene)
    said = capsys.readouterr().out
    assert re.search("canonical .*: loss", said) and "deformation" in said
    assert "render_time" not in about(folder)["camera_path"][0]
    assert any("unhealthy" in note for note in about(folder)["notes"])
    shutil.rmtree(run / "canonical")
    with refused("stage-not-made", run, "canonical", kind=InputError):
        film(scene)


def test_too_large_pictures_are_refused(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "allowed_bytes", lambda config: 1_000_000_000)
    with refused("film-needs-memory", "4096x4096", " 1 GB ", "--size", kind=InputError):
        film(made, size="4096x4096")


def test_a_full_disk_is_told_and_leaves_an_earlier_film(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = film(scene, path="spiral", format="png")
    before = _tree(folder)

    def full(path: Path, picture: np.ndarray) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(film_maker, "write_png", full)
    with refused("folder-unwritable", folder, "No space left on device") as error:
        film(scene, path="spiral", format="png")
    assert not isinstance(error.value, InputError)
    assert _tree(folder) == before and list(folder.parent.iterdir()) == [folder]


@pytest.mark.parametrize("option", [key.split()[1] for key in GONE if key.startswith("render ")])
def test_options_that_are_gone_are_told_with_what_to_do(devrf: Callable, made: Path, option: str) -> None:
    refusal = devrf("render", made, f"{option}=1", "--path", "orbit")
    assert refusal.code == 2 and "[option-gone]" in refusal.err
    said = " ".join(refusal.err.split())
    assert f"{option}: is no longer an option: {GONE[f'render {option}']}" in said


def _tree(folder: Path) -> list[tuple[str, bytes]]:
    return [(str(path), path.read_bytes()) for path in sorted(folder.rglob("*")) if path.is_file()]
