"""scene.yaml: every mistake at once, each with its key, its value and what was expected."""

import json
import os
from pathlib import Path

import pytest

from devrf.capture.errors import InputError
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
    assert config.capture is not None and config.capture.rest == "start"
    assert config.reconstruct.image_scale is None  # chosen by the preset
    assert load(folder, "name: a\ncapture: {static: static.mp4}").run_dir(folder) == folder / "runs/a"


def test_lpips_weights_are_a_folder_or_a_download(folder: Path) -> None:
    assert load(folder, GOOD + "evaluate: {lpips_weights: download}").evaluate.lpips_weights == "download"
    assert "no such file or folder" in mistakes(folder, GOOD + "evaluate: {lpips_weights: downlod}")[0]


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


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("reconstruct: {resolutoin: 160}", "reconstruct.resolutoin: unknown key, did you mean resolution?"),
        ("reconstrct: {}", "reconstrct: unknown key, did you mean reconstruct?"),
        (
            "calibration: {sync: {av_lag_s: 0.02}}",
            "calibration.sync.av_lag_s: 0.02; expected names with a number each ({cam0: 0.02})",
        ),
        (
            "calibration: {rig: {given: 3}}",
            "calibration.rig.given: 3; expected a path or names with a path each",
        ),
        ("reconstruct: {rays: 3}", "reconstruct.rays: 3; expected a whole number from 64 to 1048576"),
        ("reconstruct: {rays: many}", "reconstruct.rays: 'many'; expected a whole number from 64 to 1048576"),
        ("reconstruct: {rays: 100.5}", "reconstruct.rays: 100.5; expected a whole number from 64 to 1048576"),
        (
            "reconstruct: {image_scale: .nan}",
            "reconstruct.image_scale: nan; expected a number from 0.02 to 1",
        ),
        (
            "reconstruct: {seed: true}",
            "reconstruct.seed: True; expected a whole number from 0 below 2147483648",
        ),
        ("flow: {method: raft}", "flow: weights is missing; method raft needs"),
        ("flow: {method: farneback}", "flow: method 'farneback' is not known, expected dis, raft"),
        ("flow: {weights: static.mp4}", "flow: weights 'static.mp4' are of no use; method dis needs none"),
        ("flow: {method: raft, weights: gone.pth}", "flow.weights: 'gone.pth': no such file or folder"),
        (
            "calibration: {sync: {method: sound}}",
            "calibration.sync.method: 'sound'; expected auto, audio, motion, flash, timestamps, none",
        ),
        (
            "calibration: {sync: {method: timestamps}}",
            "capture.timestamps: is missing; sync.method: timestamps needs the CSV file",
        ),
        (
            "calibration: {rig: {given: rig.json}}",
            "calibration.rig.given: 'rig.json': no such file or folder",
        ),
        ("evaluate: [8]", "evaluate: [8]; expected a section with the keys holdout_every"),
        ("budget: {memory_gb: 0}", "budget.memory_gb: 0; expected a number above 0"),
        ("dataset: {format: devrf, path: .}", "capture: does not go with dataset; remove one of them"),
    ],
)
def test_one_mistake(folder: Path, line: str, expected: str) -> None:
    found = mistakes(folder, GOOD + line)
    assert len(found) == 1
    assert found[0].startswith(f"scene.yaml: {expected}"), found[0]


