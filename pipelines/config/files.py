"""The files that a scene.yaml names."""

import os
from pathlib import Path

from devrf.pipelines.config.scene import CaptureConfig, SceneConfig
from devrf.pipelines.config.words import Say, near_file


def input_paths(config: SceneConfig) -> dict[str, str]:
    """Every path that the configuration names: dotted key -> path as written."""
    capture, calibration, evaluate = config.capture or CaptureConfig(), config.calibration, config.evaluate
    weights = evaluate.lpips_weights
    named = {
        "dataset.path": config.dataset.path if config.dataset else None,
        "capture.static": capture.static,
        "capture.cameras": capture.cameras,
        "capture.test_cameras": capture.test_cameras if isinstance(capture.test_cameras, dict) else None,
        "capture.timestamps": capture.timestamps,
        "capture.mattes.folder": capture.mattes.folder if capture.mattes else None,
        "capture.board.clips": capture.board.clips if capture.board else None,
        "capture.board.joint_clips": capture.board.joint_clips if capture.board else None,
        "calibration.static_poses.masks": calibration.static_poses.masks,
        "calibration.rig.given": calibration.rig.given,
        "evaluate.lpips_weights": None if weights == "download" else weights,
        "evaluate.truth": evaluate.truth,
        "flow.weights": config.flow.weights,
    }
    paths: dict[str, str] = {}
    for key, value in named.items():
        if isinstance(value, dict):
            paths |= {f"{key}.{name}": path for name, path in value.items()}
        elif value is not None:
            paths[key] = value
    return paths


def check_output(config: SceneConfig, scene_dir: Path, say: Say) -> None:
    """Say where the run folder cannot be: stages' folders in it are replaced."""
    run_dir = config.run_dir(scene_dir)
    if run_dir == Path(run_dir.anchor):
        say("output", f"{config.output!r} is the root of a disk; name a folder of its own")
    elif run_dir == Path(os.path.realpath(os.path.expanduser("~"))):
        say("output", f"{config.output!r} is your home folder; name a folder of its own")
    for key, text in input_paths(config).items():
        if config.path(scene_dir, text) == run_dir:
            say("output", f"{config.output!r} is {key} too, which a run only reads; name a folder of its own")


def check_files_exist(config: SceneConfig, scene_dir: Path, say: Say) -> None:
    """Say which of them are missing, or a folder where a file is expected."""
    folders = {
        "dataset.path",
        "evaluate.lpips_weights",
        "capture.mattes.folder",
        "calibration.static_poses.masks",
    }
    files_or_folders = {"capture.static", "calibration.rig.given"}
    clips = "capture.board.clips."  # photos of the board will do
    for key, text in input_paths(config).items():
        path = config.path(scene_dir, text)
        try:
            if path.is_file():
                with path.open("rb") as file:
                    file.read(1)
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            pass
        except OSError as error:  # no permission, a loop of links, a bad card
            say(key, f"{text!r}: cannot be read ({error.strerror}); make it readable, or name another")
            continue
        if not text.strip():
            say(key, "is empty; expected a path")
        elif not path.exists():
            hint = "; or chroma" if key == "capture.mattes.folder" else ""
            say(key, f"{text!r}: no such file or folder ({path}){near_file(path)}{hint}")
        elif not (path.is_file() or path.is_dir()):
            say(key, f"{text!r} is a device or a pipe; expected a file")
        elif key in folders and not path.is_dir():
            say(key, f"{text!r} is a file; expected a folder")
        elif key not in folders | files_or_folders and not key.startswith(clips) and path.is_dir():
            say(key, f"{text!r} is a folder; expected a file")
