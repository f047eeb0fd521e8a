"""Batches whose scenes and stages lie in a store: what comes, what goes, what half a push is worth."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from tests.pipelines.tiny_scenes import tiny_scene
from tests.refused import refused

from devrf.capture.errors import InputError
from devrf.pipelines.batch import command, work
from devrf.pipelines.batch import scratch as scratch_module
from devrf.pipelines.batch.inputs import OUTSIDE, inputs_of
from devrf.pipelines.batch.scenes import Options, look
from devrf.pipelines.batch.scratch import SCRATCH, Scratch, Stored, scratch_dir
from devrf.pipelines.batch.store import Store, StoreError
from devrf.pipelines.batch.task import Task, run_task
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.exit_codes import BAD_INPUT, DONE, FAILED
from devrf.pipelines.runner.workspace import Workspace
from devrf.pipelines.stamps import digests
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


def store_in(folder: Path) -> str:
    return f"file://{folder}/store"


def run(folder: Path, names: str, until: str = "scene", url: str | None = None) -> tuple[int, dict[str, Any]]:
    paths = [folder / name for name in names]
    machines = command.Machines(jobs=1, device="cpu")
    store = url or store_in(folder)
    code = command.batch(Talk("quiet"), paths, Options(until=until), machines, folder / "out", store)
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


def pull(store: Store, stage: str, run_dir: Path) -> None:
    with Workspace(run_dir) as workspace:
        store.pull("a", stage, store.stamps("a", [stage])[stage], workspace)


def stored_task(folder: Path, name: str = "a") -> tuple[Task, Stored]:
    """A task on a scene whose raw files are in the store."""
    path, url = tiny_scene(folder, name), store_in(folder)
    inputs = inputs_of(load_scene(path), path, Digests(folder / name / "run"))
    Store(url).put_inputs(inputs.here)
    stored = Stored(url, name, path.name, inputs.files)
    return Task(path, folder / name / "run", ("scene",), ("--device", "cpu"), 1, False, stored=stored), stored


def test_a_full_disk_where_stages_are_looked_at_is_an_error_of_the_scene(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(command, "mirror", full)
    (scene,) = look([tiny_scene(tmp_path, "a")], Options())
    with refused("folder-unwritable", "scenes/a", "No space left on device"):
        command._seen_in(scene, tmp_path / "out", Store(url), Talk("quiet"))


def test_scenes_come_and_results_go(tmp_path: Path, scratch: Path, url: str) -> None:
    for name in ("a", "b"):
        tiny_scene(tmp_path, name)
    code, rows = run(tmp_path, "ab", url=url)
    assert code == DONE, rows
    assert rows["a"]["made"] == rows["b"]["made"] == ["scene"]
    assert not (tmp_path / "a/run").exists()  # it worked on a copy
    assert not list(scratch_dir(url).glob("scenes/*")) and not list(scratch_dir(url).glob("inputs/*"))
    assert list(Store(url).stamps("a", ["ingest", "scene"])) == ["scene"]
    code, rows = run(tmp_path, "ab", url=url)  # what is stored is fresh
    assert code == DONE and rows["a"]["made"] == [] and rows["a"]["nodes"] == []
    picture = tmp_path / "b/data/train/r_0.png"
    picture.write_bytes((tmp_path / "b/data/train/r_1.png").read_bytes())
    code, rows = run(tmp_path, "ab", url=url)
    assert code == DONE
    assert rows["a"]["made"] == [] and rows["b"]["made"] == ["scene"]


def test_a_machine_that_has_done_its_part_keeps_nothing(tmp_path: Path, scratch: Path) -> None:
    assert run_task(stored_task(tmp_path)[0]).code == DONE  # others train it
    assert list(Store(store_in(tmp_path)).stamps("a", ["scene"])) == ["scene"]
    assert not list(scratch_dir(store_in(tmp_path)).glob("*/*"))


def test_scenes_side_by_side_do_not_disturb_each_other(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ((a, in_a), (b, in_b), (c, in_c)), get = (stored_task(tmp_path, n) for n in "abc"), Store.get_inputs
    first, second = Scratch(in_a), Scratch(in_b)
    first.fetch(a.stages)

    def first_ends_meanwhile(store: Store, files: dict[Any, Path]) -> None:
        get(store, files)
        first.remove()

    monkeypatch.setattr(Store, "get_inputs", first_ends_meanwhile)
    second.fetch(b.stages)  # its pictures are those of the first, but its scene.yaml is its own
    assert {path.name for path in second.scene.parent.rglob("*.png")} == {f"r_{n}.png" for n in range(9)}
    there = scratch_dir(store_in(tmp_path)) / "inputs"
    assert {path.name for path in there.iterdir()} == {digest for _, digest in in_b.files.values()}
    fetched = []
    monkeypatch.setattr(Store, "get_inputs", lambda store, files: (fetched.extend(files), get(store, files)))
    Scratch(in_c).fetch(c.stages)
    assert fetched == [in_c.files["scene.yaml"]]  # the pictures are here


def test_what_lies_in_the_scratch_is_compared_before_it_is_used(tmp_path: Path, scratch: Path) -> None:
    task, stored = stored_task(tmp_path)
    here = Scratch(stored)
    (scratch_dir(store_in(tmp_path)) / "inputs").mkdir()
    for name in ("scene.yaml", "data/train/r_0.png"):
        size, digest = stored.files[name]
        (scratch_dir(store_in(tmp_path)) / "inputs" / digest).write_bytes(b"x" * size)
    for _ in range(2):  # the true ones are shared from then on
        here.fetch(task.stages)
        for name in ("scene.yaml", "data/train/r_0.png"):
            place = here.scene.parent / name
            assert place.read_bytes() == (tmp_path / "a" / name).read_bytes() and place.stat().st_nlink == 2


@pytest.mark.parametrize("how", ["another user's", "open", "a link"])
def test_a_scratch_that_others_could_write_is_refused(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    task, stored = stored_task(tmp_path)
    Scratch(stored)
    folder = scratch_dir(store_in(tmp_path))
    assert folder.stat().st_mode & 0o777 == 0o700
    if how == "open":
        folder.chmod(0o770)
    elif how == "a link":
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        monkeypatch.setattr(scratch_module, "scratch_dir", lambda url: folder)
        monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with refused("scratch-not-own", folder, SCRATCH, "0700", kind=InputError):
        Scratch(stored)
    assert run_task(task).code == BAD_INPUT and not list(folder.iterdir())


def test_one_content_under_two_names_comes_twice(tmp_path: Path, scratch: Path) -> None:
    task, stored = stored_task(tmp_path)
    files = stored.files
    twins = Scratch(replace(stored, files={**files, "again/r_0.png": files["data/train/r_0.png"]}))
    for _ in range(2):  # from the store, and from here
        twins.fetch(task.stages)
        found = (twins.scene.parent / "again/r_0.png", twins.scene.parent / "data/train/r_0.png")
        assert found[0].read_bytes() == found[1].read_bytes()


def test_nothing_is_laid_out_where_a_run_works(tmp_path: Path, scratch: Path) -> None:
    task, stored = stored_task(tmp_path)
    here = Scratch(stored)
    here.scene.parent.mkdir(parents=True)
    (here.scene.parent / "in use").touch()
    with Workspace(here.run_dir):
        ended = run_task(task)
        assert ended.code == BAD_INPUT and "another run" in (ended.message or "")
        assert (here.scene.parent / "in use").exists()


@pytest.mark.full
@pytest.mark.parametrize("missing", [False, True])
def test_a_stage_that_is_damaged_in_the_store_is_made_anew(
    tmp_path: Path, scratch: Path, missing: bool
) -> None:
    for name in ("a", "b"):
        tiny_scene(tmp_path, name)
    assert run(tmp_path, "ab")[0] == DONE
    (health,) = tmp_path.glob("store/runs/a/scene/*/health.json")
    health.unlink() if missing else health.write_bytes(b"x" * health.stat().st_size)
    shutil.rmtree(tmp_path / "out")
    code, rows = run(tmp_path, "ab")
    assert code == DONE and rows["a"]["made"] == ["scene"] and rows["b"]["made"] == []
    assert "scene" in rows["a"]["message"] and ("digest" in rows["a"]["message"]) != missing
    code, rows = run(tmp_path, "ab")
    assert code == DONE and rows["a"]["made"] == [] == rows["a"]["nodes"]


@pytest.mark.full
def test_damage_that_only_the_next_stage_meets_is_mended_too(tmp_path: Path, scratch: Path) -> None:
    tiny_scene(tmp_path, "a")
    assert run(tmp_path, "a")[0] == DONE
    (stored,) = tmp_path.glob("store/runs/a/scene/*/scene.json")
    stored.unlink()
    code, rows = run(tmp_path, "a", "canonical")  # the batch takes the stage for fresh
    assert code == DONE and rows["a"]["made"] == ["scene", "canonical"], rows


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", '{"id": "1", "identity": {}}']
    + [
        json.dumps({"id": "1", "identity": {}, "files": {}} | wrong)
        for wrong in (
            {"id": 1},
            {"identity": []},
            {"files": []},
            {"files": {"a": 1}},
            {"files": {"a": ["1", "x"]}},
        )
    ],
)
def test_what_is_no_stamp_is_none(url: str, text: str) -> None:
    store = Store(url)
    store._make_folders([store._path("runs/a/scene.json")])
    store._fs.pipe_file(store._path("runs/a/scene.json"), text.encode())
    assert store.stamps("a", ["scene"]) == {}


@pytest.mark.parametrize("error", [OSError, ValueError])
def test_a_store_that_does_not_answer_is_an_error(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise error("the network is down")

    store = Store(url)
    stage = finished(tmp_path / "run/scene", "x", "1")
    store.push("a", *stage)
    for ask in ("cat_file", "ls"):
        monkeypatch.setattr(store._fs, ask, fails)
        with refused("store-unreachable", url, "the network is down", kind=StoreError):
            store.stamps("a", ["scene"])
        monkeypatch.undo()
    for give in ("put", "makedirs" if url.startswith("file") else "pipe_file"):
        monkeypatch.setattr(store._fs, give, fails)
        with refused("store-unreachable", url, "the network is down", kind=StoreError):
            store.push("a", *stage)
        monkeypatch.undo()


@pytest.mark.full
def test_raw_files_are_read_once(tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_scene(tmp_path, "a")
    tiny_scene(tmp_path, "b")
    read, listed = [], []
    entry, there = digests._entry, Store._list
    monkeypatch.setattr(digests, "RACY_S", 0.0)  # the files were only just written
    monkeypatch.setattr(digests, "_entry", lambda path: (read.append(path), entry(path))[1])
    monkeypatch.setattr(
        Store, "_list", lambda store, folder: (listed.append(folder), there(store, folder))[1]
    )
    assert run(tmp_path, "ab")[0] == DONE
    raw = sorted(path for name in "ab" for path in (tmp_path / name).rglob("*") if path.is_file())
    assert sorted(path for path in read if tmp_path / "scratch" not in path.parents) == raw
    assert listed.count("inputs") == 1  # by the batch; what it has put there it knows
    read.clear()
    assert run(tmp_path, "ab")[0] == DONE
    assert not read


@pytest.mark.full
def test_another_machine_goes_on_from_the_store(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny_scene(tmp_path, "a")
    assert run(tmp_path, "a", "scene")[0] == DONE
    monkeypatch.setenv(SCRATCH, str(tmp_path / "another"))
    code, rows = run(tmp_path, "a", "report")
    assert code == DONE, rows
    assert rows["a"]["made"] == ["canonical", "evaluate", "render", "report"]
    assert rows["a"]["numbers"]["psnr"] > 0
    assert Path(rows["a"]["report"]).is_file()
    assert run(tmp_path, "a", "report")[1]["a"]["made"] == []


@pytest.mark.parametrize("uploading", [False, True])
def test_a_raw_file_that_vanishes_ends_its_scene_alone(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch, uploading: bool
) -> None:
    """Between the look at it and the store's, or while it is on its way."""
    for name in ("a", "b"):
        tiny_scene(tmp_path, name)
    owner, name = (Store, "_put") if uploading else (work, "inputs_of")
    real = getattr(owner, name)

    def vanishes(*arguments: Any) -> Any:
        found = real(*arguments) if not uploading else None
        (tmp_path / "a/data/train/r_3.png").unlink(missing_ok=True)
        return real(*arguments) if uploading else found

    monkeypatch.setattr(owner, name, vanishes)
    code, rows = run(tmp_path, "ab")
    assert code == FAILED and "r_3.png" in rows["a"]["message"]
    assert rows["b"]["code"] == DONE


