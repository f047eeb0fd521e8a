"""Damage that makes a simulated session again: once for all seeds, and only what differs."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.damage.intact import DoesNotApply, Intact
from devrf.lab.bench.stability.small_session import Simulated, is_rendered, rendered
from devrf.lab.bench.stability.small_session import session as of_the_suite
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.camera_rig import fixed_cameras
from devrf.lab.simulate_command import session_code, simulate
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import CaptureConfig
from devrf.pipelines.terminal.console import Talk

REAL = (
    "{name: real, capture: {static: static.mp4, cameras: {cam0: a.mp4, cam1: b.mp4}, test_cameras: [cam1]}}"
)


OPTIONS = {
    "sweep_frames": 2, "fps": 4, "duration_s": 0.8, "motion_scale": 2, "spp": 4, "board": False, "sound": False,
    "noise": 0,
}  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's own session."""
    pytest.importorskip("mitsuba")
    folder = tmp_path_factory.mktemp("suite") / "session"
    settings = [f"{name}={str(value).lower()}" for name, value in OPTIONS.items()]
    simulate(Talk("quiet"), folder, "sheet", "session", 1, 0, "32x24", settings)
    return folder / "scene.yaml"


def intact_of(scene: Path, found: Scene, folder: Path, severity: float, seed: int = 0) -> Intact:
    return Intact(load_scene(scene), scene.parent, found, folder, severity, seed)


def made() -> Simulated:
    """How it was made."""
    return Simulated("sheet", 1, 0, (32, 24), SessionOptions.model_validate(OPTIONS))


def with_code(truth: Path, code: str | None) -> None:
    """As if another version of the simulator had made it; None: one that did not say."""
    content = json.loads(truth.read_text())
    content["made_by"] |= {"code": code}
    if code is None:
        del content["made_by"]["code"]
    truth.write_text(json.dumps(content))


@pytest.mark.full
def test_a_session_is_made_again_once_for_all_seeds_with_the_clips_that_stay(
    session: Path, odd_scene: Scene, tmp_path: Path
) -> None:
    for axis, stays in (("moving_light", "static.mp4"), ("sweep_motion", "cam0.mp4")):
        made = tmp_path / axis / "session"

        def filmed(seed: int, axis: str = axis) -> CaptureConfig | None:
            folder = tmp_path / axis / f"seed{seed}"
            folder.mkdir(parents=True)
            return AXES[axis].damaging(intact_of(session, odd_scene, folder, 0.5, seed)).config.capture

        filmed(0)
        when = (made / "scene.yaml").stat().st_mtime_ns
        capture = filmed(1)
        assert (made / "scene.yaml").stat().st_mtime_ns == when
        assert capture is not None and capture.static == str(made / "static.mp4")
        assert [*capture.all_cameras.values()] == [str(made / f"{n}.mp4") for n in ("cam0", "witness")]
        same = {
            name: (made / name).read_bytes() == (session.parent / name).read_bytes()
            for name in ("static.mp4", "cam0.mp4")
        }
        assert same == {name: name == stays for name in same}
        assert [path.name for path in made.parent.iterdir() if path.name.startswith(".")] == []


def test_a_session_that_was_made_otherwise_is_not_taken_for_this_one(session: Path, tmp_path: Path) -> None:
    folder = tmp_path / "session"
    shutil.copytree(session.parent, folder)
    when = (folder / "scene.yaml").stat().st_mtime_ns
    rendered(folder, made())
    assert (folder / "scene.yaml").stat().st_mtime_ns == when
    other = replace(made(), options=made().options.model_copy(update={"noise": 0.1}))
    rendered(folder, other)
    assert is_rendered(folder, other) and not is_rendered(folder, made())
    with refused("session-differs", folder, "--out", kind=InputError):
        of_the_suite(tmp_path, Talk("quiet"))
    assert not is_rendered(tmp_path / "none", made())


@pytest.mark.parametrize("code", ["of another version", pytest.param(None, marks=pytest.mark.full)])
def test_a_session_of_another_version_of_the_simulator_is_not_compared_with_this_one(
    session: Path, odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str | None
) -> None:
    assert Simulated.of(session.parent / "ground_truth.json") == made() and made().code == session_code()
    folder, axis = tmp_path / "session", AXES["sweep_motion"]
    shutil.copytree(session.parent, folder)
    (tmp_path / "sweep_motion/seed0").mkdir(parents=True)

    def damaged() -> Any:
        place = tmp_path / "sweep_motion/seed0"
        return axis.damaging(intact_of(folder / "scene.yaml", odd_scene, place, 50.0))

    damaged()
    again = tmp_path / "sweep_motion/session/ground_truth.json"
    with_code(again, code)
    damaged()
    assert json.loads(again.read_text())["made_by"]["code"] == session_code()  # made anew

    with_code(folder / "ground_truth.json", code)
    for name, value in (("CAMERAS", 1), ("SIZE", (32, 24)), ("OPTIONS", made().options)):
        monkeypatch.setattr(f"devrf.lab.bench.stability.small_session.{name}", value)
    with refused("session-outdated", folder, "--out", kind=InputError):
        of_the_suite(tmp_path, Talk("quiet"))
    with refused("session-outdated", kind=DoesNotApply):
        damaged()


