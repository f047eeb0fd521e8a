"""Batches whose scenes and stages lie in a store: what comes, what goes, what half a push is worth."""

import json
import shutil
from pathlib import Path
from typing import Any

import fsspec
import pytest
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.pipelines.batch import command
from devrf.pipelines.batch.inputs import OUTSIDE, inputs_of
from devrf.pipelines.batch.scenes import Options
from devrf.pipelines.batch.scratch import SCRATCH, scratch_dir
from devrf.pipelines.batch.store import Store, StoreError
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.exit_codes import DONE, FAILED
from devrf.pipelines.stamps.digests import Digests, file_digest

STAMP = {"id": "1", "identity": {}, "content": "x"}


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine's scratch folder."""
    monkeypatch.setenv(SCRATCH, str(tmp_path / "scratch"))
    return tmp_path / "scratch"


@pytest.fixture(params=["file", "memory"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "memory":
        fsspec.filesystem("memory").store.clear()
        return "memory://store"
    return f"file://{tmp_path}/store"


def run(folder: Path, names: list[str], url: str, until: str = "scene") -> tuple[int, dict[str, Any]]:
    paths = [folder / name for name in names]
    machines = command.Machines(jobs=1, device="cpu")
    code = command.batch(Talk("quiet"), paths, Options(until=until), machines, folder / "out", url)
    rows = json.loads((folder / "out/batch.json").read_text())["scenes"]
    return code, {row["name"]: row for row in rows}


def finished(folder: Path, text: str, made: str) -> tuple[Path, dict[str, Any]]:
    """A stage as the runner leaves it."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "sub").mkdir(parents=True)
    (folder / "sub/result.txt").write_text(text)
    file = folder / "sub/result.txt"
    stamp = STAMP | {"id": made, "files": {"sub/result.txt": [file.stat().st_size, file_digest(file)]}}
    (folder / "stamp.json").write_text(json.dumps(stamp))
    return folder, stamp


def test_scenes_come_and_results_go(tmp_path: Path, scratch: Path, url: str) -> None:
    for name in ("a", "b"):
        tiny_scene(tmp_path, name)
    code, rows = run(tmp_path, ["a", "b"], url)
    assert code == DONE, rows
    assert rows["a"]["made"] == rows["b"]["made"] == ["scene"]
    assert not (tmp_path / "a/run").exists()  # it worked on a copy
    assert not list(scratch_dir(url).glob("scenes/*")) and not list(scratch_dir(url).glob("inputs/*"))
    assert Store(url).stamp("a", "scene") is not None
    code, rows = run(tmp_path, ["a", "b"], url)  # what is stored is fresh
    assert code == DONE and rows["a"]["made"] == [] and rows["a"]["nodes"] == []
    picture = tmp_path / "b/data/train/r_0.png"
    picture.write_bytes((tmp_path / "b/data/train/r_1.png").read_bytes())
    code, rows = run(tmp_path, ["a", "b"], url)
    assert code == DONE
    assert rows["a"]["made"] == [] and rows["b"]["made"] == ["scene"]


def test_another_machine_goes_on_from_the_store(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny_scene(tmp_path, "a")
    url = f"file://{tmp_path}/store"
    assert run(tmp_path, ["a"], url, "scene")[0] == DONE
    monkeypatch.setenv(SCRATCH, str(tmp_path / "another"))
    code, rows = run(tmp_path, ["a"], url, "report")
    assert code == DONE, rows
    assert rows["a"]["made"] == ["canonical", "evaluate", "render", "report"]
    assert rows["a"]["numbers"]["psnr"] > 0
    assert Path(rows["a"]["report"]).is_file()
    assert run(tmp_path, ["a"], url, "report")[1]["a"]["made"] == []


def test_half_a_push_is_none(tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(url)
    folder, stamp = finished(tmp_path / "run/scene", "first", "1")
    store.push("a", folder, stamp)

    def cut(*arguments: object) -> None:
        raise OSError("the network is down")

    folder, stamp = finished(tmp_path / "run/scene", "second", "2")
    monkeypatch.setattr(store._fs, "pipe_file", cut)
    with pytest.raises(StoreError, match="the network is down"):
        store.push("a", folder, stamp)
    monkeypatch.undo()
    store.pull("a", "scene", tmp_path / "other")
    assert (tmp_path / "other/scene/sub/result.txt").read_text() == "first"
    store.push("a", folder, stamp)
    store.pull("a", "scene", tmp_path / "other")
    assert (tmp_path / "other/scene/sub/result.txt").read_text() == "second"
    assert len(store._list("runs/a/scene")) == 1  # what it replaced is gone
    store.pull("a", "flow", tmp_path / "other")
    assert not (tmp_path / "other/flow").exists()


@pytest.mark.parametrize("damage", ["first", "firs", None])
def test_what_was_changed_in_the_store_is_refused(tmp_path: Path, url: str, damage: str | None) -> None:
    store = Store(url)
    folder, stamp = finished(tmp_path / "run/scene", "FIRST", "1")
    store.push("a", folder, stamp)
    place = store._path("runs/a/scene/1/sub/result.txt")
    if damage is None:
        store._fs.rm(place)
    else:
        store._fs.pipe_file(place, damage.encode())
    with pytest.raises(StoreError, match="is missing" if damage is None else "is not what was stored"):
        store.pull("a", "scene", tmp_path / "other")
    assert not (tmp_path / "other/scene").exists()


def test_a_stamp_cannot_lead_out_of_the_stage(tmp_path: Path, url: str) -> None:
    store = Store(url)
    folder, stamp = finished(tmp_path / "run/scene", "x", "1")
    store.push("a", folder, stamp | {"files": {}})
    evil = stamp | {"files": {"../../../evil": [1, "0"]}}
    store._fs.pipe_file(store._path("runs/a/scene.json"), json.dumps(evil).encode())
    with pytest.raises(StoreError, match="outside of the stage"):
        store.pull("a", "scene", tmp_path / "other")


def test_an_input_is_fetched_once_and_checked(tmp_path: Path, scratch: Path) -> None:
    tiny_scene(tmp_path, "a")
    url = f"file://{tmp_path}/store"
    assert run(tmp_path, ["a"], url)[0] == DONE
    for file in (tmp_path / "store/inputs").iterdir():
        file.write_bytes(file.read_bytes()[:-1] + b"?")
    shutil.rmtree(tmp_path / "store/runs")
    code, rows = run(tmp_path, ["a"], url)
    assert code == FAILED and "is not what was stored" in rows["a"]["message"]


def test_files_outside_of_the_scenes_folder_come_too(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a")
    (tmp_path / "a/data").rename(tmp_path / "elsewhere")
    scene.write_text(scene.read_text().replace("path: data", "path: ../elsewhere"))
    found = inputs_of(load_scene(scene), scene, Digests(tmp_path / "run"))
    assert found.overrides[0].startswith(f'dataset.path="{OUTSIDE}/')
    assert {Path(name).parts[0] for name in found.files} == {"scene.yaml", OUTSIDE}
    assert len(found.files) == 1 + 1 + 9


def test_a_store_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    with pytest.raises(command.InputError, match="--store nonsense://x"):
        Store("nonsense://x")
