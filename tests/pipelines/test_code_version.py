"""Which code and which libraries make a stage, and that a change of them makes it stale."""

import ast
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from tests.pipelines.small_stages import ALL, CHAIN, job, small_stages

from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Standing
from devrf.pipelines.stage import Stage
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import code_version, stamp
from devrf.pipelines.terminal.exit_codes import DONE

HERE = Path(__file__).parents[2]
OF_RUNNER = ("budget", "config", "runner", "stamps", "terminal")  # what stages use of what is left out
IN = {
    "first": ("capture",),
    "second": ("capture", "flow"),
    "third": ("flow", "pipelines/report"),
    "other": (),
}
DISTRIBUTIONS = {
    "cv2": "opencv-contrib-python-headless",
    "PIL": "pillow",
    "warp": "warp-lang",
    "yaml": "pyyaml",
}
NO_RESULTS = {"jaxtyping", "psutil", "pydantic", "mitsuba", "tomli"}  # they check, or make no stage's results


def a_run(folder: Path) -> Run:
    """The small stages, with rooms."""
    return job(folder, tuple(replace(stage, rooms=IN[stage.name]) for stage in small_stages()))


def stand(folder: Path) -> dict[str, Standing]:
    return {now.stage.name: now for now in a_run(folder).standings()}


def test_every_file_of_code_runs_what_may_import_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_version, "_HERE", folder / "rooms")
    expected = {
        "capture/photos/upright_pictures.py": ("capture/", ["first", "second"]),
        "capture/viewer/odd.js": ("capture/", ["first", "second"]),  # only `pipelines/viewer` is left out
        "flow/worker.py": ("flow/", ["second", "third"]),
        "reconstruct/rendering/model.py": ("", []),
        "pipelines/glue.py": ("pipelines/", ALL),
        "pipelines/health/table.yaml": ("pipelines/", ALL),
        "pipelines/report/page.css": ("pipelines/report/", ["third"]),
        "pipelines/runner/execute.py": ("", []),
        "pipelines/stages/__init__.py": ("", []),
        "pipelines/stages/other.py": ("pipelines/stages/other.py", ["other"]),
        "capture/notes.txt": ("", []),
    }

    def write(name: str, text: str) -> None:
        path = folder / "rooms" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def executed() -> list[str]:
        run = a_run(folder)
        assert execute(run) == DONE
        return run.executed

    for name in (*expected, *(f"pipelines/stages/{name}.py" for name in CHAIN)):
        write(name, "")
    assert executed() == ALL
    for name, (said, stages) in expected.items():
        write(name, "# changed")
        why = {stage: now.why for stage, now in stand(folder).items() if now.why}
        assert all(f"the code changed ({said})" in why[stage] for stage in stages), name
        assert executed() == stages, name
    (folder / "rooms/flow/worker.py").rename(folder / "rooms/flow/other.py")
    assert executed() == ["second", "third"]


def test_the_version_of_a_room_is_that_of_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_version, "_HERE", tmp_path)
    for name in ("flow/a.py", "capture/formats/b.py", "capture/c.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    both, part = code_version.code_version("flow", "capture"), code_version.code_version("capture/formats")
    (tmp_path / "capture/c.py").write_text("x = 2\n")
    assert code_version.code_version("flow", "capture") != both
    assert code_version.code_version("capture/formats") == part


# --- what stages import ---


def third_party(files: list[Path]) -> set[str]:
    """Top names of what files import beside the standard library and these rooms."""
    tops = {name.partition(".")[0] for file in files for name in imported(file)}
    return tops - {"devrf"} - set(sys.stdlib_module_names)


def imported(file: Path) -> set[str]:
    """Modules that a file may import (`from a import b` gives both a and a.b), or runs by their names.

    What is imported only for the type checkers never runs.
    """
    found: set[str] = set()
    todo: list[ast.AST] = [ast.parse(file.read_text("utf-8"))] if file.suffix == ".py" else []
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            todo += node.orelse
            continue
        todo += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Constant) and re.fullmatch(r"devrf(\.\w+)+", str(node.value)):
            found.add(str(node.value))
    return found


def file_of(module: str) -> Path | None:
    place = HERE.joinpath(*module.split(".")[1:])
    files = (place.with_suffix(".py"), place / "__init__.py")
    return next((file for file in files if file.is_file()), None) if module.startswith("devrf.") else None


@pytest.mark.parametrize("stage", STAGES, ids=[stage.name for stage in STAGES])
def test_whatever_a_stage_imports_counts(stage: Stage) -> None:
    own, apart = code_version.counted(code_version.module_of(stage.name)), code_version.APART
    shared = code_version.counted(code_version.SHARED, apart)
    counts = {*own, *shared, *(file for room in stage.rooms for file in code_version.counted(room))}
    todo, seen = list(own), set(own)
    while todo:
        for file in {file for name in imported(todo.pop()) if (file := file_of(name)) is not None} - seen:
            seen.add(file)
            if file in counts:
                todo.append(file)
                continue
            room, folder, *_ = file.relative_to(HERE).parts
            passed = folder in OF_RUNNER or file.parent.name == "stages" and file.name == "__init__.py"
            assert room == "pipelines" and passed, file
    for room in stage.rooms:
        assert seen & set(code_version.counted(room)), f"{stage.name} imports nothing of {room}"


@pytest.mark.parametrize("room", code_version.LIBRARIES)
def test_whatever_a_room_computes_with_counts(room: str) -> None:
    found = {DISTRIBUTIONS.get(top, top) for top in third_party(code_version.counted(room))} - NO_RESULTS
    known = set(code_version.LIBRARIES[room])
    beside = set(code_version.LIBRARIES["capture"]) if "/" in room else set()
    assert known <= found <= known | beside


# --- libraries ---


def test_a_library_counts_by_its_series(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_versions(**versions: str) -> dict[str, Standing]:
        monkeypatch.setattr(stamp, "code_of", lambda stage, rooms, plug_ins: code_version.Code({}, versions))
        return stand(folder)

    with_versions(numpy="2.4.6", torch="2.13.0+cu130")
    assert execute(a_run(folder)) == DONE
    assert {now.state for now in with_versions(numpy="2.4.9", torch="2.13.1+cpu").values()} == {"fresh"}
    assert with_versions(numpy="2.5.0", torch="2.13.0+cu130")["first"].why == ("numpy 2.4 is now 2.5",)
    assert with_versions(numpy="2.4.6")["first"].why == ("torch 2.13 is no longer there",)
    everything = with_versions(numpy="2.4.6", torch="2.13.0", scipy="1.17.1")
    assert everything["first"].why == ("scipy 1.17 is newly there",)
    monkeypatch.setattr("devrf.__version__", "7.1.0")
    assert "7.1" in with_versions(numpy="2.4.6", torch="2.13.0")["first"].why[0]


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
    assert code.rooms.keys() == {"capture", "flow", "pipelines", "pipelines/stages/flow.py", "their_flow"}
    (package / "net.py").write_text("def make(weights, device): return 1")
    assert stamp.code_of_stage(flow, run.config) != code
    assert (
        "their_flow" not in stamp.code_of_stage(flow, job(tmp_path, STAGES, "flow.method=dis").config).rooms
    )
