"""Stamps: what is made again and what is not, after every kind of change; and what is said of it."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.pipelines.config_reads import leaves, reads_of
from tests.pipelines.small_stages import ALL, CHAIN, executed, job, small_stages, stage, stand

from devrf.pipelines.exit_codes import DONE
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import standings
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import code_version, digests


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
    "cache.max_gb=3": [],
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


# --- what the stages say of themselves is what their code does ---

MOTION = ("motion_iterations", "fine_tuning_iterations", "key_times")
READ_BUT_NOT_A_KEY = {
    "ingest": {"capture.rest"},  # a session carries it for `check`
    "canonical": {
        f"reconstruct.{key}" for key in MOTION
    },  # options of both trainings are made at once: test_stages
    "evaluate": {"evaluate.truth"},  # `inputs` has its content, named or not
}


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_the_keys_of_a_stage_are_those_its_code_reads(stage: Stage) -> None:
    """All but the budget, which is as much the machine's as the file's: docs/formats.md."""
    declared = {leaf for key in stage.config_keys for leaf in leaves(key)}
    read = reads_of(stage.module) - READ_BUT_NOT_A_KEY.get(stage.name, set()) - leaves("budget")
    assert declared == read


def test_keys_are_found_wherever_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the test above can fail."""
    (tmp_path / "reader.py").write_text(
        "from devrf.pipelines.board_spec import board_spec\n"
        "class Work:\n"
        "    def __init__(self, context: StageContext) -> None:\n"
        "        self.context, self.rig = context, context.config.calibration.rig\n"
        "    def given(self):\n"
        "        return self.rig.given\n"
        "def helper(settings: 'SyncConfig | None'):\n"
        "    return lambda: settings.method\n"
        "def unused(config: SceneConfig):\n"
        "    return config.name\n"
        "def run(context: StageContext) -> None:\n"
        "    capture = None if context is None else context.config.capture\n"
        "    Work(context), helper(None), board_spec, capture.training_cameras\n"
        "    context.config.flow.model_dump_json()\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    board = {
        f"capture.board.{key}"
        for key in (
            *("type", "squares", "square_m", "marker_m", "separation_m", "dictionary", "inverted", "legacy"),
        )
    }
    assert reads_of("reader") == board | {
        "calibration.rig.given",
        "calibration.sync.method",
        "capture.cameras",
        "capture.test_cameras",
        "flow.method",
        "flow.preset",
        "flow.weights",
    }


STAGE_FOLDER = re.compile(r"""(?:run_dir|self\.run) / ["'](\w+)["']""")


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_the_folders_that_a_stage_reads_are_among_its_reads(stage: Stage) -> None:
    files = [path for name, path in code_version.sources(stage.module).items() if ".pipelines." in name]
    named = {word for path in files for word in STAGE_FOLDER.findall(path.read_text())}
    if stage.name != "report":  # which is told the stages it looks at
        assert named & {s.name for s in STAGES} - {stage.name} <= set(stage.reads)


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
    assert run("further/moved") == [
        "scene",
        "flow",
    ]  # which reads the picture, though scene only points to it


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


# --- what is said ---


def test_reasons_say_what_happened(folder: Path) -> None:
    """A file that is newly given or gone has not changed; what was empty or not set is said in words."""
    stages = (stage("first", (), ("flow.weights", "calibration.colour.chart", "reconstruct.resolution")),)
    for name in ("a", "b"):
        (folder / f"{name}.pth").write_text(name)
    chart = "calibration.colour.chart={cam0: cam0.mp4, static: static.mp4}"
    raft = "flow.method=raft"

    def why(*overrides: str) -> str:
        run = job(folder, stages, *overrides)
        (now,) = standings(stages, run.config, folder, run.run_dir)
        assert execute(run) == DONE
        return "; ".join(now.why)

    why()
    assert why(raft, "flow.weights=a.pth") == "flow.weights: newly given"
    assert why(raft, "flow.weights=b.pth") == "flow.weights: content changed"
    assert why() == "flow.weights: no longer given"
    assert why(chart) == "; ".join(
        f"calibration.colour.chart{text}"
        for text in (": no longer empty", ".cam0: newly given", ".static: newly given")
    )
    assert why().startswith("calibration.colour.chart: now empty")
    assert why("reconstruct.resolution=40") == "reconstruct.resolution: was not set, is now 40"
    assert why() == "reconstruct.resolution: was 40, is no longer set"


def test_a_stamp_of_an_earlier_version_is_told_from_this(folder: Path) -> None:
    executed(folder)
    path = folder / "run/first/stamp.json"
    old = json.loads(path.read_text())
    del old["identity"]["libraries"]
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
@pytest.mark.parametrize("cached", [(), ("cache.folder=kept",)])
def test_an_odd_stamp_only_makes_the_stage_again(
    folder: Path, change: Callable[[dict], object], cached: tuple[str, ...]
) -> None:
    executed(folder, *cached)
    path = folder / "run/second/stamp.json"
    odd = change(json.loads(path.read_text()))
    for entry in (path, *folder.glob("kept/second/*/stamp.json")):
        entry.unlink()
        entry.write_text(json.dumps(odd))
    assert executed(folder, *cached) == ["second"]
    assert executed(folder, *cached) == []
