"""Where a run may write: its own folder, nothing of others in it, and nothing through links."""

import json
from pathlib import Path

import pytest
from tests.conftest import Command
from tests.refused import refused

from devrf.capture.formats.datasets import read_dataset, write_dataset
from devrf.capture.formats.parts.files import LONGEST_NAME, safe_name
from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import SceneConfig, is_camera_name
from devrf.pipelines.init.names import camera_name, words_of
from devrf.pipelines.run_folder.own_folder import check_run_folder
from devrf.pipelines.stages import stage_names
from devrf.pipelines.terminal.logs import Events


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene.yaml with two clips that are never opened."""
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def mistakes(scene: Path, text: str) -> str:
    (scene / "scene.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_scene(scene / "scene.yaml")
    return str(caught.value)


@pytest.mark.parametrize(
    "name",
    ["../evil", "/etc", "a/b", "..", ".", ".hidden", "a\\b", "-rf", "a b", "a\nb", "x" * 65, "№1", "static",
     "board_a", "joint_a", ""],
)  # fmt: skip
def test_names_of_cameras_become_folders(scene: Path, name: str) -> None:
    assert f"capture.cameras: {name!r} " in _of_cameras(scene, name)


def test_names_that_differ_only_in_case(scene: Path) -> None:
    assert "'cam' and 'Cam' " in _of_cameras(scene, "cam", "Cam")


def _of_cameras(scene: Path, *names: str) -> str:
    capture = {"static": "a.mp4", "cameras": dict.fromkeys(names, "b.mp4")}
    return mistakes(scene, json.dumps({"name": "x", "capture": capture}))


@pytest.mark.parametrize(
    ("output", "named"),
    [("/", "output: '/' "), ("~", "output: '~' "), ("photos", "capture.static"), ("a\0b", " zero byte")],
)
def test_outputs_that_are_something_else(scene: Path, output: str, named: str) -> None:
    (scene / "photos").mkdir()
    assert named in mistakes(
        scene, json.dumps({"name": "x", "output": output, "capture": {"static": "photos"}})
    )


@pytest.mark.parametrize("name", ["..", "../../x", ".", "a/../../b", "\0", "~"])
def test_the_scene_s_name_makes_a_folder_beside_it(scene: Path, name: str) -> None:
    (scene / "scene.yaml").write_text(json.dumps({"name": name, "capture": {"static": "a.mp4"}}))
    folder = load_scene(scene / "scene.yaml").run_dir(scene)
    assert folder.parent == scene / "runs" and folder.name not in ("", ".", "..")


def test_a_folder_of_others_is_not_replaced(tmp_path: Path) -> None:
    check_run_folder(tmp_path / "missing", stage_names())
    (tmp_path / "flow").mkdir()
    check_run_folder(tmp_path, stage_names())  # nothing in it
    (tmp_path / "flow" / "mine.npz").write_bytes(b"years of work")
    with refused("folder-exists", tmp_path, " flow ", "output", kind=InputError):
        check_run_folder(tmp_path, stage_names())
    (tmp_path / "flow" / "stamp.json").write_text("damaged, but a run's")
    check_run_folder(tmp_path, stage_names())
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "index.html").write_text("of a run that has not come to its end")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"no stage has this name")
    check_run_folder(tmp_path, stage_names())


@pytest.mark.parametrize(
    "name",
    [".flow/a", "logs/scene-x.log", "report/index.html", ".canonical.mine.safetensors", "events.jsonl", ".lock",
     ".failed-scene.json"],
)  # fmt: skip
def test_what_runs_replace_is_refused_where_no_run_has_worked(tmp_path: Path, name: str) -> None:
    """From the first run on, these names are the runs'."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    for free in (".new-ideas", ".git", "films", "photos"):
        (tmp_path / free).mkdir()
    with refused("folder-exists", tmp_path, f" {name.split('/')[0]} ", "output", kind=InputError):
        check_run_folder(tmp_path, stage_names())
    (tmp_path / "devrf.log").touch()
    check_run_folder(tmp_path, stage_names())


@pytest.mark.parametrize(
    "name", [".lock", "devrf.log", "events.jsonl", "ingest", ".flow/cam0", ".anything", "export"]
)
def test_links_are_not_written_through(scene: Path, devrf: Command, name: str) -> None:
    """A run folder that came from elsewhere: its links lead to files of the user's."""
    outside = scene / "outside"
    outside.mkdir()
    (outside / "precious").write_text("precious")
    target = outside if name in ("ingest", ".flow/cam0", "export") else outside / "precious"
    link = scene / "run" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(target)
    with refused("folder-holds-link", link, target, kind=InputError):
        check_run_folder(scene / "run", stage_names())
    if name in (".lock", "devrf.log"):
        (scene / "scene.yaml").write_text(
            json.dumps({"name": "x", "output": "run", "capture": {"static": "a.mp4"}})
        )
        result = devrf("run", scene, "--until", "ingest")
        assert result.code == 2 and f"{link} " in result.err and "[folder-holds-link]" in result.err, (
            result.said
        )
    assert [path.name for path in outside.iterdir()] == ["precious"]
    assert (outside / "precious").read_text() == "precious"


