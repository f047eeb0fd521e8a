"""Stamps: what is made again and what is not, after every kind of change; and what is said of it."""

import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from tests.pipelines.config_reads import leaves, reads_of
from tests.pipelines.small_stages import ALL, executed, job, small_stages, stage

from devrf.pipelines.cli import status
from devrf.pipelines.exit_codes import BAD_INPUT, DONE
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import Standing, standings
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import code_version, digests, stamp
from devrf.pipelines.stamps.digests import Digests

CHAIN = ["first", "second", "third"]


def stand(folder: Path, *overrides: str) -> dict[str, Standing]:
    run = job(folder, small_stages(), *overrides)
    return {now.stage.name: now for now in standings(run.stages, run.config, folder, run.run_dir)}


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


def test_every_file_of_code_runs_what_depends_on_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = folder / "rooms"
    monkeypatch.setattr(code_version, "_room", lambda room: rooms / room)
    sources = {
        "pipelines/stages/first.py": "from devrf.capture.pictures import read",
        "pipelines/stages/second.py": "import devrf.pipelines.glue\nimport devrf.flow.worker",
        "pipelines/stages/third.py": "def run():\n    from devrf.flow import (  # lazily\n        worker,\n    )",
        "pipelines/stages/other.py": "STYLE = 'other.css'; WORKER = 'devrf.capture.named'",
        "pipelines/stages/other.css": "a {}",
        "pipelines/glue.py": "",
        "capture/pictures.py": "",
        "capture/named.py": "",
        "capture/unused.py": "",
        "flow/worker.py": "import devrf.capture.pictures as shared",
        "pipelines/runner/execute.py": "",
    }
    for name, text in sources.items():
        (rooms / name).parent.mkdir(parents=True, exist_ok=True)
        (rooms / name).write_text(text)
    executed(folder)
    expected = {
        "pipelines/stages/first.py": ["first"],
        "pipelines/stages/second.py": ["second"],
        "pipelines/stages/third.py": ["third"],
        "pipelines/stages/other.py": ["other"],
        "pipelines/stages/other.css": ["other"],
        "pipelines/glue.py": ["second"],
        "capture/pictures.py": CHAIN,
        "capture/named.py": ["other"],
        "capture/unused.py": [],
        "flow/worker.py": ["second", "third"],
        "pipelines/runner/execute.py": [],
    }
    for name in sources:
        with (rooms / name).open("a") as file:
            file.write("\n# changed")
        why = {stage: now.why for stage, now in stand(folder).items() if now.why}
        assert all(f"the code changed ({name})" in why[stage] for stage in expected[name]), name
        assert executed(folder) == expected[name], name


def test_code_that_is_gone_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    executed(folder)
    old = stamp.code_of_stage
    many = {f"devrf.flow.part{n}": "1" for n in range(5)}

    def code(stage, config):
        made = old(stage, config)
        return code_version.Code(many, made.libraries) if stage.name == "second" else made

    monkeypatch.setattr(stamp, "code_of_stage", code)
    now = stand(folder)
    assert now["second"].why == ("the code changed (flow/part0.py, flow/part1.py, flow/part2.py and 2 more)",)
    assert now["third"].why == ("second runs",)


# --- what the stages say of themselves is what their code does ---

MOTION = ("motion_iterations", "fine_tuning_iterations", "key_times", "learn_clocks")
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


# --- libraries ---