@pytest.mark.parametrize(
    ("capture", "expected"),
    [
        ("{static: statik.mp4}", "capture.static: 'statik.mp4': no such file or folder"),
        ("{static: statik.mp4}", "did you mean static.mp4?"),
        ("{cameras: {cam0: cam0.mp4}}", "capture.static: is missing, and without a sweep"),
        ("{static: static.mp4, cameras: {cam0: gone.mp4}}", "capture.cameras.cam0: 'gone.mp4'"),
        ("{static: static.mp4, cameras: {0: cam0.mp4}}", "the key 0 is a number; names are text"),
        ("{static: static.mp4, cameras: {a/b: cam0.mp4}}", "'a/b' cannot be a camera's name"),
        ("{static: static.mp4, cameras: {static: cam0.mp4}}", "'static' is a name that the run folder needs"),
        ("{static: static.mp4, cameras: {a: cam0.mp4, b: cam0.mp4}}", "a, b name the same file"),
        ("{static: static.mp4, cameras: {a: cam0.mp4}, test_cameras: [b]}", "'b' is not in cameras"),
        ("{static: static.mp4, cameras: {a: cam0.mp4}, test_cameras: [a]}", "every camera is a test camera"),
        ("{static: static.mp4, test_cameras: {a: cam0.mp4}}", "every camera is a test camera"),
        ("{static: static.mp4, range_s: [3, 1]}", "capture.range_s: [3.0, 1.0]; expected [from, to]"),
        ("{static: static.mp4, range_s: [3]}", "capture.range_s: [3]; expected a list of two numbers"),
        ("{static: static.mp4, mattes: matts}", "capture.mattes.folder: 'matts': no such file or folder"),
        ("{static: static.mp4, mattes: chrome}", "; or one of chroma, background"),
        (
            "{static: static.mp4, mattes: {method: command, command: a b}}",
            "capture.mattes.command: 'a b'; expected a list of texts",
        ),
        ("{static: static.mp4, mattes: background}", "capture.mattes: background needs fixed cameras"),
        ("{static: static.mp4, mattes: {method: keying}}", "capture.mattes.method: 'keying'; expected given"),
        ("{static: static.mp4, mattes: {method: given}}", "capture.mattes: folder is missing; method: given"),
        ("{static: static.mp4, mattes: {method: command}}", "capture.mattes: command is missing"),
        (
            "{static: static.mp4, mattes: {method: chroma, command: [a]}}",
            "capture.mattes: command is for method: command, and the method is chroma",
        ),
        (
            "{static: static.mp4, mattes: {method: chroma, colour: green}}",
            "capture.mattes.colour: 'green'; expected",
        ),
        ("{static: static.mp4, mattes: {method: chroma, color: auto}}", "unknown key, did you mean colour?"),
        ("{static: static.mp4, mattes: 3}", "capture.mattes: 3; expected a section with the keys method"),
        ("{static: static.mp4, board: {squares: [8, 6]}}", "capture.board: square_m is missing"),
        (
            "{static: static.mp4, board: {type: aruco_grid, squares: [8, 6], marker_m: 0.04}}",
            "capture.board: separation_m is missing; a board of type aruco_grid needs the gap between them",
        ),
        (
            "{static: static.mp4, board: {type: aruco_grid, squares: [8, 6], marker_m: 0.04, "
            "separation_m: 0.01, square_m: 0.05}}",
            "capture.board: square_m is not for a board of type aruco_grid; it needs marker_m and separation_m",
        ),
        ("{static: static.mp4, board: {squares: [8, 6], square_m: 1}}", "capture.board: marker_m is missing"),
        (
            "{static: static.mp4, board: {squares: [8, 6], square_m: 1, marker_m: 2}}",
            "capture.board: marker_m 2.0 is not smaller than square_m 1.0",
        ),
        (
            "{static: static.mp4, cameras: {cam0: cam0.mp4}, "
            "board: {squares: [8, 6], square_m: 2, marker_m: 1, clips: {cam1: cam1.mp4}}}",
            "capture.board.clips.cam1: no camera has this name, did you mean cam0?",
        ),
        (
            "{cameras: {a: cam0.mp4}, board: {squares: [8, 6], square_m: 2, marker_m: 1, clips: {static: cam1.mp4}, "
            "joint_clips: {a: cam0.mp4}}}",
            "capture.board.clips.static: is of the sweep's camera; give capture.static, or remove it",
        ),
        (
            "{cameras: {a: cam0.mp4}, white: {static: cam1.mp4}}",
            "capture.white.static: is of the sweep's camera; give capture.static, or remove it",
        ),
        (
            "{static: static.mp4, cameras: {cam0: cam0.mp4}, white: {cam1: cam1.mp4}}",
            "capture.white.cam1: no camera has this name, did you mean cam0?",
        ),
        (
            "{static: static.mp4, raw: {white_balance: [2, 1, 0, 1]}}",
            "capture.raw.white_balance: [2, 1, 0, 1]; expected auto or [r, g, b, g2] with numbers above 0",
        ),
        (
            "{static: static.mp4, raw: {white_balance: camera}}",
            "capture.raw.white_balance: 'camera'; expected auto or",
        ),
        ("{}", "capture: names no material"),
        ("null", "capture: is missing"),
    ],
)
def test_one_mistake_in_capture(folder: Path, capture: str, expected: str) -> None:
    found = mistakes(folder, f"name: x\ncapture: {capture}")
    assert any(expected in line for line in found), found


@pytest.mark.parametrize("key", GONE)
def test_keys_that_are_gone_are_named_so(folder: Path, key: str) -> None:
    """As one mistake; a name in the table is no key."""
    assert mistakes(folder, GOOD, (f"{key}=1",)) == [f"--set {key}: {GONE[key]}"]


