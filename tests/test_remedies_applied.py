"""Remedies of refusals, applied: with what a message proposes, the same input goes on without that message.

Every code whose text proposes a key, an option or a command stands in one of two lists: with the tests that apply it,
or with the reason why none does.
"""

import json
import re
import shutil
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import av
import numpy as np
import pytest
import yaml
from tests.conftest import Command
from tests.docs.test_neighbours import names_in
from tests.lab.test_simulate_command import CUT
from tests.make.clips import film as write_film
from tests.make.datasets import write_set
from tests.make.models import moving_ball
from tests.pipelines.compare_folders import CAMERA, write_two_runs
from tests.pipelines.film_folder import write_ball_run
from tests.pipelines.test_compare import found_of
from tests.pipelines.test_film import film
from tests.pipelines.trained_run import write_trained
from tests.refused import refused
from tests.test_messages import KEPT
from tests.test_remedies import (
    CAMERAS,
    KEY,
    TINY,
    Change,
    Scene,
    both,
    clips,
    drop,
    photos,
    put,
    rig,
    table,
)

from devrf.capture.formats import read_dataset
from devrf.capture.formats.parts.scene_files import OWN_KEY
from devrf.capture.scene import Scene as WholeScene
from devrf.lab.bench.training import methods
from devrf.lab.methods.protocol import Method, MethodTask, TimeBudget, TrainedModel
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.pipelines.budget import memory
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.run_folder.lock import Lock
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.viewer.command import _check_free
from devrf.pipelines.viewer.own_address import Address

__all__ = ["clips"]  # a fixture

HERE, SESSIONS = "tests/test_remedies_applied.py", "tests/test_remedies.py::test_what_is_proposed_leads_on"
LATER = f"{HERE}::test_what_is_proposed_leads_on_in_later_stages"
FILMS, EXPORTS = f"{HERE}::test_films_with_what_is_proposed", f"{HERE}::test_exports_with_what_is_proposed"
COMPARED, LISTENS = f"{HERE}::test_runs_of_one_scene_are_compared", f"{HERE}::test_an_address_that_is_free"
RUNS, SETS = f"{HERE}::test_a_run_that_was_not_made", f"{HERE}::test_data_sets_with_what_is_proposed"
METHODS, SIMULATED = f"{HERE}::test_methods_that_can_do_it", f"{HERE}::test_simulations_that_can_be"
APPLIED = {  # code -> the test that applies what it proposes
    "board-dictionary-unknown": SESSIONS,
    "camera-missing": SESSIONS,
    "camera-unknown": FILMS,
    "camera-without-frames": LATER,
    "clip-slow-motion": f"{HERE}::test_a_clip_in_slow_motion_is_given_its_times",
    "compare-no-common-view": COMPARED,
    "count-mismatch": "tests/pipelines/test_init.py::test_clips_with_poses_of_llff_are_fixed_cameras",
    "file-damaged": COMPARED,
    "file-exists": f"{HERE}::test_init_with_force",
    "file-missing": SETS,
    "film-needs-memory": f"{HERE}::test_a_film_that_fits",
    "film-other-shape": FILMS,
    "film-sides-odd": FILMS,
    "film-too-long": FILMS,
    "folder-busy": f"{HERE}::test_beside_another_run",
    "folder-exists": FILMS,
    "folder-missing": SETS,
    "folder-unwritable": FILMS,
    "gpu-missing": LATER,
    "host-elsewhere": LISTENS,
    "host-unknown": LISTENS,
    "key-colour-unfound": "tests/capture/test_mattes.py::test_no_screen_is_named",
    "metrics-without-views": COMPARED,
    "model-without-surface": f"{HERE}::test_a_surface_at_another_level",
    "option-malformed": FILMS,
    "option-misplaced": EXPORTS,
    "option-out-of-range": EXPORTS,
    "option-unknown-value": FILMS,
    "out-of-time": "tests/pipelines/test_budget_running.py::test_a_run_without_time_ends_between_stages_and_goes_on",
    "package-missing": f"{HERE}::test_an_extra_that_is_there",
    "page-too-large": EXPORTS,
    "picture-missing": SETS,
    "pictures-none": LATER,
    "picture-unreadable": LATER,
    "method-unfit": METHODS,
    "regime-unknown": METHODS,
    "options-contradict": SIMULATED,
    "scene-unknown": SIMULATED,
    "port-unusable": LISTENS,
    "range-empty": LATER,
    "rig-without-poses": LATER,
    "rig-without-source": SESSIONS,
    "run-missing": RUNS,
    "run-unfinished": COMPARED,
    "scene-without-motion": FILMS,
    "sound-missing": SESSIONS,
    "stage-not-made": LATER,
    "stage-unhealthy": LATER,
    "sweep-missing": LATER,
    "stream-without-times": f"{HERE}::test_a_raw_stream_is_put_into_a_container",
}
A_TRAINING, A_CLUSTER = "needs a training, minutes", "needs a cluster with other machines"
NOT_APPLIED = {  # code -> why
    "cameras-share-no-time": "check of capture.range_s, which is applied under range-empty; needs a whole rig",
    "cluster-unreachable": A_CLUSTER,
    "cluster-without-gpu": A_CLUSTER,
    "cluster-without-memory": A_CLUSTER,
    "estimator-result-wrong": "is about code that somebody wrote: it is told what it gave and what is expected",
    "method-unusable": "is about code that somebody wrote",
    "test-camera-missing": A_TRAINING,
    "no-memory": "needs a machine whose memory is used up",
    "session-outdated": "needs a rendering, a minute",
    "subject-not-found": A_TRAINING,
    "training-diverged": A_TRAINING,
    "file-unreadable": "needs a file that may not be read, which nothing hides from an administrator",
    "times-missing": "raw streams are refused before, as stream-without-times; of other clips it needs a camera's",
    "rig-given-untied": "needs a sweep that is registered, a minute",
    "rig-unlinked-camera": "needs a sweep that is registered, a minute",
    "weights-missing": "needs weights that are not in the repository",
    "weights-wrong": "needs weights that are not in the repository",
}
OPTION_OR_COMMAND = re.compile(r"(?<![\w-])--[a-z][a-z-]+|`[^`{]+`|devrf-pipeline [a-z]+")


