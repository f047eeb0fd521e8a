"""Stamps: what is made again and what is not, after every kind of change; and what is said of it."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.declared import watch
from tests.pipelines.small_stages import ALL, CHAIN, executed, job, small_stages, stage, stand
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.pipelines.config.load import load_scene
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import digests
from devrf.pipelines.stamps.stamp import stamp_content
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE


@pytest.fixture
def at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files as tests write them are never older than a few milliseconds."""
    monkeypatch.setattr(digests, "RACY_S", 0.0)


def test_second_run_executes_nothing(folder: Path) -> None:
    assert executed(folder) == ALL
    assert (folder / "run/second/sub/result.txt").read_text() == "second"
    assert executed(folder) == []


def test_a_finished_stage_says_what_made_it(folder: Path) -> None:
    executed(folder)
    made = json.loads((folder / "run/second/stamp.json").read_text())
    assert made["identity"]["config"] == {"reconstruct.rays": 100}
    assert made["identity"]["reads"].keys() == {"first"}
    assert made["files"].keys() == {"sub/result.txt", "made_of.txt", "health.json"}
    assert made["files"]["sub/result.txt"][0] == len("second")
    assert made["made_with"]["device"] == "cpu"
    health = json.loads((folder / "run/second/health.json").read_text())
    assert health["rows"][0]["verdict"] == "ok"
    assert not [
        path.name for path in (folder / "run").iterdir() if path.name.startswith((".new", ".old", ".lock"))
    ]


# --- every single change runs exactly what depends on it ---

