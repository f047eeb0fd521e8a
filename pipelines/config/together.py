"""What the keys of a scene.yaml mean together."""

import difflib
from collections import Counter

from devrf.pipelines.config.scene import (
    CAMERA_NAME,
    RESERVED_NAMES,
    RESERVED_PREFIXES,
    SceneConfig,
)
from devrf.pipelines.config.words import Say, suggestion


def check_together(config: SceneConfig, raw: dict, say: Say) -> None:
    """Say what does not go together. `raw` tells what was written, before anything wrong was replaced."""
    if raw.get("capture") is None and raw.get("dataset") is None:
        misspelt = [str(key) for key in raw if key not in SceneConfig.model_fields]
        if not any(difflib.get_close_matches(word, ("capture", "dataset")) for word in misspelt):
            say("capture", "is missing; give capture (raw files) or dataset (a finished data set)")
        return
    if config.dataset is not None:
        for key in ("capture", "calibration"):
            if raw.get(key) is not None:
                say(key, "does not go with dataset; remove one of them")
        return
    capture = config.capture
    if capture is None:
        return
    given = raw.get("capture")
    if isinstance(given, dict) and not given.get("static") and not capture.all_cameras:
        say("capture", "names no material; give static (the sweep), cameras, or both")
    of_the_sweep = {"white": capture.white, "board.clips": capture.board.clips if capture.board else {}}
    if capture.static is None and not (
        isinstance(given, dict) and given.get("static")
    ):  # else that is said already
        for section, clips in of_the_sweep.items():
            if "static" in clips:
                say(
                    f"capture.{section}.static", "is of the sweep's camera; give capture.static, or remove it"
                )
    _check_names(config, say)
    if config.kind == "cameras" and capture.cameras:
        rig = config.calibration.rig
        board_is_wrong = capture.board is None and isinstance(given, dict) and bool(given.get("board"))
        joint = {} if capture.board is None else capture.board.joint_clips
        without = [name for name in capture.all_cameras if name not in joint]
        if rig.given is None and joint and without:
            say(
                "capture.board.joint_clips",
                f"has no clip of {', '.join(without)}; expected one of every camera",
            )
        if rig.given is None and not joint and not board_is_wrong:
            say(
                "capture.static",
                "is missing, and without a sweep the cameras' poses come from a board that several see "
                "(capture.board.joint_clips) or from a file (calibration.rig.given); give one of the three",
            )
    if capture.mattes is not None and capture.mattes.method == "background" and config.kind == "sweep":
        say("capture.mattes", "background needs fixed cameras, and there is only a sweep; use another method")
    rig = config.calibration.rig
    if rig.method == "given" and rig.given is None:
        say("calibration.rig.given", "is missing; rig.method: given needs the calibration file")
    if rig.method == "board" and not (capture.board and capture.board.joint_clips):
        say(
            "capture.board.joint_clips",
            "is missing; rig.method: board needs clips that several cameras share",
        )
    if rig.method == "sweep" and capture.static is None:
        say("capture.static", "is missing; rig.method: sweep needs the sweep")
    _check_charts(config, say)
    if config.calibration.sync.method == "timestamps" and capture.timestamps is None:
        say("capture.timestamps", "is missing; sync.method: timestamps needs the CSV file")


def _check_charts(config: SceneConfig, say: Say) -> None:
    capture, colour = config.capture, config.calibration.colour
    assert capture is not None
    if colour.method == "chart" and not colour.chart:
        say(
            "calibration.colour.chart",
            "is missing; colour.method: chart needs a picture of the chart by each camera",
        )
    known = [*(["static"] if capture.static is not None else []), *capture.all_cameras]
    for name in colour.chart:
        if name not in known:
            text = f"no camera has this name{suggestion(name, known)} (cameras: {', '.join(known)})"
            say(f"calibration.colour.chart.{name}", text)
    by_sweep = capture.static is not None and config.calibration.rig.method != "board"
    reference = "static" if by_sweep else next(iter(capture.training_cameras), None)
    if colour.chart and reference is not None and reference not in colour.chart:
        say(
            f"calibration.colour.chart.{reference}",
            "is missing; all cameras are brought to the look of this one, so film the chart with it too",
        )


def _check_names(config: SceneConfig, say: Say) -> None:
    capture = config.capture
    assert capture is not None
    named = {"cameras": capture.cameras}
    if isinstance(capture.test_cameras, dict):
        named["test_cameras"] = capture.test_cameras
    for section, cameras in named.items():
        for name in cameras:
            if not CAMERA_NAME.fullmatch(name):
                say(
                    f"capture.{section}",
                    f"{name!r} cannot be a camera's name; use letters, digits, _ and - (at most 64)",
                )
            elif name in RESERVED_NAMES or name.startswith(RESERVED_PREFIXES):
                say(f"capture.{section}", f"{name!r} is a name that the run folder needs; choose another")
    alike: dict[str, str] = {}
    for name in capture.all_cameras:
        other = alike.setdefault(name.lower(), name)
        if other != name:
            say(
                "capture.cameras",
                f"{other!r} and {name!r} differ only in case, and on many disks name one folder",
            )
    sync = config.calibration.sync
    for key, named_cameras in (("av_lag_s", sync.av_lag_s), ("readout_s", sync.readout_s)):
        for name in named_cameras:
            if name not in capture.all_cameras:
                known = capture.all_cameras
                say(f"calibration.sync.{key}", f"{name!r} is not in cameras{suggestion(name, known)}")
    if isinstance(capture.test_cameras, list):
        for name in capture.test_cameras:
            if name not in capture.cameras:
                say("capture.test_cameras", f"{name!r} is not in cameras{suggestion(name, capture.cameras)}")
    else:
        for name in sorted(set(capture.cameras) & set(capture.test_cameras)):
            say("capture.test_cameras", f"{name!r} is in cameras too; a name stands for one camera")
    if capture.all_cameras and not capture.training_cameras:
        say("capture.cameras", "every camera is a test camera; leave at least one to train on")
    clips = Counter(capture.all_cameras.values())
    for clip, count in clips.items():
        if count > 1:
            names = ", ".join(name for name, own in capture.all_cameras.items() if own == clip)
            say("capture.cameras", f"{names} name the same file {clip!r}; each camera has its own clip")
    sections = {"white": capture.white}
    if capture.board is not None:
        sections |= {"board.clips": capture.board.clips, "board.joint_clips": capture.board.joint_clips}
    for section, clips in sections.items():
        known = [*capture.all_cameras, *([] if section == "board.joint_clips" else ["static"])]
        for name in clips:
            if name not in known:
                say(
                    f"capture.{section}.{name}",
                    f"no camera has this name{suggestion(name, known)} (cameras: {', '.join(known)})",
                )
