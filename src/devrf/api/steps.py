"""From raw files to a trained scene, step by step, in this process: each step runs the stages that it needs.

What is fresh is not made again, and all that `devrf-pipeline` does with a scene.yaml can be done with what is left.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from jaxtyping import Float

from devrf.api.reconstruction import Reconstruction, cameras_of, load
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.colour.colours import read_colours
from devrf.capture.camera import Camera
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import DevrfError, HealthError, InputError
from devrf.pipelines.cli.run_command import check, prepared
from devrf.pipelines.config.text import override
from devrf.pipelines.run_folder.clocks import clocks_in_use
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.terminal.console import Loudness, Talk, console_on
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, STOPPED, UNHEALTHY

if TYPE_CHECKING:
    from rich.console import Console

Settings = Mapping[str, Any]
"""Keys of scene.yaml with dots and their values, in place of the file's: `{"reconstruct.rays": 4096}`."""

MARK = "# Written by devrf of a Session, and written anew with it; to keep changes, give it another name.\n"


@dataclass(frozen=True)
class Calibration:
    """Where cameras are, when their pictures were taken, and how their colours compare.

    Attributes:
        scene_yaml: The session's.
        settings: What it was made with, beside scene.yaml.
        run_folder: Where the stages' folders lie.
        cameras: In one world, at full size, by name; of the sweep each picture, `static/12`.
        clocks: Of the fixed cameras: true time = offset_s + (1 + 1e-6 drift_ppm) * file time, seconds on the first's.
        colours: [3, 3] that bring linear RGB of a camera to the reference's; empty of data sets.
        metric: Whether lengths are metres.
    """

    scene_yaml: Path
    settings: Settings
    run_folder: Path
    cameras: dict[str, Camera] = field(repr=False)
    clocks: dict[str, Clock] = field(repr=False)
    colours: dict[str, Float[np.ndarray, "3 3"]] = field(repr=False)
    metric: bool


def ingest(
    session: CaptureSession | str | Path,
    folder: str | Path | None = None,
    *,
    settings: Settings = {},  # noqa: B006 (a mapping that nobody changes)
    allow_unhealthy: bool = False,
    quiet: bool = False,
) -> dict[str, CameraFrames]:
    """Decode the raw files: what is known of each clip and of each of its frames (time_s, sharpness, picture).

    Args:
        session: The raw files, or a scene.yaml that names them.
        folder: Of a `Session`: gets a scene.yaml, and the run folder `run`.
        settings: Keys of scene.yaml.
        allow_unhealthy: Go on where a stage's own check refuses its result.
        quiet: Print nothing.
    Returns:
        Name -> clip; the sweep is `static`, a clip of the board `board_<camera>`. A frame's `file` is relative to
        `ingest/` in the run folder.
    Raises:
        DevrfError: As `run`.
    """
    path = _scene_yaml(session, folder, settings)
    run_folder = run(
        path, settings=settings, until="ingest", device="cpu", allow_unhealthy=allow_unhealthy, quiet=quiet
    )
    return FrameSet.read(run_folder / "ingest").cameras


def calibrate(
    session: CaptureSession | str | Path,
    folder: str | Path | None = None,
    *,
    settings: Settings = {},  # noqa: B006
    allow_unhealthy: bool = False,
    quiet: bool = False,
) -> Calibration:
    """Find cameras, clocks, colours and the scene box. Arguments and errors as `ingest`'s."""
    path = _scene_yaml(session, folder, settings)
    run_folder = run(
        path, settings=settings, until="scene", device="cpu", allow_unhealthy=allow_unhealthy, quiet=quiet
    )
    scene, colours = read_scene(run_folder / "scene"), {}
    if (run_folder / "colour").is_dir():
        found = read_colours(run_folder / "colour").cameras
        colours = {name: np.array(camera.matrix, dtype=np.float64) for name, camera in found.items()}
    cameras = cameras_of(scene.dynamic + scene.static)
    return Calibration(path, settings, run_folder, cameras, clocks_in_use(run_folder), colours, scene.metric)


