"""`devrf.run` and what is made of it: the same stages, errors raised instead of printed, sessions written down."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.conftest import ExampleRun
from tests.pipelines.small_stages import SCENE, small_stages
from tests.pipelines.tiny_scenes import tiny_scene

import devrf
from devrf.capture.measure import Measure
from devrf.capture.system.errors import CaptureError, HealthError, InputError
from devrf.pipelines.cli import run_command
from devrf.pipelines.stage import StageContext


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """scene.yaml and two files, of which small stages make text."""
    for name, content in (("static.mp4", "sweep"), ("cam0.mp4", "clip"), ("scene.yaml", SCENE)):
        (tmp_path / name).write_text(content)
    return tmp_path


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """`run` has small stages of text."""
    monkeypatch.setattr(run_command, "STAGES", small_stages())
    return monkeypatch


def test_a_run_makes_what_is_missing(
    folder: Path, stages: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_folder = devrf.run(folder, until="second")
    assert run_folder == folder / "run" and (run_folder / "second").is_dir()
    assert not (run_folder / "third").exists() and "first: done" in capsys.readouterr().out
    devrf.run(str(folder / "scene.yaml"), settings={"reconstruct.rays": 200}, quiet=True)
    assert capsys.readouterr() == ("", "")
    assert "200" in (run_folder / "second" / "made_of.txt").read_text()


@pytest.mark.parametrize(
    ("settings", "code"), [({"reconstruct.rayz": 1}, "configuration"), ({"capture": None}, "configuration")]
)
def test_bad_settings_are_an_input_error(
    folder: Path, stages: pytest.MonkeyPatch, settings: dict, code: str
) -> None:
    with pytest.raises(InputError) as error:
        devrf.run(folder, settings=settings)
    assert error.value.code == code and not (folder / "run").exists()


def test_errors_of_stages_are_raised(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(context: StageContext) -> None:
        raise CaptureError("file-cut-short", "cam0.mp4: ends early; copy it again")

    def unhealthy(context: StageContext) -> None:
        context.measures.append(Measure("sweep-few-pictures", 1.0))

    def stopped(context: StageContext) -> None:
        raise KeyboardInterrupt

    for work, kind, code in (
        (broken, devrf.DevrfError, "file-cut-short"),
        (unhealthy, HealthError, "stage-unhealthy"),
    ):
        monkeypatch.setattr(run_command, "STAGES", small_stages(first=work))
        with pytest.raises(kind) as error:
            devrf.run(folder, quiet=True)
        assert error.value.code == code
    assert (folder / "run" / "first").is_dir()
    devrf.run(folder, allow_unhealthy=True, quiet=True)
    monkeypatch.setattr(run_command, "STAGES", small_stages(first=stopped))
    (folder / "static.mp4").write_text("another sweep")
    with pytest.raises(KeyboardInterrupt):
        devrf.run(folder, quiet=True)
    assert capsys.readouterr().err == ""


def test_a_session_is_written_down(folder: Path, stages: pytest.MonkeyPatch) -> None:
    session = devrf.Session(
        static=folder / "static.mp4", cameras={"cam0": folder / "cam0.mp4"}, range_s=(0.0, 2.0), rest="start"
    )
    from devrf.api.steps import _scene_yaml

    path = _scene_yaml(session, folder / "work", {"preset": "tiny", "reconstruct.rays": 300})
    keys = yaml.safe_load(path.read_text())
    assert keys["name"] == "work" and keys["preset"] == "tiny" and keys["reconstruct"] == {"rays": 300}
    assert keys["capture"] == {
        "static": str(folder / "static.mp4"),
        "cameras": {"cam0": str(folder / "cam0.mp4")},
        "range_s": [0.0, 2.0],
        "rest": "start",
    }
    assert devrf.run(path, quiet=True) == folder / "work" / "run"
    assert _scene_yaml(session, folder / "work", {}) == path  # its own is written anew
    for wrong, where in (("option-missing", None), ("folder-exists", folder)):
        with pytest.raises(InputError) as error:
            devrf.ingest(session, where)
        assert error.value.code == wrong


@pytest.mark.full
def test_a_data_set_step_by_step(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "steps")
    calibration = devrf.calibrate(scene, settings={"evaluate.holdout_every": 3}, quiet=True)
    assert len(calibration.cameras) == 9 and not calibration.clocks and not calibration.colours
    assert not (calibration.run_folder / "canonical").exists()
    made = (calibration.run_folder / "scene" / "stamp.json").read_text()
    trained = devrf.train(
        calibration, settings={"reconstruct.canonical_iterations": 12}, allow_unhealthy=True, quiet=True
    )
    assert (calibration.run_folder / "scene" / "stamp.json").read_text() == made
    assert trained.metrics["test"]["psnr"] > 5
    assert trained.render("static/1").colour.shape == (32, 32, 3)


@pytest.mark.full
def test_a_session_gives_the_cameras_of_its_scene_yaml_on_small_run(
    small_run: ExampleRun, tmp_path: Path
) -> None:
    raw = small_run.scene.parent
    cameras = {name: raw / f"{name}.mp4" for name in ("cam0", "cam2", "witness")}
    session = devrf.Session(static=raw / "static", cameras=cameras, test_names=("witness",), rest="start")
    clips = devrf.ingest(session, tmp_path / "again", settings={"preset": "tiny"}, quiet=True)
    assert set(clips) == {"static", *cameras} and clips["witness"].role == "test"
    found = devrf.calibrate(session, tmp_path / "again", settings={"preset": "tiny"}, quiet=True)
    known = devrf.calibrate(small_run.scene, quiet=True)
    assert (
        found.clocks.keys() == known.clocks.keys() == cameras.keys()
        and known.colours.keys() >= cameras.keys()
    )
    assert found.cameras.keys() == known.cameras.keys()
    for name in cameras:
        np.testing.assert_allclose(found.cameras[name].K, known.cameras[name].K, rtol=0.02)
