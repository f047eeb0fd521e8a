"""What messages and health rows propose can be done: keys, their values, options and commands are there."""

import ast
import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.bitstream
import av.filter
import numpy as np
import pytest
import yaml
from tests.capture.test_projection import MAKERS
from tests.conftest import REPOSITORY, Command
from tests.docs.test_pages import COMMANDS, OF_OTHERS, ROWS
from tests.test_messages import KEPT
from tests.test_wheel import ROOMS

from devrf.capture.photos.picture_files import write_png
from devrf.capture.projection import projection_of
from devrf.capture.video.video_writer import write_video
from devrf.pipelines.health.judge import entries

SECTIONS = "capture|dataset|calibration|flow|reconstruct|budget|evaluate"
KEY = re.compile(rf"\b(?:{SECTIONS})(?:\.[a-z_]+)+")
# "set KEY to a, b or c." or "KEY: a,"
VALUES = re.compile(
    rf"((?:{SECTIONS})(?:\.[a-z_]+)+)(?: to|:) ((?:[a-z0-9]+, )*[a-z0-9]+(?: or [a-z0-9]+)?)(?=[.;,)]|$)"
)
FILES = (".json", ".py", ".yaml", ".npz", ".toml")


def texts() -> Iterator[str]:
    """All that the program says where something is wrong."""
    for said in json.loads(KEPT.read_text("utf-8")).values():
        yield from said
    for entry in entries().values():
        yield from [entry.remedy] if isinstance(entry.remedy, str) else entry.remedy.values()


SAID = sorted(set(texts()))


def test_keys_exist() -> None:
    named = {key for text in SAID for key in KEY.findall(text) if not key.endswith(FILES)}
    known = {
        key
        for key in named
        if any(f"{row}.".startswith(f"{key}.") or key.startswith(f"{row}.") for row in ROWS)
    }
    assert named - known == set() and len(named) > 25


def test_values_are_allowed() -> None:
    tried = 0
    for text in SAID:
        for key, values in VALUES.findall(text):
            allowed = ROWS[key][0].replace("`", "")
            for value in re.split(", | or ", values):
                if re.fullmatch(r"[a-z, 0-9]+", allowed) and "," in allowed:
                    assert value in allowed.split(", "), f"{value} is no value of {key}: {text}"
                    tried += 1
    assert tried >= 6


def test_options_and_commands_exist() -> None:
    options = (
        {"--version", "--num-cpus", "--address", "--head", "--port", "--memory"}
        | OF_OTHERS
        | set().union(*COMMANDS.values())
    )
    assert {o for text in SAID for o in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)} <= options
    for text in SAID:
        for call in re.findall(r"`(devrf-pipeline [^`]+)`", text):
            name, *words = shlex.split(call)[1:]
            assert name in COMMANDS, text
            assert {w for w in words if w.startswith("--")} <= COMMANDS[name], text


@pytest.mark.parametrize("code", sorted(entries()))
def test_a_row_that_can_refuse_says_what_to_do(code: str) -> None:
    entry = entries()[code]
    fails = (entry.high or entry.low or (None, None))[1] is not None
    said = [entry.remedy] if isinstance(entry.remedy, str) else list(entry.remedy.values())
    assert not fails or all(len(text.split()) > 4 for text in said)


# --- applied to inputs: the message is gone, and nothing else is wrong ---