def proposed(text: str) -> bool:
    """Whether a text names a key, an option or a command, outside of what is filled in."""
    said = re.sub(r"\{[^{}]*\}", "", text)
    keys = [key for key in KEY.findall(said) if not key.startswith("flow.weights")]
    return bool(keys or OPTION_OR_COMMAND.search(said))


def test_each_code_that_proposes_something_is_applied_or_says_why_not() -> None:
    kept = json.loads(KEPT.read_text("utf-8"))
    found = {code for code, texts in kept.items() if any(map(proposed, texts))}
    assert found - APPLIED.keys() - NOT_APPLIED.keys() == set()
    assert (
        APPLIED.keys() | NOT_APPLIED.keys()
    ) - kept.keys() == set() and not APPLIED.keys() & NOT_APPLIED.keys()
    assert len(found & APPLIED.keys()) >= 0.75 * len(found)
    for place in APPLIED.values():
        file, test = place.split("::")
        assert test in names_in(file), place


# --- sessions, up to a later stage, with other options ---

ONCE, STILL = "cam1.mp4", np.full((48, 64, 3), 90, np.uint8)


def one_picture(folder: Path, scene: Scene) -> None:
    (folder / ONCE).unlink()
    write_film(folder / ONCE, [STILL], rate=10)


def at_rest(folder: Path, scene: Scene) -> None:
    for name in CAMERAS:
        (folder / f"{name}.mp4").unlink()
        write_film(folder / f"{name}.mp4", [STILL] * 12, rate=10)


def broken(folder: Path, scene: Scene) -> None:
    (folder / "photos" / "0.png").write_bytes(bytes(range(256)))


