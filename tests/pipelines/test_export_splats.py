"""Exports of splats and of the player through the command line, and refused where they are wrong."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.make.models import RADIUS, TRAVEL
from tests.pipelines.trained_run import SCALE, write_trained
from tests.refused import refused

from devrf.capture.camera import Camera
from devrf.capture.formats.parts.export import MARKER
from devrf.capture.system.errors import InputError
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.player import _told
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import STOPPED


@pytest.fixture(scope="module")
def scene_yaml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trained(tmp_path_factory.mktemp("ball"))


def test_a_sequence_of_splats(devrf: Callable, scene_yaml: Path, tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    out = tmp_path / "splats"
    result = devrf(
        "export", scene_yaml, "--format", "splat", "--times", "0s,1s", "--splats", 800, "--out", out
    )
    assert result.code == 0, result.said
    files = sorted(path.name for path in out.iterdir())
    assert files == [".devrf-export", "README.txt", "export.json", "splat_0000.ply", "splat_0001.ply"]
    first, last = (plyfile.PlyData.read(str(out / f"splat_000{n}.ply"))["vertex"] for n in (0, 1))
    before, after = (np.stack([vertex[axis] for axis in "xyz"], axis=1) for vertex in (first, last))
    radius = np.linalg.norm(before, axis=1) * SCALE  # metres in the file, the model's box is twice as large
    assert 400 < len(radius) <= 800 and np.median(np.abs(radius - RADIUS)) < 0.03
    np.testing.assert_allclose(after - before, np.tile([TRAVEL / SCALE, 0, 0], (len(radius), 1)), atol=2e-3)
    np.testing.assert_array_equal(first["f_dc_0"], last["f_dc_0"])
    assert 0.001 < np.median(np.exp(first["scale_2"])) < 0.1
    facts = json.loads((out / "export.json").read_text())
    assert facts["unit"] == "metre" and facts["files"][1]["time_s"] == 1.0
    assert "metres" in (out / "README.txt").read_text()


@pytest.mark.parametrize(
    ("options", "refusal", "named"),
    [
        (
            ExportOptions("player", splats=3),
            "option-out-of-range",
            ("--splats 3: ", "500 to 2000000", "30000"),
        ),
        (ExportOptions("player", splats=1_500_000), "page-too-large", (" 25; ", "--splats ", "000, ")),
        (ExportOptions("player", times="3s"), "option-out-of-range", ("--times 3s",)),
        (ExportOptions("player", times=""), "option-malformed", ("--times '': ", " keys,")),
        (ExportOptions("player", times="keys,0.5s"), "option-malformed", ("--times 'keys,0.5s': ",)),
        (ExportOptions("player", level=0.5), "option-misplaced", ("--level: ", "--format player")),
    ],
)
def test_a_player_that_cannot_be(
    scene_yaml: Path, options: ExportOptions, refusal: str, named: tuple[str, ...]
) -> None:
    run = scene_yaml.parent / "run"
    with refused(refusal, *named, kind=InputError):
        export(Talk("quiet"), run, options)
    assert not (run / "export").exists()


def test_a_file_in_the_way(scene_yaml: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with refused("folder-unwritable", tmp_path / "file", kind=InputError):
        export(
            Talk("quiet"), scene_yaml.parent / "run", ExportOptions("player", tmp_path / "file" / "player")
        )


def test_a_run_without_a_model(tmp_path: Path) -> None:
    write_trained(tmp_path)
    for stage, what in (("canonical", "the model"), ("scene", "the scene")):
        (tmp_path / "run" / stage / "stamp.json").unlink()
        with refused("stage-not-made", what, "--until canonical", kind=InputError):
            export(Talk("quiet"), tmp_path / "run", ExportOptions("splat"))


def test_a_stale_run_is_told(devrf: Callable, tmp_path: Path) -> None:
    scene = write_trained(tmp_path)
    for stage in ("scene", "canonical", "deformation"):
        # of a version that knew less
        (tmp_path / "run" / stage / "stamp.json").write_text('{"identity": {}}')
    said = " stale, "
    assert devrf("export", scene, "--format", "nerfstudio").code == 0
    assert said in " ".join((tmp_path / "run/export/nerfstudio/README.txt").read_text().split())
    result = devrf("export", scene, "--format", "ply", "--times", "1")
    assert result.code == 0 and said in result.said
    assert said in " ".join((tmp_path / "run/export/ply/README.txt").read_text().split())
    assert said in json.loads((tmp_path / "run/export/ply/export.json").read_text())["notes"][0]
    result = devrf("report", scene)
    assert result.code == 0 and said in result.said
    assert "Stale: scene, canonical, deformation." in (tmp_path / "run/report/index.html").read_text()
    assert not (tmp_path / "run/report/stamp.json").exists()


@pytest.mark.parametrize("sign", [pytest.param(signal.SIGINT, marks=pytest.mark.full), signal.SIGTERM])
def test_a_stopped_export_leaves_nothing_and_says_so(tmp_path: Path, sign: signal.Signals) -> None:
    scene = write_trained(tmp_path)
    command = [sys.executable, "-m", "devrf.pipelines.cli.main", "export", str(scene), "--format", "splat"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        begun, until = tmp_path / "run/export/.new-splat" / MARKER, time.monotonic() + 60
        while not begun.exists() and time.monotonic() < until:
            time.sleep(0.02)
        process.send_signal(sign)
        said = process.communicate(timeout=60)[1]
    assert process.returncode == STOPPED, said
    assert said.endswith("[stopped]\n") and said.count("\n") == 1 and "stages" not in said
    assert not list((tmp_path / "run" / "export").iterdir())


def test_a_motion_that_is_not_trained_yet_is_told(tmp_path: Path) -> None:
    scene = write_trained(tmp_path)
    shutil.rmtree(tmp_path / "run" / "deformation")
    folder = export(Talk("quiet"), scene.parent / "run", ExportOptions("splat", splats=500))
    assert "motion" in (folder / "README.txt").read_text()
    assert json.loads((folder / "export.json").read_text())["moving"] == 0


def test_a_view_of_the_player_sees_what_its_camera_sees() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    K = np.array([[300.0, 0, 150], [0, 310, 90], [0, 0, 1]])
    camera, points = Camera(320, 200, K, np.column_stack([turn, [0.1, 0.2, 3.0]])), np.eye(3)
    view = _told("cam0", camera, np.zeros(3))
    seen = (points - view["eye"]) @ np.reshape(view["turn"], (3, 3)).T
    pixels = seen[:, :2] / seen[:, 2:] * view["lens"]["focal"] + view["lens"]["centre"]
    np.testing.assert_allclose(pixels, camera.project(points))
    assert view["lens"]["size"] == [320, 200]