Scene = dict[str, Any]
Change = Callable[[Path, Scene], object]  # of the folder and of what scene.yaml says
TINY = {"name": "tiny", "output": "run", "preset": "tiny", "capture": {"static": "sweep.mp4"}}
CAMERAS = ("cam0", "cam1")


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep and two clips of noise, a second each."""
    folder, rng = tmp_path_factory.mktemp("clips"), np.random.default_rng(0)
    for name in ("sweep", *CAMERAS):
        write_video(folder / f"{name}.mp4", list(rng.integers(0, 255, (12, 48, 64, 3), dtype=np.uint8)), 10.0)
    return folder


def put(key: str, value: object) -> Change:
    """Write a key of scene.yaml."""

    def change(folder: Path, scene: Scene) -> None:
        *path, last = key.split(".")
        for part in path:
            scene = scene.setdefault(part, {})
        scene[last] = value

    return change


def drop(key: str) -> Change:
    """Take a key out of scene.yaml."""

    def change(folder: Path, scene: Scene) -> None:
        *path, last = key.split(".")
        for part in path:
            scene = scene[part]
        del scene[last]

    return change


def table(
    step: float = 0.1,
    names: tuple[str, ...] = CAMERAS,
    head: str = "camera,frame_index,time_s",
    encoding: str = "utf-8",
) -> Change:
    """Write capture.timestamps."""
    rows = [head, *(f"{name},{n},{n * step}" for name in names for n in range(12))]

    def change(folder: Path, scene: Scene) -> None:
        (folder / "times.csv").write_text("\n".join(rows), encoding)
        scene["capture"]["timestamps"] = "times.csv"

    return change


def rig(width: int = 64, height: int = 48, poses: bool = True, method: str = "auto") -> Change:
    """Write calibration.rig.given, in the place of a sweep."""
    K = [[60.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]]
    lens = {"model": "OPENCV", "image_size": [width, height], "K": K, "dist": [[0.0] * 5]}
    at = {n: {"R": np.eye(3).tolist(), "T": [0.1 * k, 0.0, 2.0]} for k, n in enumerate(CAMERAS)}
    content = {"cameras": dict.fromkeys(CAMERAS, lens), "camera_poses": at if poses else {}}

    def change(folder: Path, scene: Scene) -> None:
        (folder / "rig.json").write_text(json.dumps(content))
        scene["calibration"] = {"rig": {"given": "rig.json", "given_unit": "m", "method": method}}
        scene["capture"].pop("static", None)

    return change


def photos(*names: str) -> Change:
    """Write the sweep as a folder of photos; HEIC as phones begin it."""

    def change(folder: Path, scene: Scene) -> None:
        shutil.rmtree(folder / "photos", ignore_errors=True)
        (folder / "photos").mkdir()
        scene["capture"]["static"] = "photos"
        for n, name in enumerate(names):
            if name.endswith("heic"):
                (folder / "photos" / name).write_bytes(b"\0\0\0\x18ftypheic" + bytes(400))
            else:
                write_png(
                    folder / "photos" / name, np.random.default_rng(n).integers(0, 255, (48, 64), np.uint8)
                )

    return change


def mattes(*folders: str) -> Change:
    """Write folders of mattes."""

    def change(folder: Path, scene: Scene) -> None:
        shutil.rmtree(folder / "mattes", ignore_errors=True)
        for name in folders:
            (folder / "mattes" / name).mkdir(parents=True)
        scene["capture"]["mattes"] = "mattes"

    return change


def masks(*names: str) -> Change:
    """Write masks of the sweep."""

    def change(folder: Path, scene: Scene) -> None:
        (folder / "masks").mkdir(exist_ok=True)
        for name in names:
            write_png(folder / "masks" / name, np.full((48, 64), 255, np.uint8))
        put("calibration.static_poses.masks", "masks")(folder, scene)

    return change


def both(*changes: Change) -> Change:
    """One after the other."""

    def change(folder: Path, scene: Scene) -> None:
        for one in changes:
            one(folder, scene)

    return change


def spoiled(folder: Path, scene: Scene) -> None:
    (folder / "cam0.mp4").write_bytes(b"")


def copied_again(folder: Path, scene: Scene) -> None:
    shutil.copy(folder / "cam1.mp4", folder / "cam0.mp4")


def board(**more: object) -> Change:
    return put(
        "capture.board", {"type": "charuco", "squares": [5, 4], "square_m": 0.05, "marker_m": 0.03} | more
    )


SYNC, RIG = "calibration.sync.method", "calibration.rig.method"
HEIC, PNG = ([f"IMG_{n}.{kind}" for n in range(6)] for kind in ("heic", "png"))
# what is wrong, what is said of it, and what that asks for
APPLIED: dict[str, tuple[Change, str, Change]] = {
    "another name": (
        put("capture.cameras.cam1", "Cam2.mp4"),
        "no such file",
        put("capture.cameras.cam1", "cam1.mp4"),
    ),
    "unknown key": (
        put("reconstruct.resolutoin", 64),
        "did you mean resolution",
        put("reconstruct", {"resolution": 64}),
    ),
    "unknown value": (put("preset", "quick"), "'tiny', 'fast' or", put("preset", "fast")),
    "range turned round": (put("capture.range_s", [3, 0.5]), "from < to", put("capture.range_s", [0.5, 3])),
    "range beyond": (
        put("capture.range_s", [50, 53]),
        "0.00 to 1.10 s; change",
        put("capture.range_s", [0.0, 1.1]),
    ),
    "tested and trained": (
        put("capture.test_cameras", {"cam0": "cam0.mp4"}),
        "is in cameras too",
        drop("capture.cameras.cam0"),
    ),
    "silent, auto": (put(SYNC, "audio"), "set it to auto", put(SYNC, "auto")),
    "silent, flash": (put(SYNC, "audio"), "flash or motion", put(SYNC, "flash")),
    "silent, motion": (put(SYNC, "audio"), "flash or motion", put(SYNC, "motion")),
    "silent, a table": (put(SYNC, "audio"), "give capture.timestamps", both(table(), put(SYNC, "auto"))),
    "no timecode, a table": (put(SYNC, "timestamps"), "name a table", table()),
    "no timecode, auto": (put(SYNC, "timestamps"), "set the method to auto", put(SYNC, "auto")),
    "milliseconds": (table(100.0), "divide it by 1000", table()),
    "other columns": (table(head="cam,frame,time"), "expected camera, frame_index, time_s", table()),
    "other cameras": (table(names=("a", "b")), "use the names of capture.cameras", table()),
    "UTF-16": (table(encoding="utf-16"), "save it as UTF-8", table()),
    "no masks": (masks(), "named like the picture with .png", masks("000000.png")),
    "no matte of a camera": (mattes("static", "cam0"), "add them", mattes("static", *CAMERAS)),
    "no matte, no sweep's": (mattes("static", "cam0"), "or take static away", mattes("cam0")),
    "grey screen": (
        put("capture.mattes", {"method": "chroma", "colour": "#808a80"}),
        "expected a strong colour",
        put("capture.mattes", {"method": "chroma", "colour": "#00b140"}),
    ),
    "unknown dictionary": (
        board(dictionary="DICT_4x4_55"),
        "did you mean DICT_4X4_50",
        board(dictionary="DICT_4X4_50"),
    ),
    "board of nobody": (
        board(clips={"cam7": "cam1.mp4"}),
        "did you mean cam1",
        board(clips={"cam1": "cam1.mp4"}),
    ),
    "no sweep, a calibration": (drop("capture.static"), "calibration.rig.given", rig()),
    "no sweep, a sweep": (
        drop("capture.static"),
        "give one of the three",
        put("capture.static", "sweep.mp4"),
    ),
    "no joint clips": (put(RIG, "board"), "is missing; method: board", put(RIG, "auto")),
    "another shape": (rig(640, 300), "expected the same size", rig(640, 480)),
    "lenses alone": (
        rig(poses=False),
        "give a sweep (capture.static)",
        both(put("capture.static", "sweep.mp4"), put(RIG, "auto")),
    ),
    "empty": (spoiled, "copy it from the camera again", copied_again),
    "HEIC": (photos(*HEIC), "convert these to JPEG", photos(*PNG)),
    "one photo": (photos("a.png"), "many views", photos(*PNG)),
}


@pytest.mark.parametrize("case", APPLIED)
def test_what_is_proposed_leads_on(clips: Path, tmp_path: Path, devrf: Command, case: str) -> None:
    wrong, said, mend = APPLIED[case]
    folder, scene = tmp_path / "scene", json.loads(json.dumps(TINY))
    shutil.copytree(clips, folder)
    scene["capture"]["cameras"] = {name: f"{name}.mp4" for name in CAMERAS}
    for change, code in ((wrong, 2), (mend, 0)):
        change(folder, scene)
        (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
        done = devrf("run", folder / "scene.yaml", "--until", "ingest")
        assert done.code == code, done.said
        assert (said in done.err) == (code == 2)


# --- commands of ffmpeg: what FFmpeg's own libraries say of filters, and what they do ---

OF_INPUT = {"-r", "-framerate", "-itsscale", "-display_rotation", "-f"}  # with a value each, before -i
OF_OUTPUT = {"-c", "-vf", "-bsf:v", "-map", "-q:v", "-crf"}  # the same, after it
NUMBERS = {"-r", "-framerate", "-itsscale", "-display_rotation", "-q:v", "-crf"}


def commands_of_ffmpeg() -> set[str]:
    """Those of the table of health rows and of the sources, with 1 for what is filled in."""
    said = {text.replace("{flag}", "1") for text in SAID}
    for path in (path for room in ROOMS for path in (REPOSITORY / room).rglob("*.py")):
        source = path.read_text("utf-8")
        for node in ast.walk(ast.parse(source)) if "ffmpeg" in source else ():
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            said.add(
                "".join(
                    p.value if isinstance(p, ast.Constant) and isinstance(p.value, str) else "1"
                    for p in parts
                )
            )
    return {command for text in said for command in re.findall(r"`[^`]*?(ffmpeg [^`{]+)`", text)}


FFMPEG = sorted(commands_of_ffmpeg())


def options_of(command: str) -> tuple[dict[str, str], str]:
    """Options with their values, and the file that is written."""
    words = shlex.split(command)[1:]
    *words, out = words
    options = dict(zip(words[::2], words[1::2], strict=True))
    before = list(options)[: list(options).index("-i")]
    assert set(before) <= OF_INPUT and options.keys() - before <= {"-i"} | OF_OUTPUT, command
    return options, out


def filtered(graph: str, picture: np.ndarray) -> np.ndarray:
    """A picture behind `-vf`."""
    frame, made = av.VideoFrame.from_ndarray(picture, format="rgb24"), av.filter.Graph()
    name, _, values = graph.partition("=")
    frame.time_base = Fraction(1, 30)
    source = made.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
    )
    made.link_nodes(source, made.add(name, values), made.add("buffersink")).configure()
    for n in range(30):
        frame.pts = n
        made.push(frame)
    shown = made.pull()
    assert isinstance(shown, av.VideoFrame)
    return shown.to_ndarray(format="rgb24")


@pytest.mark.parametrize("command", FFMPEG)
def test_a_command_of_ffmpeg_says_what_ffmpeg_knows(command: str, clips: Path) -> None:
    options, out = options_of(command)
    assert out and ("-vf" not in options or "-c" not in options)  # filters code anew
    assert all(float(options[name]) >= 0 for name in NUMBERS & options.keys())
    if "-vf" in options:
        assert filtered(options["-vf"], np.zeros((64, 128, 3), np.uint8)).size
    if "-bsf:v" in options:
        with av.open(str(clips / "sweep.mp4")) as clip:
            into = av.bitstream.BitStreamFilterContext(options["-bsf:v"], clip.streams.video[0])
            assert any(into.filter(packet) for packet in clip.demux(video=0))
    assert options.get("-f", "mp4") in av.formats_available


def test_there_are_as_many_commands_of_ffmpeg() -> None:
    """So that one that is written in another way is not passed over."""
    assert len(FFMPEG) >= 9


@pytest.mark.parametrize("kind", ["equirectangular", "eyes"])
def test_what_is_cut_out_of_pictures_that_no_lens_makes_is_one_that_a_lens_makes(kind: str) -> None:
    remedy = entries()["coding"].remedy
    assert isinstance(remedy, dict)
    command = re.findall(r"`(ffmpeg [^`]+)`", remedy[kind])[0]
    pictures = [MAKERS[kind](n) for n in range(5)]
    assert projection_of([], pictures) == kind
    assert projection_of([], [filtered(options_of(command)[0]["-vf"], p) for p in pictures]) is None
