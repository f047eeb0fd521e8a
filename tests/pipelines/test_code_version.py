"""Which code and which libraries make a stage, and that a change of them makes it stale."""

import sys
from pathlib import Path

import pytest
from tests.pipelines.small_stages import CHAIN, executed, job, stand

from devrf.pipelines.runner.plan import Standing
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import code_version, stamp


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
    assert training <= found["canonical"] and training <= found["deformation"]
    assert training <= found["evaluate"]
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
