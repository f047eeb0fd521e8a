"""What the keys of a scene.yaml mean together."""

import difflib
from collections import Counter
from collections.abc import Iterator

from devrf.pipelines.config.scene import (
    RESERVED_NAMES,
    RESERVED_PREFIXES,
    CaptureConfig,
    SceneConfig,
    is_camera_name,
)
from devrf.pipelines.config.words import suggestion

Mistakes = Iterator[tuple[str, str]]  # dotted key, what is wrong with it


def apart(config: SceneConfig, raw: dict) -> Mistakes:
    """What does not go together. `raw` tells what was written, before anything wrong was replaced."""
    written, capture = raw.get("capture"), config.capture
    if written is None and raw.get("dataset") is None:
        misspelt = [str(key) for key in raw if key not in SceneConfig.model_fields]
        if not any(difflib.get_close_matches(word, ("capture", "dataset")) for word in misspelt):
            yield "capture", "is missing; give capture (raw files) or dataset (a finished data set)"
    elif config.dataset is not None:
        for key in ("capture", "calibration"):
            if raw.get(key) is not None:
                yield key, "does not go with dataset; remove one of them"
    elif capture is not None:
        given = written if isinstance(written, dict) else {}
        if isinstance(written, dict) and not given.get("static") and not capture.all_cameras:
            yield "capture", "names no material; give static (the sweep), cameras, or both"
        yield from _names(capture)
        yield from _named_elsewhere(config, capture, sweep_written=bool(given.get("static")))
        yield from _missing(
            config, capture, board_is_wrong=bool(given.get("board")) and capture.board is None
        )


def _names(capture: CaptureConfig) -> Mistakes:
    """Of the cameras, which become folders."""
    own = capture.test_cameras if isinstance(capture.test_cameras, dict) else {}
    for section, cameras in (("capture.cameras", capture.cameras), ("capture.test_cameras", own)):
        for name in cameras:
            if not is_camera_name(name):
                yield section, f"{name!r} is no name for a camera; use letters, digits, _ and - (at most 64)"
            elif name in RESERVED_NAMES or name.startswith(RESERVED_PREFIXES):
                yield section, f"{name!r} is a name that the run folder needs; choose another"
    alike: dict[str, str] = {}
    for name in capture.all_cameras:
        other = alike.setdefault(name.lower(), name)
        if other != name:
            yield "capture.cameras", f"{other!r} and {name!r} differ only in case: one folder on many disks"
    for name in sorted(set(capture.cameras) & set(own)):
        yield "capture.test_cameras", f"{name!r} is in cameras too; a name stands for one camera"
    if capture.all_cameras and not capture.training_cameras:
        yield "capture.cameras", "every camera is a test camera; leave at least one to train on"
    for clip, count in Counter(capture.all_cameras.values()).items():
        if count > 1:
            yield "capture.cameras", f"{count} of them are the same file {clip!r}; each has its own clip"


def _named_elsewhere(config: SceneConfig, capture: CaptureConfig, *, sweep_written: bool) -> Mistakes:
    """Names of cameras in other keys."""
    sync, board = config.calibration.sync, capture.board
    fixed = list(capture.all_cameras)
    written = ["static"] if capture.static is not None or sweep_written else []
    listed = capture.test_cameras if isinstance(capture.test_cameras, list) else ()
    for key, names, known in (
        ("calibration.sync.av_lag_s", sync.av_lag_s, fixed),
        ("calibration.sync.readout_s", sync.readout_s, fixed),
        ("capture.test_cameras", listed, list(capture.cameras)),
        ("capture.board.clips", board.clips if board else (), written + fixed),
        ("capture.board.joint_clips", board.joint_clips if board else (), fixed),
    ):
        for name in names:
            if name not in known:
                near = suggestion(name, known)
                yield f"{key}.{name}", f"no camera has this name{near} ({', '.join(known)})"


def _missing(config: SceneConfig, capture: CaptureConfig, *, board_is_wrong: bool) -> Mistakes:
    """What a method needs, or what cameras without a sweep need."""
    rig = config.calibration.rig
    joint = capture.board.joint_clips if capture.board else {}
    without = [name for name in capture.all_cameras if name not in joint]
    if config.kind == "cameras" and capture.cameras and rig.given is None:
        if joint and without:
            yield "capture.board.joint_clips", f"has no clip of {', '.join(without)}; give one of each"
        if not joint and not board_is_wrong:
            yield (
                "capture.static",
                "is missing, and without a sweep the cameras' poses come from a board that several see "
                "(capture.board.joint_clips) or from a file (calibration.rig.given); give one of the three",
            )
    for key, value, method, wanted in (
        ("calibration.rig.given", rig.given, rig.method, "given"),
        ("capture.board.joint_clips", joint, rig.method, "board"),
        ("capture.static", capture.static, rig.method, "sweep"),
    ):
        if method == wanted and (value is None or value == {}):
            yield key, f"is missing; method: {wanted} needs it"