def test_a_truth_that_does_not_say_how_is_none(tmp_path: Path) -> None:
    truth = tmp_path / "ground_truth.json"
    for text in (
        "",
        "[]",
        '{"cams": {}}',
        '{"made_by": {"scene": "sheet", "seed": 0, "options": {"old": 1}}}',
    ):
        truth.write_text(text)
        assert Simulated.of(truth) is None
    assert Simulated.of(tmp_path / "none.json") is None


def test_what_the_simulator_cannot_make_does_not_apply(
    session: Path, odd_scene: Scene, tmp_path: Path
) -> None:
    (tmp_path / "scene.yaml").write_text(REAL)
    filmed = load_scene(tmp_path / "scene.yaml", check_files=False)
    intact = Intact(filmed, tmp_path, odd_scene, tmp_path, 1.0, 0)
    with refused("session-not-simulated", kind=DoesNotApply):
        AXES["gloss"].damaging(intact)
    too_much = intact_of(session, odd_scene, tmp_path, 2.0)
    # four times as large is more than there is
    with refused("option-out-of-range", "motion_scale", kind=DoesNotApply):
        AXES["deformation"].damaging(too_much)


def test_without_the_renderer_only_what_is_rendered_already_applies(
    session: Path, odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "seed0").mkdir()
    intact = intact_of(session, odd_scene, tmp_path / "seed0", 50.0)
    AXES["sweep_motion"].damaging(intact)
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    AXES["sweep_motion"].damaging(intact)
    with refused("package-missing", "mitsuba", kind=DoesNotApply):
        AXES["sweep_motion"].damaging(replace(intact, severity=60.0))


def test_a_folder_that_cannot_be_written_ends_the_suite(
    session: Path, odd_scene: Scene, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    intact = intact_of(session, odd_scene, tmp_path / "file/seed0", 50.0)
    with refused("folder-unwritable", tmp_path / "file", kind=InputError):
        AXES["sweep_motion"].damaging(intact)


def test_a_session_lies_there_until_another_is_whole(session: Path, tmp_path: Path) -> None:
    folder = tmp_path / "session"
    shutil.copytree(session.parent, folder)
    with refused("option-out-of-range", "--cameras 0", kind=InputError):
        rendered(folder, replace(made(), cameras=0))
    assert is_rendered(folder, made())


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_cameras_draw_together_only_where_the_witness_stays(
    session: Path, odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    folder, asked = tmp_path / "session", list[Simulated]()
    shutil.copytree(session.parent, folder)
    truth = json.loads((folder / "ground_truth.json").read_text())
    truth["cams"] = {f"cam{n}": {} for n in range(count)} | {"witness": {}}
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    monkeypatch.setattr(
        "devrf.lab.bench.stability.damage.simulated.rendered",
        lambda folder, made, kept: asked.append(made),
    )
    intact = intact_of(folder / "scene.yaml", odd_scene, tmp_path / "axis/seed0", 75.0)
    if count % 2:
        with refused("witness-would-move", kind=DoesNotApply):
            AXES["spread"].damaging(intact)
        return
    AXES["spread"].damaging(intact)
    before, after = (
        [c.camera.centre for c in fixed_cameras(np.random.default_rng(0), count, (32, 24), how.options)]
        for how in (replace(made(), cameras=count), *asked)
    )
    np.testing.assert_array_equal(before[-1], after[-1])
    np.testing.assert_allclose(before[0], after[0], atol=1e-12)  # at the end to which the others draw
    assert np.linalg.norm(after[0] - after[-2]) < 0.5 * np.linalg.norm(before[0] - before[-2])


def test_a_simulated_data_set_is_made_again_with_more_motion(odd_scene: Scene, tmp_path: Path) -> None:
    few = DatasetOptions(
        spp=4, motion_scale=0.5, static_views=3, static_test_views=1, times=2, test_views_per_time=1
    )
    simulate_dataset(tmp_path / "set", Simulation("robot", 1, 0, (16, 16), few))
    config = load_scene(tmp_path / "set/scene.yaml")
    (tmp_path / "case/seed0").mkdir(parents=True)
    intact = Intact(config, tmp_path / "set", odd_scene, tmp_path / "case/seed0", 2.0, 0)
    dataset = AXES["deformation"].damaging(intact).config.dataset
    assert dataset is not None and dataset.path == str(tmp_path / "case/dataset")
    made_by = json.loads((tmp_path / "case/dataset/made_by.json").read_text())
    assert made_by["complete"] and made_by["options"]["motion_scale"] == 1.0

    with refused("option-out-of-range", "motion_scale", kind=DoesNotApply):
        AXES["deformation"].damaging(replace(intact, severity=4.0))
    (tmp_path / "set/made_by.json").unlink()
    with refused("session-not-simulated", kind=DoesNotApply):
        AXES["deformation"].damaging(intact)