def train(
    calibration: Calibration,
    *,
    settings: Settings = {},  # noqa: B006
    device: str = "auto",
    allow_unhealthy: bool = False,
    quiet: bool = False,
) -> Reconstruction:
    """Train the scene at rest and its motion, and evaluate both.

    Args:
        calibration: What `calibrate` found.
        settings: More keys of scene.yaml, such as `reconstruct.rays`.
        device: auto, cpu or cuda.
        allow_unhealthy: Go on where a stage's own check refuses its result.
        quiet: Print nothing.
    Raises:
        DevrfError: As `run`.
    """
    run_folder = run(
        calibration.scene_yaml,
        settings={**calibration.settings, **settings},
        until="evaluate",
        device=device,
        allow_unhealthy=allow_unhealthy,
        quiet=quiet,
    )
    return load(run_folder, device=device)


def run(
    scene_yaml: str | Path,
    *,
    settings: Settings = {},  # noqa: B006
    until: str | None = None,
    device: str = "auto",
    allow_unhealthy: bool = False,
    quiet: bool = False,
) -> Path:
    """Run the stages of a scene, as `devrf-pipeline run` does; what is fresh is not made again.

    Args:
        scene_yaml: The file, or the folder that holds it.
        settings: Keys of scene.yaml.
        until: The last stage to run; None: all run.
        device: auto, cpu or cuda.
        allow_unhealthy: Go on where a stage's own check refuses its result.
        quiet: Print nothing.
    Returns:
        The run folder.
    Raises:
        DevrfError: The first stage that failed, with the same code and text as on the command line: `InputError`
            before anything was started, `HealthError` where a check refused a result.
    """
    talk = _Raised("quiet" if quiet else "normal")
    choice = Choice(last=until, allow_unhealthy=allow_unhealthy)
    job = prepared(talk, Path(scene_yaml).expanduser(), None, _overrides(settings), choice)
    check(job, job.standings(), device)
    code = execute(job)
    if code == STOPPED:
        raise KeyboardInterrupt
    if code != DONE:
        kind = {BAD_INPUT: InputError, UNHEALTHY: HealthError}.get(code, DevrfError)
        raise kind(*talk.errors[-1])
    return job.run_dir


class _Raised(Talk):
    """Keeps codes and texts of errors, which are raised, and prints none."""

    def __init__(self, loudness: Loudness) -> None:
        super().__init__(loudness)
        self.errors: list[tuple[str, str]] = []

    @cached_property
    def err(self) -> "Console":
        """Nowhere."""
        return console_on(io.StringIO())

    def error(self, text: str, code: str) -> None:
        """What went wrong."""
        super().error(text, code)
        self.errors.append((code, text))


def _scene_yaml(session: CaptureSession | str | Path, folder: str | Path | None, settings: Settings) -> Path:
    """The scene.yaml of a session, which is written where it is none yet."""
    if not isinstance(session, CaptureSession):
        return Path(session).expanduser()
    if folder is None:
        text = "folder: missing; name one for the scene.yaml of the session and its run folder"
        raise InputError("option-missing", text)
    path = Path(folder).expanduser() / "scene.yaml"
    if path.is_file() and not path.read_text(encoding="utf-8").startswith(MARK):
        text = (
            f"{path}: not written for a Session; name another folder, or give this file instead of a Session"
        )
        raise InputError("folder-exists", text)
    path.parent.mkdir(parents=True, exist_ok=True)
    keys = _keys(session, path.parent.resolve().name, settings)
    path.write_text(MARK + yaml.safe_dump(keys, sort_keys=False), encoding="utf-8")
    return path


def _keys(session: CaptureSession, name: str, settings: Settings) -> dict[str, Any]:
    """What scene.yaml says of a session; mistakes are left to its reader."""

    def named(path: Path | None) -> str | None:
        return None if path is None else str(Path(path).expanduser().resolve())

    clips, joint = (
        {camera: named(path) for camera, path in of.items()}
        for of in (session.board_clips, session.joint_clips)
    )
    capture = {
        "static": named(session.static),
        "cameras": {camera: named(path) for camera, path in session.cameras.items()},
        "test_cameras": list(session.test_names),
        "timestamps": named(session.timestamps),
        "range_s": session.range_s and list(session.range_s),
        "rest": session.rest,
        "raw": session.white_balance and {"white_balance": list(session.white_balance)},
        "board": {"clips": clips, "joint_clips": joint} if clips or joint else None,
    }
    keys: dict[str, Any] = {"name": name, "output": "run"}
    keys["capture"] = {key: value for key, value in capture.items() if value}
    for text in _overrides(settings):
        override(keys, text, [])
    return keys


def _overrides(settings: Settings) -> list[str]:
    return [f"{key}={json.dumps(value, default=str)}" for key, value in settings.items()]