def test_an_odd_stamp_in_the_scratch_is_not_stored(tmp_path: Path, scratch: Path) -> None:
    task, stored = stored_task(tmp_path)
    here = Scratch(stored)
    _, stamp = finished(here.run_dir / "scene", "x", "1")
    for odd in ({"files": 5}, {"files": {"sub/result.txt": 5}}, {"id": 5}):
        (here.run_dir / "scene/stamp.json").write_text(json.dumps(stamp | odd))
        here.push(task.stages)
        assert not (tmp_path / "store/runs").exists()
    assert run_task(task).code == DONE  # it was made anew
    assert list(Store(store_in(tmp_path)).stamps("a", task.stages)) == ["scene"]


def test_half_a_push_is_none(tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(url)
    folder, stamp = finished(tmp_path / "run/scene", "first", "1")
    store.push("a", folder, stamp)

    def cut(*arguments: object) -> None:
        raise OSError("the network is down")

    folder, stamp = finished(tmp_path / "run/scene", "second", "2")
    monkeypatch.setattr(store._fs, "pipe_file", cut)
    with refused("store-unreachable", url, "the network is down", kind=StoreError):
        store.push("a", folder, stamp)
    monkeypatch.undo()
    pull(store, "scene", tmp_path / "other")
    assert (tmp_path / "other/scene/sub/result.txt").read_text() == "first"
    store.push("a", folder, stamp)
    pull(store, "scene", tmp_path / "other")
    assert (tmp_path / "other/scene/sub/result.txt").read_text() == "second"
    assert len(store._list("runs/a/scene")) == 1  # what it replaced is gone


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
    with refused("store-file-missing" if damage is None else "store-file-damaged", url, kind=StoreError):
        pull(store, "scene", tmp_path / "other")
    assert not list((tmp_path / "other").iterdir())


def test_a_stamp_cannot_lead_out_of_the_stage(tmp_path: Path, url: str) -> None:
    store = Store(url)
    folder, stamp = finished(tmp_path / "run/scene", "x", "1")
    store.push("a", folder, stamp | {"files": {}})
    evil = stamp | {"files": {"../../../evil": [1, "0"]}}
    store._fs.pipe_file(store._path("runs/a/scene.json"), json.dumps(evil).encode())
    with refused("store-path-outside", "evil", kind=StoreError):
        pull(store, "scene", tmp_path / "other")


def test_an_input_is_fetched_once_and_checked(tmp_path: Path, scratch: Path) -> None:
    tiny_scene(tmp_path, "a")
    assert run(tmp_path, "a")[0] == DONE
    for file in (tmp_path / "store/inputs").iterdir():
        file.write_bytes(file.read_bytes()[:-1] + b"?")
    shutil.rmtree(tmp_path / "store/runs")
    code, rows = run(tmp_path, "a")
    assert code == FAILED
    assert all(w in rows["a"]["message"] for w in (f"{store_in(tmp_path)}/inputs/", "digest"))


def test_files_outside_of_the_scenes_folder_come_too(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a")
    (tmp_path / "a/data").rename(tmp_path / "elsewhere")
    scene.write_text(scene.read_text().replace("path: data", "path: ../elsewhere"))
    found = inputs_of(load_scene(scene), scene, Digests(tmp_path / "run"))
    assert found.overrides[0].startswith(f'dataset.path="{OUTSIDE}/')
    assert {Path(name).parts[0] for name in found.files} == {"scene.yaml", OUTSIDE}
    assert len(found.files) == 1 + 1 + 9


@pytest.mark.full
def test_a_data_set_beside_its_scene_file_comes(tmp_path: Path, scratch: Path) -> None:
    scene = tiny_scene(tmp_path, "a")
    for path in (tmp_path / "a/data").iterdir():
        path.rename(tmp_path / "a" / path.name)
    scene.write_text(scene.read_text().replace("path: data", "path: ."))  # as `simulate` writes it
    found = inputs_of(load_scene(scene), scene, Digests(tmp_path / "run"))
    assert len(found.files) == 1 + 1 + 9 and not found.overrides
    code, rows = run(tmp_path, "a")
    assert code == DONE, rows
    assert run(tmp_path, "a")[1]["a"]["nodes"] == []


def test_what_is_reached_through_a_link_comes_too(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a")
    (tmp_path / "a/data").rename(tmp_path / "a/disk")
    (tmp_path / "a/data").symlink_to("disk")
    (tmp_path / "truth.json").write_text("{}")
    (tmp_path / "a/ground_truth.json").symlink_to("../truth.json")
    found = inputs_of(load_scene(scene), scene, Digests(tmp_path / "run"))
    assert found.overrides == ['dataset.path="disk"']
    assert {Path(name).parts[0] for name in found.files} == {"scene.yaml", "disk", "ground_truth.json"}


@pytest.mark.parametrize(
    ("wrong", "refusal"),
    [
        ("nonsense://x", "store-protocol-unknown"),
        ("s3://", "store-protocol-unknown"),
        ("memory://", "store-without-folder"),
        ("file:///", "store-without-folder"),
        ("file:///proc/nope", "store-unwritable"),
        ("file://{}/file", "store-unwritable"),
    ],
)
def test_a_store_that_cannot_be_used_is_a_mistake_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: str, refusal: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(command, "look", lambda *arguments, **options: pytest.fail("looked"))
    with refused(refusal, f"--store {wrong.format(tmp_path)}: ", kind=InputError):
        run(tmp_path, "a", url=wrong.format(tmp_path))


def test_the_store_is_left_as_it_was_by_the_look_at_it(tmp_path: Path) -> None:
    Store(store_in(tmp_path)).check()
    assert not list((tmp_path / "store").iterdir())


def test_a_summary_that_cannot_be_made_is_a_mistake_of_the_command(tmp_path: Path) -> None:
    with refused("folder-unwritable", "--out /proc/x: ", kind=InputError):
        command.batch(Talk("quiet"), [tmp_path], Options(), command.Machines(), Path("/proc/x"), None)