def nothing(folder: Path, scene: Scene) -> None:
    pass


RIGGED = rig()
# what is wrong, with which options, up to where, exit code, what is said; what is changed, with which options
Later = tuple[Change, tuple[str, ...], str, int, str, Change, tuple[str, ...]]
LATER_CASES: dict[str, Later] = {
    "between two frames": (
        put("capture.range_s", [0.51, 0.55]),
        (),
        "ingest",
        1,
        "[range-empty]",
        put("capture.range_s", [0.4, 1.0]),
        (),
    ),
    "no graphics processor": (
        nothing,
        ("--device", "cuda"),
        "ingest",
        2,
        "[gpu-missing]",
        nothing,
        ("--device", "cpu"),
    ),
    "begun in the middle": (
        both(RIGGED, put("calibration.sync.method", "none")),
        ("--from", "sync"),
        "sync",
        2,
        "[stage-not-made]",
        nothing,
        (),
    ),
    "a short clip": (
        both(RIGGED, one_picture),
        (),
        "ingest",
        3,
        "cam1.mp4 is too short",
        drop("capture.cameras.cam1"),
        (),
    ),
    "a short clip, all the same": (
        both(RIGGED, one_picture),
        (),
        "ingest",
        3,
        "[stage-unhealthy]",
        nothing,
        ("--allow-unhealthy",),
    ),
    "no clock, a table": (both(RIGGED, at_rest), (), "sync", 3, "give capture.timestamps", table(), ()),
    "no clock, none": (
        both(RIGGED, at_rest),
        (),
        "sync",
        3,
        "calibration.sync.method to none",
        put("calibration.sync.method", "none"),
        (),
    ),
    "no poses, a sweep": (
        both(rig(poses=False), put("calibration.rig.method", "given")),
        (),
        "ingest",
        2,
        "calibration.rig.method to auto",
        both(put("capture.static", "sweep.mp4"), put("calibration.rig.method", "auto")),
        (),
    ),
    "no sweep, method sweep": (
        both(RIGGED, put("calibration.rig.method", "sweep")),
        (),
        "ingest",
        2,
        "method: sweep needs it",
        put("calibration.rig.method", "given"),
        (),
    ),
    "a photo that is none": (
        both(photos(*(f"{n}.png" for n in range(24))), broken),
        (),
        "ingest",
        2,
        "save it as JPEG or PNG, or remove it",
        photos(*(f"{n}.png" for n in range(24))),
        (),
    ),
    "few photos": (
        photos("a.png", "b.png"),
        (),
        "ingest",
        3,
        "Film more of the scene at rest",
        photos(*(f"{n}.png" for n in range(24))),
        (),
    ),
}


