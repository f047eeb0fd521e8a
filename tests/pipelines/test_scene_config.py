"""scene.yaml: every mistake at once, each with its key, its value and what was expected."""

import json
import os
import re
import unicodedata
from pathlib import Path

import pytest
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import SceneConfig

GOOD = """
name: kuka
output: runs/kuka
preset: tiny
capture:
  static: static.mp4
  cameras: {cam0: cam0.mp4, cam1: cam1.mp4}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("static.mp4", "cam0.mp4", "cam1.mp4", "witness.mp4", "times.csv"):
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def load(folder: Path, text: str, overrides: tuple[str, ...] = ()) -> SceneConfig:
    (folder / "scene.yaml").write_text(text)
    return load_scene(folder / "scene.yaml", overrides)


def mistakes(folder: Path, text: str, overrides: tuple[str, ...] = ()) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load(folder, text, overrides)
    return list(caught.value.mistakes)


def test_good_file_and_its_defaults(folder: Path) -> None:
    config = load(folder, GOOD)
    assert config.kind == "dynamic"
    assert config.run_dir(folder) == (folder / "runs/kuka").resolve()
    assert config.evaluate.holdout_every == 8
    assert config.flow.method == "dis"
    assert config.capture is not None and config.capture.rest == "auto"
    assert config.reconstruct.image_scale is None  # chosen by the preset
    assert load(folder, GOOD + "evaluate: {lpips_weights: download}").evaluate.lpips_weights == "download"
    assert load(folder, "name: a\ncapture: {static: static.mp4}").run_dir(folder) == folder / "runs/a"


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("capture: {static: static.mp4}", "sweep"),
        ("capture: {cameras: {a: cam0.mp4}}\ncalibration: {rig: {given: times.csv}}", "cameras"),
        ("dataset: {format: devrf, path: .}", "dataset"),
    ],
)
def test_kinds_of_capture(folder: Path, text: str, kind: str) -> None:
    assert load(folder, f"name: x\n{text}").kind == kind


BOARD = "squares: [8, 6], square_m: 2, marker_m: 1"
JOINT = f"{{cameras: {{a: cam0.mp4}}, board: {{{BOARD}, clips: {{static: cam1.mp4}}, joint_clips: {{a: cam0.mp4}}}}}}"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("reconstruct: {resolutoin: 160}", "reconstruct.resolutoin: … resolution?"),
        ("reconstrct: {}", "reconstrct: … reconstruct?"),
        ("calibration: {sync: {av_lag_s: 0.02}}", "calibration.sync.av_lag_s: 0.02; "),
        ("calibration: {sync: {av_lag_s: {cam9: 0.02}}}", "calibration.sync.av_lag_s.cam9: "),
        ("calibration: {rig: {given: 3}}", "calibration.rig.given: 3; "),
        ("reconstruct: {rays: 3}", "reconstruct.rays: 3; … 64"),
        ("reconstruct: {rays: many}", "reconstruct.rays: 'many'; "),
        ("reconstruct: {rays: 100.5}", "reconstruct.rays: 100.5; "),
        ("reconstruct: {image_scale: .nan}", "reconstruct.image_scale: nan; "),
        ("reconstruct: {seed: true}", "reconstruct.seed: True; "),
        ("flow: {method: raft}", "flow: weights … method raft"),
        ("flow: {method: farneback}", "flow: method 'farneback' … dis, raft"),
        ("flow: {weights: static.mp4}", "flow: weights 'static.mp4' "),
        ("flow: {method: raft, weights: gone.pth}", "flow.weights: 'gone.pth': "),
        ("calibration: {sync: {method: sound}}", "calibration.sync.method: 'sound'; "),
        ("calibration: {rig: {method: given}}", "calibration.rig.given: "),
        ("calibration: {rig: {method: board}}", "capture.board.joint_clips: "),
        ("calibration: {rig: {given: rig.json}}", "calibration.rig.given: 'rig.json': "),
        ("evaluate: [8]", "evaluate: [8]; … holdout_every"),
        ("evaluate: {lpips_weights: downlod}", "evaluate.lpips_weights: 'downlod': "),
        ("budget: {memory_gb: 0}", "budget.memory_gb: 0; "),
        ("dataset: {format: devrf, path: .}", "capture: … dataset"),
        ("output: static.mp4", "output: 'static.mp4' … capture.static"),
    ],
)
def test_one_mistake(folder: Path, line: str, expected: str) -> None:
    text = GOOD.replace("output: runs/kuka", "") if line.startswith("output") else GOOD
    (found,) = mistakes(folder, text + line)
    first, _, then = expected.partition("… ")  # between them words
    assert found.startswith(f"scene.yaml: {first}") and then in found, found


@pytest.mark.parametrize(
    ("capture", "expected"),
    [
        ("{static: statik.mp4}", "capture.static: 'statik.mp4': "),
        ("{cameras: {cam0: cam0.mp4}}", "capture.static: "),
        ("{static: static.mp4, cameras: {cam0: gone.mp4}}", "capture.cameras.cam0: 'gone.mp4'"),
        ("{static: static.mp4, cameras: {0: cam0.mp4}}", "capture.cameras.0: … 0 "),
        ("{static: static.mp4, cameras: {a/b: cam0.mp4}}", "capture.cameras: 'a/b'"),
        ("{static: static.mp4, cameras: {static: cam0.mp4}}", "capture.cameras: 'static' "),
        ("{static: static.mp4, cameras: {a: cam0.mp4, A: cam1.mp4}}", "capture.cameras: 'a' and 'A'"),
        ("{static: static.mp4, cameras: {a: cam0.mp4, b: cam0.mp4}}", "capture.cameras: 2 of them"),
        ("{static: static.mp4, cameras: {a: cam0.mp4}, test_cameras: [b]}", "capture.test_cameras.b: "),
        ("{static: static.mp4, cameras: {a: cam0.mp4}, test_cameras: [a]}", "capture.cameras: … test camera"),
        ("{static: static.mp4, test_cameras: {a: cam0.mp4}}", "capture.cameras: … test camera"),
        ("{static: static.mp4, range_s: [3, 1]}", "capture.range_s: [3.0, 1.0]; "),
        ("{static: static.mp4, range_s: [3]}", "capture.range_s: [3]; "),
        ("{static: static.mp4, mattes: matts}", "capture.mattes.folder: 'matts': "),
        ("{static: static.mp4, mattes: background}", "capture.mattes.method: … FOLDER"),
        ("{static: static.mp4, mattes: {method: command}}", "capture.mattes.method: … FOLDER"),
        ("{static: static.mp4, mattes: {method: chroma, timeout_s: 9}}", "capture.mattes.timeout_s: … FOLDER"),
        ("{static: static.mp4, mattes: {method: chroma, command: [a]}}", "capture.mattes.command: … FOLDER"),
        ("{static: static.mp4, mattes: {method: keying}}", "capture.mattes.method: 'keying'; "),
        ("{static: static.mp4, mattes: {method: given}}", "capture.mattes: folder "),
        ("{static: static.mp4, mattes: {method: chroma, inverted: true}}", "capture.mattes: inverted … chroma"),
        ("{static: static.mp4, mattes: {method: chroma, colour: green}}", "capture.mattes.colour: 'green'; "),
        ("{static: static.mp4, mattes: {method: chroma, color: auto}}", "capture.mattes.color: … colour?"),
        ("{static: static.mp4, mattes: 3}", "capture.mattes: 3; … method"),
        ("{static: static.mp4, board: {squares: [8, 6]}}", "capture.board: square_m … charuco"),
        ("{static: static.mp4, board: {squares: [8, 6], square_m: 1}}", "capture.board: marker_m … charuco"),
        ("{static: static.mp4, board: {squares: [1, 6], square_m: 2, marker_m: 1}}", "capture.board.squares: [1, 6]; "),
        (f"{{static: static.mp4, board: {{{BOARD}, dictionary: 5X5}}}}", "capture.board.dictionary: '5X5'; "),
        (f"{{static: static.mp4, board: {{{BOARD}, type: aruco_grid}}}}", "capture.board: separation_m … aruco_grid"),
        (
            f"{{static: static.mp4, board: {{{BOARD}, type: aruco_grid, separation_m: 1}}}}",
            "capture.board: square_m … aruco_grid",
        ),
        (
            "{static: static.mp4, board: {squares: [8, 6], square_m: 1, marker_m: 2}}",
            "capture.board: marker_m 2.0 … square_m 1.0",
        ),
        (
            f"{{static: static.mp4, cameras: {{cam0: cam0.mp4}}, board: {{{BOARD}, clips: {{cam1: cam1.mp4}}}}}}",
            "capture.board.clips.cam1: … cam0?",
        ),
        (JOINT, "capture.board.clips.static: "),
        (JOINT.replace("clips: {static: cam1.mp4}, ", "").replace("{a:", "{b: cam1.mp4, a:", 1),
         "capture.board.joint_clips: … b"),
        ("{static: static.mp4, raw: {white_balance: [2, 1, 0, 1]}}", "capture.raw.white_balance: [2, 1, 0, 1]; "),
        ("{static: static.mp4, raw: {white_balance: camera}}", "capture.raw.white_balance: 'camera'; … 'auto'"),
        ("{}", "capture: … static"),
        ("null", "capture: … dataset"),
    ],
)  # fmt: skip
def test_one_mistake_in_capture(folder: Path, capture: str, expected: str) -> None:
    (found,) = mistakes(folder, f"name: x\ncapture: {capture}")
    first, _, then = expected.partition("… ")  # between them words
    assert found.startswith(f"scene.yaml: {first}") and then in found, found


@pytest.mark.parametrize("key", [key for key in GONE if " " not in key])
def test_keys_that_are_gone_are_named_so(folder: Path, key: str) -> None:
    """As one mistake; a name in the table is no key."""
    needed = ("capture.mattes.method=chroma",) if key.startswith("capture.mattes.") else ()
    (found,) = mistakes(folder, GOOD, (*needed, f"{key}=1"))
    assert found.startswith(f"--set {key}: ") and found.endswith(GONE[key])


def test_every_mistake_at_once(folder: Path) -> None:
    found = mistakes(
        folder,
        """