CHANGES = {  # of a key -> what has to run
    "reconstruct.rays=101": ["second", "third"],
    "reconstruct.seed=2": ["other"],
    "preset=fast": [],
    "name=another": [],
    "output=./run": [],
    "evaluate.holdout_every=5": [],
    "reconstruct.resolution=40": [],
    "budget.disk_gb=5": [],
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_key_runs_what_depends_on_it(folder: Path, change: str) -> None:
    executed(folder)
    assert executed(folder, change) == CHANGES[change]
    assert executed(folder, change) == []
    assert executed(folder) == CHANGES[change]


@pytest.mark.parametrize(("name", "expected"), [("static.mp4", CHAIN), ("cam0.mp4", ["other"])])
def test_every_byte_of_every_file_runs_what_depends_on_it(
    folder: Path, name: str, expected: list[str], at_rest: None
) -> None:
    path = folder / name
    executed(folder)
    for n in range(path.stat().st_size):
        content = bytearray(path.read_bytes())
        content[n] ^= 1
        path.write_bytes(content)  # the same size
        assert executed(folder) == expected
        assert executed(folder) == []


def test_what_a_stage_reads_without_declaring_it_is_seen(folder: Path) -> None:
    """So that the watch over every run of the tests (`devrf`) can fail."""

    def run(context: StageContext) -> None:
        assert context.config.kind == "dynamic" and context.config.budget.disk_gb is None
        assert context.config.reconstruct.rays == 100 and context.config.reconstruct.seed == 1
        context.config.flow.model_dump()
        for name in ("scene", "render"):
            (context.run_dir / name / "made_of.txt").read_text()

    for name in ("scene", "render"):
        (folder / "run" / name).mkdir(parents=True)
        (folder / "run" / name / "made_of.txt").write_text(name)
    flow = stage("flow", ("scene",), ("reconstruct.rays",))
    made = job(folder, (flow,))
    context = StageContext(made.config, folder, folder / "run", folder / "out", lambda *_: None, "cpu")
    watch().watched(flow, run)(context)
    assert watch().undeclared() == [
        "flow reads reconstruct.seed",
        *(f"flow reads flow.{key}" for key in sorted(type(made.config.flow).model_fields)),
        "flow opens a file of render",
    ]


# --- nothing else runs anything ---


def test_touching_and_renaming_changes_nothing_but_content_does(folder: Path) -> None:
    executed(folder)
    os.utime(folder / "static.mp4", (1, 1))
    assert executed(folder) == []
    (folder / "static.mp4").rename(folder / "renamed.mp4")
    assert executed(folder, "capture.static=renamed.mp4") == []
    (folder / "renamed.mp4").write_bytes(b"SWEEP")
    assert executed(folder, "capture.static=renamed.mp4") == CHAIN


def test_a_folder_that_is_moved_or_copied_with_all_it_holds_runs_nothing(
    folder: Path, tmp_path: Path
) -> None:
    executed(folder)
    copied = tmp_path / "elsewhere" / "copied"
    shutil.copytree(folder, copied, copy_function=shutil.copyfile, ignore=lambda *_: {"elsewhere"})
    assert executed(copied) == []  # all times are new
    moved = tmp_path / "moved"
    copied.rename(moved)
    assert executed(moved) == []
    assert executed(folder) == []


def test_the_order_of_cameras_counts(folder: Path) -> None:
    """The first one's clock is everyone's."""
    (folder / "cam1.mp4").write_bytes(b"another")
    one, two = "{cam0: cam0.mp4, cam1: cam1.mp4}", "{cam1: cam1.mp4, cam0: cam0.mp4}"
    executed(folder, f"capture.cameras={one}")
    assert stand(folder, f"capture.cameras={one}")["other"].state == "fresh"
    assert stand(folder, f"capture.cameras={two}")["other"].why == (
        "capture.cameras: ['cam0', 'cam1'] is now ['cam1', 'cam0']",
    )


def test_what_comes_out_the_same_runs_nothing_that_follows(folder: Path) -> None:
    """A changed sweep of which the first stage sees no difference."""

    def blind(context: StageContext) -> None:
        (context.out / "made_of.txt").write_text("the same")

    first, *others = small_stages()
    first = replace(first, run=blind)

    def run() -> list[str]:
        made = job(folder, (first, *others))
        assert execute(made) == DONE
        return made.executed

    assert run() == ALL
    (folder / "static.mp4").write_bytes(b"SWEEP")
    assert run() == ["first"]


def test_a_data_set_that_lies_elsewhere_runs_only_what_points_to_it(folder: Path) -> None:
    data = folder / "data"
    data.mkdir()
    (data / "a.png").write_bytes(b"picture")

    def scene(context: StageContext) -> None:
        assert context.config.dataset is not None
        path = context.config.path(context.scene_dir, context.config.dataset.path) / "a.png"
        (context.out / "static").mkdir()
        names = {"file_path": Path(os.path.relpath(path, context.out / "static")).as_posix()}
        (context.out / "static" / "transforms.json").write_text(json.dumps(names))
        context.referred.append(path)

    real = next(s for s in STAGES if s.name == "scene")
    small = type(real)(
        "scene", (), ("dataset",), lambda config: None, scene, refers=real.refers, places=real.places
    )
    flow = stage("flow", ("scene",), ())

    def run(path: str) -> list[str]:
        (folder / "scene.yaml").write_text(
            f"{{name: a, output: run, dataset: {{format: blender, path: {path}}}}}"
        )
        made = job(folder, (small, flow))
        assert execute(made) == DONE
        return made.executed

    assert run("data") == ["scene", "flow"]
    (folder / "further").mkdir()
    data.rename(folder / "further" / "moved")
    assert run("further/moved") == ["scene"]
    said = json.loads((folder / "run/scene/static/transforms.json").read_text())["file_path"]
    assert (folder / "run/scene/static" / said).resolve() == folder / "further/moved/a.png"
    (folder / "further/moved/a.png").write_bytes(b"another")
    # which reads the picture, though scene only points to it
    assert run("further/moved") == ["scene", "flow"]
    (folder / "further/moved/notes.txt").write_text("of no picture")
    assert run("further/moved") == ["scene"]  # which came out the same


def test_a_scene_counts_by_what_it_points_to(tmp_path: Path) -> None:
    """Of a data set: what is only written otherwise, or belongs to no picture, costs no training."""
    scene, data = tiny_scene(tmp_path, "a"), tmp_path / "a/data"
    real = tuple(s for s in STAGES if s.name == "scene")

    def content() -> str | None:
        run = Run(load_scene(scene), scene.parent, real, Choice(allow_unhealthy=True), Talk("quiet"))
        assert execute(run) == DONE and run.executed == ["scene"]
        return stamp_content(run.run_dir / "scene")

    first = content()
    transforms = data / "transforms_train.json"
    transforms.write_text(json.dumps(json.loads(transforms.read_text()), indent=7))
    (data / "notes.txt").write_text("of no picture")
    assert content() == first
    picture = next(data.glob("**/r_0.png"))
    picture.write_bytes(picture.with_name("r_1.png").read_bytes())
    assert content() != first


# --- damage ---


def test_a_damaged_result_is_made_again(folder: Path, at_rest: None) -> None:
    executed(folder)
    (folder / "run/second/sub/result.txt").unlink()
    assert executed(folder) == ["second"]  # which comes out the same
    (folder / "run/third/sub/result.txt").write_text("THIRD")  # of the same size
    assert stand(folder)["third"].why == ("third/sub/result.txt was changed",)
    assert executed(folder) == ["third"]
    (folder / "run/third/health.json").unlink()
    assert executed(folder) == ["third"]


@pytest.mark.parametrize("name", ["second/stamp.json", "second/health.json", ".failed-third.json", ".lock"])
def test_what_is_nested_too_deeply_counts_as_damaged(folder: Path, name: str, at_rest: None) -> None:
    executed(folder)
    (folder / "run" / name).write_text("[" * 100_000)
    stand(folder)
    assert executed(folder) == (["second"] if name.startswith("second") else [])


@pytest.mark.parametrize("name", ["zero\0byte", "a" * 300])
def test_a_stamp_with_names_that_no_system_takes(folder: Path, name: str) -> None:
    executed(folder)
    stamp = folder / "run/second/stamp.json"
    made = json.loads(stamp.read_text())
    stamp.write_text(json.dumps(made | {"files": {**made["files"], name: [1, "x"]}}))
    assert executed(folder) == ["second"]


# --- what is said ---


def test_reasons_say_what_happened(folder: Path) -> None:
    """A file that is newly given or gone has not changed; what was empty or not set is said in words."""
    stages = (stage("first", (), ("flow.weights", "capture.test_cameras", "reconstruct.resolution")),)
    for name in ("a", "b"):
        (folder / f"{name}.pth").write_text(name)
    tests = "capture.test_cameras={witness: static.mp4}"
    raft = "flow.method=raft"

    def why(*overrides: str) -> str:
        run = job(folder, stages, *overrides)
        (now,) = run.standings()
        assert execute(run) == DONE
        return "; ".join(now.why)

    why()
    assert why(raft, "flow.weights=a.pth") == "flow.weights: newly given"
    assert why(raft, "flow.weights=b.pth") == "flow.weights: content changed"
    assert why() == "flow.weights: no longer given"
    assert why(tests) == "capture.test_cameras: no longer empty; capture.test_cameras.witness: newly given"
    assert why().startswith("capture.test_cameras: now empty")
    assert why("reconstruct.resolution=40") == "reconstruct.resolution: was not set, is now 40"
    assert why() == "reconstruct.resolution: was 40, is no longer set"


def test_a_stamp_of_an_earlier_version_is_told_from_this(folder: Path) -> None:
    executed(folder)
    path = folder / "run/first/stamp.json"
    old = json.loads(path.read_text())
    del old["identity"]["rooms"]
    path.write_text(json.dumps(old))
    assert stand(folder)["first"].why == (
        "made by a version of the program that knew less of what it was made from",
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda stamp: {"identity": 5},
        lambda stamp: {"identity": {}},
        lambda stamp: stamp | {"id": 5},
        lambda stamp: {key: value for key, value in stamp.items() if key != "id"},
        lambda stamp: stamp | {"identity": dict.fromkeys(stamp["identity"], [])},
        lambda stamp: stamp | {"files": {"sub/result.txt": 5}},
        lambda stamp: stamp | {"files": 5},
        lambda stamp: {key: value for key, value in stamp.items() if key != "files"},
        lambda stamp: [stamp],
    ],
)
def test_an_odd_stamp_only_makes_the_stage_again(folder: Path, change: Callable[[dict], object]) -> None:
    executed(folder)
    path = folder / "run/second/stamp.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    assert executed(folder) == ["second"]
    assert executed(folder) == []