@pytest.mark.parametrize("case", LATER_CASES)
def test_what_is_proposed_leads_on_in_later_stages(
    request: pytest.FixtureRequest, tmp_path: Path, devrf: Command, case: str
) -> None:
    wrong, options, until, code, said, mend, others = LATER_CASES[case]
    if "cuda" in options:
        torch = pytest.importorskip("torch")
        if torch.cuda.is_available():
            pytest.skip("there is a GPU")
    folder, scene = tmp_path / "scene", json.loads(json.dumps(TINY))
    shutil.copytree(request.getfixturevalue("clips"), folder)
    scene["capture"]["cameras"] = {name: f"{name}.mp4" for name in CAMERAS}
    for change, chosen, expected in ((wrong, options, code), (mend, others, 0)):
        change(folder, scene)
        (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
        done = devrf("run", folder / "scene.yaml", "--until", until, *chosen)
        assert done.code == expected, done.said
        assert "--allow-unhealthy" in chosen or (said in done.said) == (expected != 0)


# --- films, exports, comparisons, the viewer's address: of runs that are written without a run ---


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """scene.yaml of a run whose model is a ball that moves."""
    return write_ball_run(tmp_path_factory.mktemp("ball"))


def gone(code: str, do: Callable[..., Any], wrong: dict[str, Any], mend: dict[str, Any]) -> None:
    """What is done is refused as it is wrong, and done as it is mended."""
    with refused(code):
        do(**wrong)
    do(**mend)


@pytest.mark.parametrize(
    ("code", "wrong", "mend"),
    [
        ("camera-unknown", {"path": "still:cam9"}, {"path": "still:cam0"}),
        ("film-sides-odd", {"size": "49x37"}, {"size": "48x36"}),
        ("film-sides-odd", {"size": "49x37"}, {"size": "49x37", "format": "png"}),
        (
            "film-other-shape",
            {"path": "still:cam0", "size": "48x48"},
            {"path": "still:cam0", "size": "48x36"},
        ),
        ("film-too-long", {"fps": 200.0, "seconds": 200.0}, {"fps": 4.0, "seconds": 0.25}),
        ("option-out-of-range", {"time": "4s"}, {"time": "1.5s"}),
        ("option-malformed", {"time": "noon"}, {"time": "0.5"}),
        ("option-malformed", {"size": "large"}, {"size": "48x36"}),
        ("option-misplaced", {"without": "1"}, {}),
        ("option-unknown-value", {"format": "avi"}, {"format": "png"}),
        ("option-unknown-value", {"layers": "normals"}, {"layers": "depth"}),
    ],
)
def test_films_with_what_is_proposed(ball: Path, tmp_path: Path, code: str, wrong: dict, mend: dict) -> None:
    short = {"seconds": 0.25, "out": tmp_path / "film"}
    gone(code, lambda **options: film(ball, **(short | options)), wrong, mend)


def test_films_into_another_folder_and_of_what_moves(ball: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("")
    (tmp_path / "file").write_text("")
    for code, wrong in (("folder-exists", "mine"), ("folder-unwritable", "file")):
        gone(
            code,
            lambda out: film(ball, seconds=0.25, out=tmp_path / out),
            {"out": wrong},
            {"out": f"instead of {wrong}"},
        )
    shutil.copytree(ball.parent, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "run" / "deformation")
    scene = tmp_path / "copy" / "scene.yaml"
    gone("scene-without-motion", lambda **options: film(scene, seconds=0.25, **options), {"time": "0.5"}, {})


def test_a_film_that_fits(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "allowed_bytes", lambda config: 1_000_000_000)
    small = {"seconds": 0.25, "out": tmp_path / "film"}
    gone(
        "film-needs-memory",
        lambda size: film(ball, size=size, **small),
        {"size": "4096x4096"},
        {"size": "48x36"},
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trained(tmp_path_factory.mktemp("trained")).parent / "run"


@pytest.mark.parametrize(
    ("code", "wrong", "mend"),
    [
        ("option-out-of-range", {"format": "ply", "times": "9s"}, {"format": "ply", "times": "0.5"}),
        ("option-misplaced", {"format": "ply", "level": 0.5}, {"format": "ply"}),
        pytest.param(
            "page-too-large",
            {"format": "player", "splats": 1_500_000},
            {"format": "player", "splats": 600},
            marks=pytest.mark.full,
        ),
    ],
)
def test_exports_with_what_is_proposed(
    trained: Path, tmp_path: Path, code: str, wrong: dict, mend: dict
) -> None:
    def made(**options: Any) -> None:
        asked: dict[str, Any] = {"times": "1", "out": tmp_path / "out"} | options
        export(Talk("quiet"), trained, ExportOptions(**asked))

    gone(code, made, wrong, mend)


@pytest.mark.full
def test_a_surface_at_another_level(tmp_path: Path) -> None:
    pytest.importorskip("skimage")
    thin = moving_ball()
    thin.rest.canonical.density.clamp_(max=-1.0 - thin.rest.canonical.shift)
    run = write_trained(tmp_path / "thin", model=thin).parent / "run"
    asked = ExportOptions("glb", tmp_path / "out", times="1")
    gone(
        "model-without-surface",
        lambda level: export(Talk("quiet"), run, replace(asked, level=level)),
        {"level": 0.5},
        {"level": 0.1},
    )


@pytest.mark.full
def test_an_extra_that_is_there(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("skimage")
    asked = ExportOptions("glb", tmp_path / "out", times="1")
    with monkeypatch.context() as without, refused("package-missing", "devrf[export]"):
        without.setitem(sys.modules, "skimage", None)
        export(Talk("quiet"), trained, asked)
    export(Talk("quiet"), trained, asked)


def test_runs_of_one_scene_are_compared(tmp_path: Path) -> None:
    """Of the same test cameras, with pictures that were tested on, finished."""
    one, two = write_two_runs(tmp_path)
    file = two / "evaluate" / "metrics.json"
    whole = file.read_text()
    for code, text in (
        ("compare-no-common-view", whole.replace(CAMERA, "other").replace('"static"', '"sweep"')),
        ("file-damaged", "{"),
        ("metrics-without-views", '{"test": {"psnr": 3}}'),
        ("run-unfinished", None),
    ):
        file.unlink()
        if text is not None:
            file.write_text(text)
        with refused(code):
            found_of(one, two)
        file.write_text(whole)
        assert found_of(one, two)["differences"]


def test_an_address_that_is_free() -> None:
    for code, host in (("host-elsewhere", "192.0.2.1"), ("host-unknown", "no such host")):
        gone(code, lambda host: _check_free(Address(host, 0, ())), {"host": host}, {"host": "127.0.0.1"})
    with socket.create_server(("127.0.0.1", 0)) as server:
        with refused("port-unusable") as error:
            _check_free(Address("127.0.0.1", server.getsockname()[1], ()))
        (port,) = re.findall(r"try --port (\d+)", str(error.value))
        _check_free(Address("127.0.0.1", int(port), ()))


# --- runs ---


@pytest.fixture
def session(tmp_path: Path, clips: Path) -> Path:
    """scene.yaml of two clips with a calibration."""
    folder, scene = tmp_path / "scene", json.loads(json.dumps(TINY))
    shutil.copytree(clips, folder)
    scene["capture"]["cameras"] = {name: f"{name}.mp4" for name in CAMERAS}
    both(RIGGED, put("calibration.sync.method", "none"))(folder, scene)
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return folder / "scene.yaml"


@pytest.mark.full
def test_a_run_that_was_not_made(session: Path, devrf: Command) -> None:
    page = session.parent / "page.html"
    wrong = devrf("report", session, "--out", page)
    assert wrong.code == 2 and "devrf-pipeline run " in wrong.err and "[run-missing]" in wrong.err
    assert devrf("run", session, "--until", "ingest").code == 0
    assert devrf("report", session, "--out", page).code == 0 and page.is_file()
    wrong = devrf("export", session, "--format", "rig-opencv")
    assert wrong.code == 2 and "--until rig" in wrong.err and "[stage-not-made]" in wrong.err
    assert devrf("run", session, "--until", "rig").code == 0
    assert devrf("export", session, "--format", "rig-opencv").code == 0


def test_beside_another_run(session: Path, tmp_path: Path, devrf: Command) -> None:
    lock = Lock(session.parent / "run")
    (session.parent / "run").mkdir()
    lock.take()
    try:
        wrong = devrf("run", session, "--until", "ingest")
        assert wrong.code == 2 and "use another output [folder-busy]" in wrong.err
        assert devrf("run", session, "--until", "ingest", "--set", "output=other").code == 0
    finally:
        lock.release()


def test_init_with_force(tmp_path: Path, odd_scene: WholeScene, devrf: Command) -> None:
    write_set("nerfstudio", odd_scene, tmp_path / "set")
    assert devrf("init", tmp_path / "set").code == 0
    wrong = devrf("init", tmp_path / "set")
    assert wrong.code == 2 and "use --force" in wrong.err and "[file-exists]" in wrong.err
    assert devrf("init", tmp_path / "set", "--force").code == 0


def rewrapped(
    source: Path, target: Path, rate: int | None = None, tags: dict[str, str] | None = None
) -> None:
    """Another container, without coding anew; `rate`: pictures a second, where the source has no times."""
    options = {"movflags": "use_metadata_tags"}
    with av.open(str(source)) as clip, av.open(str(target), "w", options=options) as out:
        out.metadata.update(tags or {})
        stream = out.add_stream_from_template(clip.streams.video[0])
        for n, packet in enumerate(packet for packet in clip.demux(video=0) if packet.size):
            packet.stream = stream
            if rate is not None:
                packet.time_base = Fraction(1, rate)
                packet.pts = packet.dts = n
            out.mux(packet)


def test_a_clip_in_slow_motion_is_given_its_times(session: Path, devrf: Command) -> None:
    folder = session.parent
    (folder / "cam1.mp4").rename(folder / "plain.mp4")
    rewrapped(folder / "plain.mp4", folder / "cam1.mp4", tags={"com.android.capture.fps": "240"})
    wrong = devrf("run", session, "--until", "ingest")
    assert wrong.code == 2 and "or give capture.timestamps" in wrong.err
    scene = yaml.safe_load(session.read_text())
    table()(folder, scene)
    scene["calibration"]["sync"] = {}
    session.write_text(yaml.safe_dump(scene))
    done = devrf("run", session, "--until", "ingest")
    assert done.code == 0, done.said


def test_a_raw_stream_is_put_into_a_container(session: Path, devrf: Command) -> None:
    """As the command that is proposed does."""
    folder = session.parent
    write_film(folder / "cam1.h264", [np.full((48, 64, 3), 20 * n, np.uint8) for n in range(12)], bf="0")
    text = session.read_text()
    session.write_text(text.replace("cam1.mp4", "cam1.h264"))
    wrong = devrf("run", session, "--until", "ingest")
    assert wrong.code == 2 and "`ffmpeg -r 30 -i cam1.h264 cam1.mp4`" in wrong.err, wrong.said
    (folder / "cam1.mp4").unlink()
    rewrapped(folder / "cam1.h264", folder / "cam1.mp4", 30)
    session.write_text(text)
    done = devrf("run", session, "--until", "ingest")
    assert done.code == 0, done.said


# --- simulations and methods, up to where they would begin ---


@pytest.mark.parametrize(
    ("code", "wrong", "options"),
    [("scene-unknown", "flagg", SessionOptions()), ("options-contradict", "column", CUT)],
)
def test_simulations_that_can_be(tmp_path: Path, code: str, wrong: str, options: SessionOptions) -> None:
    """What is asked for can be, as far as the folder is looked at, which is not empty."""
    (tmp_path / "mine").write_text("")
    for scene, refusal in ((wrong, code), ("sheet", "folder-exists")):
        with refused(refusal):
            simulate_session(tmp_path, Simulation(scene, 4, 0, (64, 40), options))


@dataclass
class AsIf:
    """A method that is only asked what it can do."""

    regimes: Sequence[Any]
    unfit: str | None = None

    def why_not(self, task: MethodTask) -> str | None:
        return self.unfit

    def train(self, task: MethodTask, budget: TimeBudget) -> TrainedModel:
        raise NotImplementedError


def test_methods_that_can_do_it(odd_scene: WholeScene) -> None:
    def method(*regimes: Any, unfit: str | None = None) -> Method:
        return AsIf(regimes, unfit)

    def task(regime: Any, scene: WholeScene = odd_scene) -> MethodTask:
        return MethodTask(scene, {}, regime, "small", "cpu", 0, MagicMock(), MagicMock())

    moving = replace(odd_scene, static=())
    for code, wrong, mend in (
        ("regime-unknown", (method("two-stage"), task("dynamic")), (method("dynamic"), task("dynamic"))),
        (
            "sweep-missing",
            (method("joint", "dynamic"), task("joint", moving)),
            (method("dynamic"), task("dynamic", moving)),
        ),
        ("method-unfit", (method("joint", unfit="no flow"), task("joint")), (method("joint"), task("joint"))),
    ):
        with refused(code, "--"):
            methods.check("a", *wrong)
        methods.check("a", *mend)


# --- data sets ---


def entries(change: Callable[[list[dict[str, Any]]], object]) -> Callable[[Path], None]:
    """Change the entries of transforms.json."""

    def changed(folder: Path) -> None:
        meta = json.loads((folder / "transforms.json").read_text())
        change(meta["frames"])
        (folder / "transforms.json").write_text(json.dumps(meta))

    return changed


def first(**values: Any) -> Callable[[Path], None]:
    return entries(lambda frames: frames[0].update(values))


def scaled(by: float) -> Callable[[Path], None]:
    def change(frames: list[dict[str, Any]]) -> None:
        pose = np.array(frames[0]["transform_matrix"])
        pose[:3, :3] *= by
        frames[0]["transform_matrix"] = pose.tolist()

    return entries(change)


def turned(frames: list[dict[str, Any]]) -> None:
    pose = np.array(frames[0]["transform_matrix"])
    pose[:3, 0] *= -1
    frames[0]["transform_matrix"] = pose.tolist()


def encoded(encoding: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = folder / "transforms.json"
        raw = file.read_bytes()
        file.write_text(raw.decode("utf-16" if raw[:2] == b"\xff\xfe" else "utf-8"), encoding)

    return change


def moved(name: str, to: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).rename(folder / to) and None


SET_CASES: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], None]]] = {
    "a picture that is not there": (
        "picture-missing",
        first(file_path="gone.png"),
        entries(lambda f: f.pop(0)),
    ),
    "another lens": ("lens-unread", first(camera_model="OMNI"), first(camera_model="OPENCV")),
    "two words for a lens": (
        "lens-unread",
        first(camera_model="OPENCV", is_fisheye=True),
        first(is_fisheye=False),
    ),
    "a scale in a rotation": ("pose-not-rigid", scaled(2.0), scaled(0.5)),
    "an axis that points the wrong way": ("pose-mirrored", entries(turned), entries(turned)),
    "a picture without a place": (
        "pose-not-finite",
        first(transform_matrix=[[float("nan")] * 4] * 4),
        entries(lambda f: f.pop(0)),
    ),
    "UTF-16": ("encoding-wrong", encoded("utf-16"), encoded("utf-8")),
    "another file": (
        "file-missing",
        moved("transforms.json", "mine.json"),
        moved("mine.json", "transforms.json"),
    ),
    "no folder": (
        "folder-missing",
        lambda f: f.rename(f.with_name("mine")) and None,
        lambda f: f.with_name("mine").rename(f) and None,
    ),
    "no entries": ("pictures-none", lambda f: _list_nothing(f, True), lambda f: _list_nothing(f, False)),
    "all of it moves": (
        "rest-missing",
        entries(lambda f: [e.update(time=n / 50) for n, e in enumerate(f)]),
        entries(lambda f: [e.pop("time") for e in f[:9]]),
    ),
}


def _list_nothing(folder: Path, empty: bool) -> None:
    file, kept = folder / "transforms.json", folder / "kept.json"
    if empty:
        shutil.copy(file, kept)
        file.write_text(json.dumps(json.loads(file.read_text()) | {"frames": []}))
    else:
        kept.rename(file)


@pytest.mark.parametrize("case", SET_CASES)
def test_data_sets_with_what_is_proposed(odd_scene: WholeScene, tmp_path: Path, case: str) -> None:
    code, wrong, mend = SET_CASES[case]
    folder = tmp_path / "set"
    write_set("nerfstudio", odd_scene, folder)
    meta = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in meta.items() if k != OWN_KEY}))
    wrong(folder)
    with refused(code):
        read_dataset("nerfstudio", folder)
    mend(folder)
    read_dataset("nerfstudio", folder)