def test_rows_are_not_written_over_an_input(scene: Path, devrf: Command) -> None:
    text = json.dumps({"name": "x", "capture": {"static": "a.mp4"}})
    (scene / "scene.yaml").write_text(text)
    for name in ("scene.yaml", "b.mp4"):
        result = devrf("check", scene, "--json", scene / name)
        assert result.code == 2 and f"--json {scene / name}: " in result.err and "[file-exists]" in result.err
    assert (scene / "scene.yaml").read_text() == text and (scene / "b.mp4").read_bytes() == b"x"


def test_names_in_a_data_set_stay_names(tmp_path: Path, odd_scene: Scene) -> None:
    """They become folders of the flow and of exports."""
    write_dataset("nerfstudio", odd_scene, tmp_path / "set")
    path = tmp_path / "set" / "transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        if frame["camera"] != "static":
            frame["camera"] = {"cam0": "../../evil", "cam1": "/etc/" + "x" * 400, "witness": "\0\n"}[
                frame["camera"]
            ]
    path.write_text(json.dumps(meta))
    found = read_dataset("nerfstudio", tmp_path / "set")
    names = {frame.camera_name for frame in found.dynamic}
    assert len(names) == 3
    assert all(is_camera_name(name) and len(name) <= LONGEST_NAME for name in names)
    write_dataset("colmap", found, tmp_path / "out" / "again")
    write_dataset("nerfstudio", found, tmp_path / "out" / "more")
    made = {p.relative_to(tmp_path).parts[0] for p in tmp_path.rglob("*")}
    assert made == {"set", "out", "pictures"}


@pytest.mark.parametrize(
    ("one", "other"),
    [("кухня", "спальня"), ("台所", "寝室"), ("Küche", "Köche"), ("कक्ष", "काक्ष"), ("x" * 200, "x" * 199 + "y"),
     ("木" * 199 + "林", "木" * 200)],
)  # fmt: skip
def test_scenes_whose_names_differ_by_letters_have_a_folder_each(scene: Path, one: str, other: str) -> None:
    folders = []
    for n, name in enumerate((one, other)):
        path = scene / f"{n}.yaml"
        path.write_text(json.dumps({"name": name, "capture": {"static": "a.mp4"}}), encoding="utf-8")
        folders.append(load_scene(path).run_dir(scene))
        folders[-1].mkdir(parents=True)
    assert folders[0] != folders[1] and folders[0].parent == folders[1].parent == scene / "runs"


def test_names_that_were_good_for_folders_stay_them(scene: Path) -> None:
    for name, folder in (("my room 2", "my_room_2"), ("a/b", "a_b"), ("x.y-z_", "x.y-z_"), ("a_ b", "a__b")):
        config = SceneConfig.model_validate({"name": name, "capture": {"static": "a.mp4"}})
        assert config.folder_name == folder


def test_a_folder_that_two_names_make_is_its_first_scene_s(scene: Path, devrf: Command) -> None:
    """A remedy that is a key: applied, the scene has a folder of its own."""
    config = {"name": "room/1", "capture": {"static": "a.mp4"}}
    (scene / "other.yaml").write_text(json.dumps(config | {"name": "room 1"}))
    folder = scene / "runs" / "room_1"
    folder.mkdir(parents=True)
    Events(folder, "first").write("run_started", scene="room 1")
    (folder / "devrf.log").touch()
    path = scene / "scene.yaml"
    for name, tried, refused_as in (
        ("as it is", config, "folder-of-another"),
        ("output", config | {"output": "runs/second"}, "inputs-unusable"),  # a.mp4 is no clip
        ("its own", config | {"name": "room 1"}, "inputs-unusable"),
    ):
        path.write_text(json.dumps(tried))
        done = devrf("run", path)
        assert done.code == 2 and f"[{refused_as}]" in done.err, name
        assert ("'room 1'" in done.err and "output" in done.err) == (name == "as it is")


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("левая.mp4", "левая"),
        ("правая камера.mp4", "правая_камера"),
        ("カメラ1/clip.mp4", "clip"),
        ("!!.mp4", "cam"),
    ],
)
def test_init_calls_cameras_as_their_files(name: str, camera: str) -> None:
    assert camera_name(name, set()) == camera and is_camera_name(camera)
    assert camera_name(name, {camera}) != camera


def test_a_board_clip_is_known_by_its_camera_s_name_in_any_alphabet() -> None:
    assert words_of("доска_левая.mp4") == ["доска", "левая"] == [*words_of("доска"), *words_of("левая")]


def test_cameras_of_data_sets_whose_names_are_of_another_alphabet_stay_two() -> None:
    assert safe_name("левая") == "левая" != safe_name("правая") and safe_name("a b/c") == "a_b_c"