def test_a_library_counts_by_its_series(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_versions(**versions: str) -> dict[str, Standing]:
        monkeypatch.setattr(stamp, "code_of", lambda module, plug_ins: code_version.Code({}, versions))
        return stand(folder)

    with_versions(numpy="2.4.6", torch="2.13.0+cu130")
    executed(folder)
    assert {now.state for now in with_versions(numpy="2.4.9", torch="2.13.1+cpu").values()} == {"fresh"}
    assert with_versions(numpy="2.5.0", torch="2.13.0+cu130")["first"].why == ("numpy 2.4 is now 2.5",)
    assert with_versions(numpy="2.4.6")["first"].why == ("torch 2.13 is no longer there",)
    everything = with_versions(numpy="2.4.6", torch="2.13.0", scipy="1.17.1")
    assert everything["first"].why == ("scipy 1.17 is newly there",)


@pytest.mark.parametrize(
    ("version", "counts"),
    [
        ("2.4.6", "2.4"),
        ("2.13.0+cu130", "2.13"),
        ("5.0.0.93", "5.0"),
        ("7", "7"),
        ("1.2.3.post4", "1.2"),
        ("2.0.0rc1", "2.0.0rc1"),
        ("0.9.0.dev3+g12", "0.9.0.dev3+g12"),
    ],
)
def test_what_of_a_version_counts(version: str, counts: str) -> None:
    assert code_version.series(version) == counts


def test_each_stage_knows_the_libraries_it_works_with() -> None:
    """By the imports of its sources, under the names they are installed by."""
    found = {s.name: set(code_version.code_of(s.module).libraries) for s in STAGES}
    training = {"torch", "warp-lang", "numpy", "scipy", "safetensors"}
    assert (
        training <= found["canonical"] and training <= found["deformation"] and training <= found["evaluate"]
    )
    assert {"pycolmap", "numpy", "scipy"} <= found["static_poses"]
    assert {"av", "rawpy", "pillow"} <= found["ingest"]
    opencv = ("ingest", "static_poses", "rig", "flow")
    assert all(any(name.startswith("opencv") for name in found[stage]) for stage in opencv)
    assert not any(
        found[stage] & {"torch", "warp-lang"} for stage in ("ingest", "static_poses", "sync", "rig")
    )
    assert not any("pycolmap" in found[stage] for stage in ("ingest", "flow", "canonical", "deformation"))
    assert not any(found[stage] & {"jaxtyping", "typer", "rich", "pydantic"} for stage in found)


def test_an_estimator_of_others_counts_with_its_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, facts = tmp_path / "their_flow", tmp_path / "their_flow-1.2.3.dist-info"
    package.mkdir()
    facts.mkdir()
    (package / "__init__.py").write_text("")
    (package / "net.py").write_text("def make(weights, device): ...")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: their-flow\nVersion: 1.2.3\n")
    (facts / "RECORD").write_text("their_flow/__init__.py,,\ntheir_flow/net.py,,\n")
    (facts / "entry_points.txt").write_text("[devrf.flow]\ntheirs = their_flow.net:make\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (flow,) = (s for s in STAGES if s.name == "flow")
    for name in ("static.mp4", "cam0.mp4"):
        (tmp_path / name).write_bytes(b"clip")
    (tmp_path / "scene.yaml").write_text(
        "{name: a, capture: {static: static.mp4, cameras: {cam0: cam0.mp4}}, flow: {method: theirs}}"
    )
    run = job(tmp_path, STAGES)
    code = stamp.code_of_stage(flow, run.config)
    assert code.libraries["their-flow"] == "1.2.3"
    assert code.sources.keys() >= {"their_flow.net", "devrf.flow.estimator"}
    (package / "net.py").write_text("def make(weights, device): return 1")
    assert stamp.code_of_stage(flow, run.config) != code
    assert (
        "their_flow.net"
        not in stamp.code_of_stage(flow, job(tmp_path, STAGES, "flow.method=dis").config).sources
    )


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


# --- digests ---


def test_a_digest_is_remembered_only_of_a_file_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []
    real = digests.file_digest
    monkeypatch.setattr(digests, "file_digest", lambda path: read.append(path.name) or real(path))
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"one")

    def look() -> str:
        known = Digests(tmp_path)
        digest = known.of(path)
        known.save()
        return digest

    first = look()
    look()
    assert read == ["clip.mp4"] * 2  # written a moment ago: read again
    monkeypatch.setattr(digests, "RACY_S", 0.0)
    time.sleep(0.02)
    look()
    look()
    assert len(read) == 2
    stat = path.stat()
    path.write_bytes(b"two")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # size and time as before
    assert look() != first and len(read) == 3
    monkeypatch.setattr(digests.time, "time_ns", lambda: 1)  # the clock was set back
    look()
    assert len(read) == 4


def test_a_file_that_cannot_be_read_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def denied(path: Path) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(digests, "file_digest", denied)
    assert execute(job(folder, small_stages())) == BAD_INPUT
    assert f"{folder}/static.mp4: cannot be read (Permission denied)" in capsys.readouterr().err
    with pytest.raises(typer.Exit) as ended:
        status(folder / "scene.yaml")
    assert ended.value.exit_code == BAD_INPUT


def test_a_folder_counts_by_names_and_contents(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for n in range(20):  # more than are read one by one
        (data / "in" / f"{n}").parent.mkdir(parents=True, exist_ok=True)
        (data / "in" / f"{n}").write_bytes(bytes([n]))

    def now() -> str:
        return Digests(tmp_path / "run").of(data)

    seen = {now()}
    (data / "run").mkdir()
    (data / "run" / "devrf.log").write_text("a run folder does not count")
    assert now() in seen
    (data / "in" / "7").write_bytes(b"\x08")
    seen.add(now())
    (data / "in" / "8").rename(data / "in" / "eight")
    seen.add(now())
    (data / "in" / "9").unlink()
    seen.add(now())
    assert len(seen) == 4


@pytest.mark.parametrize(
    "text", ["", "[]", '{"a": 1}', '{"clip.mp4": [1, 2]}', '{"clip.mp4": [1,1,1,1,1,2]}']
)
def test_damaged_memory_of_digests_is_forgotten(tmp_path: Path, text: str) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"clip")
    (tmp_path / ".digests.json").write_text(text)
    assert Digests(tmp_path).of(tmp_path / "clip.mp4") == digests.file_digest(tmp_path / "clip.mp4")


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
