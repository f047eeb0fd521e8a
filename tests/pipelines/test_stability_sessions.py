"""Damage that makes a simulated session again: once for all seeds, and only what differs."""

import json
import shutil
from pathlib import Path

import pytest

from devrf.capture.errors import InputError
from devrf.capture.scene import Scene
from devrf.capture.simulate.session_options import SessionOptions
from devrf.pipelines.bench.stability.axes import AXES
from devrf.pipelines.bench.stability.damage.intact import DoesNotApply, Intact
from devrf.pipelines.bench.stability.session import how_it_was_made, rendered
from devrf.pipelines.bench.stability.session import session as of_the_suite
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import CaptureConfig
from devrf.pipelines.console import Talk

REAL = (
    "{name: real, capture: {static: static.mp4, cameras: {cam0: a.mp4, cam1: b.mp4}, test_cameras: [cam1]}}"
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    folder = tmp_path_factory.mktemp("suite") / "session"
    options = SessionOptions(
        sweep_frames=2, fps=4, duration_s=0.8, motion_scale=2, spp=4, board=False, sound=False, noise=0
    )
    return rendered(folder, {"scene": "sheet", "cameras": 1, "seed": 0, "size": (32, 24), "options": options})


def test_a_session_is_made_again_once_for_all_seeds_with_the_clips_that_stay(
    session: Path, odd_scene: Scene, tmp_path: Path
) -> None:
    config = load_scene(session)
    for axis, stays in (("moving_light", "static.mp4"), ("sweep_motion", "cam0.mp4")):
        made = tmp_path / axis / "session"

        def filmed(seed: int, axis: str = axis) -> CaptureConfig | None:
            folder = tmp_path / axis / f"seed{seed}"
            folder.mkdir(parents=True)
            return (
                AXES[axis]
                .damaging(Intact(config, session.parent, odd_scene, folder, 0.5, seed))
                .config.capture
            )

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
    options = SessionOptions.model_validate(
        json.loads((session.parent / "ground_truth.json").read_text())["made_by"]["options"]
    )
    made_by = {"scene": "sheet", "cameras": 1, "seed": 0, "size": (32, 24), "options": options}
    folder = tmp_path / "session"
    shutil.copytree(session.parent, folder)
    when = (folder / "scene.yaml").stat().st_mtime_ns
    rendered(folder, made_by)
    assert (folder / "scene.yaml").stat().st_mtime_ns == when
    rendered(folder, made_by | {"options": options.model_copy(update={"noise": 0.1})})
    assert how_it_was_made(folder) != how_it_was_made(session.parent)
    with pytest.raises(InputError, match="give another --out"):
        of_the_suite(tmp_path, Talk("quiet"))
    assert how_it_was_made(tmp_path / "none") is None


def test_what_the_simulator_cannot_make_does_not_apply(
    session: Path, odd_scene: Scene, tmp_path: Path
) -> None:
    (tmp_path / "scene.yaml").write_text(REAL)
    filmed = load_scene(tmp_path / "scene.yaml", check_files=False)
    intact = Intact(filmed, tmp_path, odd_scene, tmp_path, 1.0, 0)
    with pytest.raises(DoesNotApply, match="no simulated session"):
        AXES["gloss"].damaging(intact)
    too_much = Intact(load_scene(session), session.parent, odd_scene, tmp_path, 2.0, 0)
    with pytest.raises(DoesNotApply, match="motion_scale"):  # four times as large is more than there is
        AXES["deformation"].damaging(too_much)
