"""Look at every raw file before anything starts, so that a wrong clip is found now and not after an hour."""

from collections.abc import Callable, Collection
from pathlib import Path

from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import DevrfError, InputError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.inputs.capture_session import capture_session


def check_inputs(config: SceneConfig, scene_dir: Path, stages: Collection[str]) -> None:
    """Refuse files that one of the stages which are going to run could not use.

    Raises:
        InputError: With everything that is wrong.
    """
    problems = _check_truth(config, scene_dir)
    if not {"ingest", "scene"}.isdisjoint(stages):
        if config.dataset is None:
            problems += check_raw_files(config, scene_dir)
        else:
            from devrf.pipelines.inputs.configured_dataset import check_dataset

            problems += check_dataset(config, scene_dir)
    if problems:
        raise InputError("inputs-unusable", "\n".join(problems))
    if "flow" in stages and config.flow.method != "dis":  # DIS has nothing to be wrong
        from devrf.pipelines.inputs.flow_clips import flow_estimator

        flow_estimator(config, scene_dir)


def check_raw_files(config: SceneConfig, scene_dir: Path) -> list[str]:
    """Everything that is wrong with the raw files; empty when all is well."""
    from devrf.capture.session import preflight

    session = capture_session(config, scene_dir)
    problems = preflight(session) + _check_masks(config, scene_dir) + _check_mattes(config, scene_dir)
    problems += _check_dictionary(config)
    # sizes and tracks are known where clips are whole
    return problems or [
        *_check_sound(config, session),
        *_check_timecode(config, session),
        *_check_given(config, scene_dir, session),
        *photos_too_large(config, session),
    ]


def _check_truth(config: SceneConfig, scene_dir: Path) -> list[str]:
    """Whether the truth that all is compared with in the end can be read."""
    if config.evaluate.truth is None:
        return []
    from devrf.calibration.truth import read_truth

    truth = config.path(scene_dir, config.evaluate.truth)
    return _wrong(lambda: read_truth(truth), "evaluate.truth: ")


def _check_dictionary(config: SceneConfig) -> list[str]:
    board = config.board
    if board is None or board.type == "chessboard":
        return []
    from devrf.calibration.boards.spec import dictionary

    return _wrong(lambda: dictionary(board.dictionary))


def _check_sound(config: SceneConfig, session: CaptureSession) -> list[str]:
    """Clips without a sound track that are to be synchronised by sound."""
    if config.calibration.sync.method != "audio":
        return []
    from devrf.capture.video.reader import probe_video

    separate = {n: p for n, p in session.joint_clips.items() if not session.shares_joint_clip(n)}
    silent = [
        f"{name} ({path})"
        for clips in (session.cameras, separate)
        if len(clips) > 1  # one clip alone has nothing to be synchronised with
        for name, path in clips.items()
        if not probe_video(path).has_audio
    ]
    if not silent:
        return []
    return [
        f"calibration.sync.method: audio, but there is no sound track in the clip of {', '.join(silent)}; set it to "
        "auto, flash or motion, or give capture.timestamps"
    ]


def _check_timecode(config: SceneConfig, session: CaptureSession) -> list[str]:
    """Clips that are to be synchronised by times, and have neither a table nor a timecode."""
    if config.calibration.sync.method != "timestamps" or session.timestamps is not None:
        return []
    from devrf.calibration.clocks.sync import no_timecode
    from devrf.capture.video.recorded import read_recorded

    clips = session.cameras.items() if len(session.cameras) > 1 else ()
    without = [name for name, path in clips if read_recorded(path).timecode_s is None]
    return [f"capture.timestamps: {no_timecode(without)}"] if without else []


def photos_too_large(config: SceneConfig, session: CaptureSession) -> list[str]:
    """What is wrong with photos of which not even one fits into the memory that is allowed, one text per folder."""
    from devrf.capture.photos.photo_folders import list_pictures
    from devrf.capture.photos.upright_pictures import probe_picture
    from devrf.pipelines.budget.at_once import BASE, photo_bytes
    from devrf.pipelines.budget.memory import too_much

    problems = []
    for folder in (session.static, *session.board_clips.values()):
        if folder is None or not folder.is_dir():
            continue
        needed, largest = max((photo_bytes(path), path) for path in list_pictures(folder))
        if (wrong := too_much(config, BASE + needed)) is not None:
            photo = probe_picture(largest)
            size = f"{photo.width}x{photo.height}"
            problems.append(f"{largest}: a photo of {size} needs {wrong}, or make the photos smaller")
    return problems


def _check_masks(config: SceneConfig, scene_dir: Path) -> list[str]:
    masks = config.calibration.static_poses.masks
    if masks is None or any(config.path(scene_dir, masks).glob("*.png")):
        return []
    return [
        f"calibration.static_poses.masks: {masks}: no folder with PNG files; expected one mask per picture of the "
        "sweep, named like the picture with .png"
    ]


def _check_mattes(config: SceneConfig, scene_dir: Path) -> list[str]:
    capture = config.capture
    if capture is None or capture.mattes is None:
        return []
    from devrf.capture.mattes.chroma import parse_colour
    from devrf.capture.mattes.given import cameras_with_mattes

    mattes, found = capture.mattes, []
    if mattes.colour != "auto":
        found = _wrong(lambda: parse_colour(mattes.colour), "capture.mattes.colour: ")
    if mattes.folder is not None:
        folder, names, sweep = (
            config.path(scene_dir, mattes.folder),
            tuple(capture.all_cameras),
            capture.static is not None,
        )
        found += _wrong(lambda: cameras_with_mattes(folder, names, sweep), "capture.mattes: ")
    return found


def _check_given(config: SceneConfig, scene_dir: Path, session: CaptureSession) -> list[str]:
    if config.calibration.rig.given is None or not session.cameras:
        return []
    from devrf.capture.video.reader import probe_video
    from devrf.pipelines.inputs.given_calibration import given_calibration

    clips = {name: probe_video(path) for name, path in session.cameras.items()}
    try:
        given = given_calibration(config, scene_dir, clips)
    except DevrfError as error:
        return [f"calibration.rig.given: {error}"]
    elsewhere = session.static is not None or bool(session.joint_clips)
    wanted = config.calibration.rig.method == "given" or not elsewhere
    if given is not None and given.rig is None and wanted:
        return [
            "calibration.rig.given: holds intrinsics only (or poses of some cameras); expected the poses of all; give "
            "a sweep (capture.static) or a board that several cameras see (capture.board.joint_clips) too, and set "
            "calibration.rig.method to auto"
        ]
    return []


def _wrong(look: Callable[[], object], key: str = "") -> list[str]:
    """What is wrong with what the key names, found by reading it; empty where nothing is."""
    try:
        look()
    except DevrfError as error:
        return [f"{key}{error}"]
    return []