outptu: runs/x
preset: tinny
capture: {static: gone.mp4, cameras: {cam0: cam0.mp4, cam1: gone1.mp4}, test_cameras: [cam9]}
reconstruct: {resolutoin: 160, rays: 3}
flow: {method: raft, preset: fast}
calibration: {static_poses: {check_seed: true, time_minutes: 5}}
""",
        ("evaluate.holdout=3", "nonsense"),
    )
    keys = "name outptu preset capture.static capture.cameras.cam1 capture.test_cameras.cam9 reconstruct.resolutoin"
    keys += " reconstruct.rays flow flow.preset calibration.static_poses.check_seed"
    keys += " calibration.static_poses.time_minutes"
    told = {f"scene.yaml: {key}" for key in keys.split()}
    assert {":".join(line.split(":")[:2]) for line in found if line.startswith("scene.yaml")} == told
    assert any(re.fullmatch(r"--set evaluate.holdout: .* holdout_every\?", line) for line in found)
    assert any(line.startswith("--set nonsense: ") for line in found) and len(found) == 14


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: [1, 2\npreset: fast", "line 2"),
        ("name: a\nname: b", "scene.yaml: line 2, column 1: key 'name' … line 1"),
        ("reconstruct: {rays: 100, rays: 200}", "key 'rays' "),
        ("", "scene.yaml: … name"),
        ("- a\n- b", "scene.yaml: … list"),
        ("name: !!python/object:os.system x", "python/object"),
        ("\x00", "scene.yaml: "),
    ],
)
def test_not_a_scene_file(folder: Path, text: str, expected: str) -> None:
    found = mistakes(folder, text)
    assert len(found) == 1 and all(part in found[0] for part in expected.split("… ")), found


def test_missing_scene_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("name: x")
    with refused("configuration", "scen.yaml: ", " scene.yaml?", kind=InputError):
        load_scene(tmp_path / "scen.yaml")


def test_overrides_are_yaml(folder: Path) -> None:
    config = load(
        folder,
        GOOD,
        ("reconstruct.rays=4096", "capture.range_s=[0, 1.5]", "reconstruct.image_scale=5e-1", "preset=fast"),
    )
    assert config.reconstruct.rays == 4096
    assert config.reconstruct.image_scale == 0.5
    assert config.capture is not None and config.capture.range_s == (0, 1.5)
    assert config.preset == "fast"


def test_cameras_that_are_trained_on_come_first(folder: Path) -> None:
    found = load(folder, GOOD + "  test_cameras: [cam0]\n").capture
    assert found is not None and list(found.all_cameras)[-1] == "cam0"
    assert next(iter(found.all_cameras)) == next(iter(found.training_cameras)) != "cam0"


def test_test_cameras_as_names_or_clips(folder: Path) -> None:
    named = load(folder, GOOD + "  test_cameras: [cam1]\n").capture
    own = load(folder, GOOD + "  test_cameras: {witness: witness.mp4}\n").capture
    assert named is not None and own is not None
    assert named.test_names == ("cam1",) and list(named.training_cameras) == ["cam0"]
    assert own.test_names == ("witness",) and list(own.training_cameras) == ["cam0", "cam1"]
    assert list(own.all_cameras) == ["cam0", "cam1", "witness"]


@pytest.mark.parametrize(
    ("written", "expected"), [("auto", "auto"), ("shell", "shell"), ("[1, 0.5, 0]", (1.0, 0.5, 0.0))]
)
def test_background_of_a_data_set(tmp_path: Path, written: str, expected: object) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(f"name: x\ndataset: {{format: llff, path: ., background: {written}}}\n")
    data = load_scene(path).dataset
    assert data is not None and data.background == expected


@pytest.mark.parametrize("written", ["grey", "[1, 2, 3]", "[1, 0]", "[a, b, c]", "5", "null", "true"])
def test_a_background_that_is_none(tmp_path: Path, written: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(f"name: x\ndataset: {{format: colmap, path: ., background: {written}}}\n")
    with pytest.raises(ConfigError) as error:
        load_scene(path)
    assert str(error.value).startswith("scene.yaml: dataset.background: ") and len(error.value.mistakes) == 1


@pytest.mark.parametrize("key", ["output", "capture.static", "evaluate.truth", "flow.weights"])
@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("a\0b", " zero byte"),
        ("x" * 300, " 255 "),
        ("x/" * 600, " 1000 "),
        ("~nobody-of-this-name/x", "~"),
        ("\ud800", " half a character"),
    ],
)
def test_what_no_system_takes_as_a_path(folder: Path, key: str, text: str, named: str) -> None:
    lines = mistakes(folder, GOOD, (f"{key}={json.dumps(text)}",))
    assert any(key in line and named in line and len(line) < 300 for line in lines), lines


def test_devices_pipes_and_loops_are_no_files(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    for name, named in (("pipe", " pipe"), ("/dev/zero", " device"), ("loop", "symbolic link")):
        (found,) = mistakes(folder, GOOD, (f"capture.static={name}",))
        assert f"capture.static: '{name}'" in found and named in found


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_that_are_written_in_another_way(folder: Path, forms: tuple[str, str]) -> None:
    by_form = {
        "NFC": unicodedata.normalize("NFC", "café.mp4"),
        "NFD": unicodedata.normalize("NFD", "café.mp4"),
    }
    typed, stored = (by_form[form] for form in forms)
    (folder / stored).write_bytes(b"x")
    config = load(folder, GOOD, (f"capture.static={typed}",))
    assert config.capture is not None and config.path(folder, str(config.capture.static)).name == stored