def test_every_mistake_at_once(folder: Path) -> None:
    found = mistakes(
        folder,
        """
outptu: runs/x
preset: tinny
capture: {static: gone.mp4, cameras: {cam0: cam0.mp4, cam1: gone1.mp4}, test_cameras: [cam9]}
reconstruct: {resolutoin: 160, rays: 3}
flow: {method: raft, preset: fast}
calibration: {static_poses: {check_seed: true}}
""",
        ("evaluate.holdout=3", "nonsense"),
    )
    text = "\n".join(found)
    for part in (
        "scene.yaml: name: is missing",
        "scene.yaml: outptu: unknown key, did you mean output?",
        "scene.yaml: preset: 'tinny'; expected tiny, fast, reference, did you mean tiny?",
        "scene.yaml: capture.static: 'gone.mp4'",
        "scene.yaml: capture.cameras.cam1: 'gone1.mp4'",
        "scene.yaml: capture.test_cameras: 'cam9' is not in cameras, did you mean cam1?",
        "scene.yaml: reconstruct.resolutoin: unknown key",
        "scene.yaml: reconstruct.rays: 3",
        "scene.yaml: flow: weights is missing",
        f"scene.yaml: flow.preset: is no longer a key: {GONE['flow.preset']}",
        "scene.yaml: calibration.static_poses.check_seed: is no longer a key",
        "--set evaluate.holdout: unknown key, did you mean holdout_every?",
        "--set nonsense: expected key=value",
    ):
        assert part in text, f"{part!r} not in\n{text}"
    assert len(found) == 13


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: [1, 2\npreset: fast", "line 2"),
        ("name: a\nname: b", "scene.yaml: line 2, column 1: key 'name' is given twice (first in line 1)"),
        ("reconstruct: {rays: 100, rays: 200}", "key 'rays' is given twice"),
        ("", "scene.yaml: is empty"),
        ("- a\n- b", "scene.yaml: holds a list"),
        ("name: !!python/object:os.system x", "could not determine a constructor"),
        ("\x00", "scene.yaml: "),
    ],
)
def test_not_a_scene_file(folder: Path, text: str, expected: str) -> None:
    found = mistakes(folder, text)
    assert len(found) == 1 and expected in found[0], found


def test_missing_scene_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("name: x")
    with pytest.raises(InputError, match="scen.yaml: no such file, did you mean scene.yaml?"):
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


def test_test_cameras_as_names_or_clips(folder: Path) -> None:
    named = load(folder, GOOD + "  test_cameras: [cam1]\n").capture
    own = load(folder, GOOD + "  test_cameras: {witness: witness.mp4}\n").capture
    assert named is not None and own is not None
    assert named.test_names == ("cam1",) and list(named.training_cameras) == ["cam0"]
    assert own.test_names == ("witness",) and list(own.training_cameras) == ["cam0", "cam1"]
    assert list(own.all_cameras) == ["cam0", "cam1", "witness"]


def test_every_field_is_described() -> None:
    """A key without a docstring line is a key nobody can look up."""
    import ast
    import inspect

    from devrf.pipelines.config import scene as scene_config

    tree = ast.parse(inspect.getsource(scene_config))
    for section in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        for here, following in zip(section.body, [*section.body[1:], None], strict=True):
            if isinstance(here, ast.AnnAssign):
                described = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                assert described, f"{section.name}.{ast.unparse(here.target)} has no docstring line"


@pytest.mark.parametrize(
    ("written", "expected"),
    [("auto", "auto"), ("shell", "shell"), ("[1, 0.5, 0]", (1.0, 0.5, 0.0))],
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
    assert "scene.yaml: dataset.background: " in str(error.value)
    assert "auto, white, black, shell or [r, g, b]" in str(error.value)


@pytest.mark.parametrize(
    "key", ["output", "capture.static", "cache.folder", "evaluate.truth", "flow.weights"]
)
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a\0b", "holds a zero byte"),
        ("x" * 300, "longer than 1000 characters, or a name in it than 255 bytes"),
        ("x/" * 600, "longer than 1000 characters"),
        ("~nobody-of-this-name/x", "no such user"),
        ("\ud800", "holds half a character"),
    ],
)
def test_what_no_system_takes_as_a_path(folder: Path, key: str, text: str, says: str) -> None:
    lines = mistakes(folder, GOOD, (f"{key}={json.dumps(text)}",))
    assert any(key in line and says in line and len(line) < 300 for line in lines), lines


def test_devices_pipes_and_loops_are_no_files(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    for name, says in (
        ("pipe", "is a device or a pipe"),
        ("/dev/zero", "is a device"),
        ("loop", "cannot be read"),
    ):
        assert says in mistakes(folder, GOOD, (f"capture.static={name}",))[0]
