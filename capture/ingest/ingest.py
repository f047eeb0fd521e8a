"""A whole session from raw files to `ingest.json`, frames, sound and motion energies on disk.

Layout: `frames/<name>/<index>.<png or jpg>` (only frames that are used), `audio/<camera>.wav` (mono, 48 kHz,
16 bit, sample 0 at file time `audio_start_s`), `motion/<camera>.npy` (rows: time between two frames, seconds;
mean absolute difference, levels), `brightness/<camera>.npy` (rows: time of a frame, seconds; mean level of each
band of rows in the order the sensor reads them). The sweep is called "static", board clips "board_<camera>",
clips in which several cameras see the board at once "joint_<camera>" unless they are the moving clips themselves.
"""

import os
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.capture.frames import SWEEP, CameraFrames, FrameSet, Role
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.ingest.recordings import chapter_faults
from devrf.capture.measure import Measure
from devrf.capture.photos.extract import extract_folder
from devrf.capture.session import CaptureSession
from devrf.capture.system.arrays import ArrayError, read_npy
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.video.audio import Sound, heard, read_sound, read_wav, write_wav
from devrf.capture.video.recorded import rate_faults, read_recorded
from devrf.capture.video.slow_motion import length_faults
from devrf.capture.video.timestamps import read_timestamps

MAX_SWEEP_FRAMES = 120  # exhaustive matching of 120 pictures is 7140 pairs, minutes on two cores
MAX_BOARD_FRAMES = 60  # intrinsics gain nothing from more views of one board
MAX_JOINT_FRAMES = 300
LATE_SOUND_S = 5e-3  # less is rounding
SOUND_ROLES: tuple[Role, ...] = ("camera", "test", "joint")  # what needs a clock


def write_sounds(session: CaptureSession, out: Path) -> dict[str, Sound]:
    """Decode the sound of the fixed cameras and of separate joint clips; without those that cannot be heard.

    Raises:
        InputError: As `read_sound`.
    """
    folder = out / "audio"
    folder.mkdir(parents=True, exist_ok=True)
    sounds = {}
    for name, path in {**session.cameras, **_separate_joint_clips(session)}.items():
        sound = heard(path)
        if sound is not None:
            write_wav(folder / f"{name}.wav", sound)
            sounds[name] = sound
    return sounds


def write_frames(
    session: CaptureSession,
    sounds: Mapping[str, Sound],
    out: Path,
    root: Path,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    only_ranges: Collection[str] = (),
    progress: Progress = no_progress,
    workers: int | None = None,
) -> FrameSet:
    """Extract the frames of everything in the session and write `ingest.json`.

    Args:
        session: The raw files.
        sounds: What `write_sounds` returned.
        out: The ingest folder.
        root: Sources are named relative to this folder (the one of scene.yaml).
        ranges: Camera -> (from, to), only frames in this span of the camera's own times are kept.
        only_ranges: Cameras of which nothing outside `ranges` is measured either (no clock needs it): long clips are
            not read in full.
        progress: Called with the share of sources that are done.
        workers: Pictures in memory at once, decoded, developed or written; None: one per core. It changes no result.
    Raises:
        InputError, CaptureError: Naming the file, what was found and the remedy; a test camera without a picture that
            can be used is left out instead.
    """
    ranges = ranges or {}
    times = {} if session.timestamps is None else read_timestamps(session.timestamps, session.cameras)
    joint_clips = _separate_joint_clips(session)
    for course in ("motion", "brightness", "light"):
        (out / course).mkdir(parents=True, exist_ok=True)
    total = (session.static is not None) + len(session.cameras) + len(session.board_clips) + len(joint_clips)
    cameras: dict[str, CameraFrames] = {}

    def step(fraction: float, message: str) -> None:
        progress((len(cameras) + fraction) / total, message)

    def extract(name: str, path: Path, role: Role, keep: Keep, camera: str | None = None) -> None:
        source = os.path.relpath(path, root)
        if path.is_dir():
            cameras[name] = extract_folder(
                path, out, name, role, source, keep.most, session.white_balance, step, workers
            )
            return
        got = extract_clip(path, out, name, role, source, keep, times.get(camera or ""), step, workers)
        whole = not times and not (keep.only_range and keep.range_s)
        clocked = role in SOUND_ROLES
        frames = with_clock_cues(got.frames, sounds.get(name), path, whole) if clocked else got.frames
        cameras[name] = replace(frames, faults=(*frames.faults, *chapter_faults(path)))
        if clocked:
            np.save(out / "motion" / f"{name}.npy", got.courses.motion)
            np.save(out / "brightness" / f"{name}.npy", got.courses.brightness)
        if got.light is not None:
            got.light.write(out / "light" / f"{name}.npy")

    if session.static is not None:
        most = None if session.static.is_dir() else MAX_SWEEP_FRAMES
        extract(SWEEP, session.static, "sweep", Keep(most=most))
    left_out = {}
    for name, path in session.cameras.items():
        keep = Keep(range_s=ranges.get(name), only_range=name in only_ranges)
        if name not in session.test_names:
            extract(name, path, "camera", keep, name)
            continue
        try:
            extract(name, path, "test", keep, name)
        except CaptureError as error:
            left_out[name] = str(error)
    for name, path in session.board_clips.items():
        extract(f"board_{name}", path, "board", Keep(most=MAX_BOARD_FRAMES))
    for name, path in joint_clips.items():
        extract(name, path, "joint", Keep(most=MAX_JOINT_FRAMES, choose="every"))
    joint = {c: c if session.shares_joint_clip(c) else f"joint_{c}" for c in session.joint_clips}
    frames = FrameSet(cameras, {c: n for c, n in joint.items() if c not in left_out}, bool(times), left_out)
    frames.write(out)
    return frames


def read_sounds(folder: Path, frames: FrameSet) -> dict[str, Sound]:
    """The sounds of an ingest folder: name -> sound, with start times."""
    return {
        name: read_wav(folder / "audio" / f"{name}.wav", camera.audio_start_s)
        for name, camera in frames.cameras.items()
        if camera.audio_start_s is not None
    }


def read_motion(folder: Path, frames: FrameSet) -> dict[str, Float[np.ndarray, "_ 2"]]:
    """The motion energies of an ingest folder: name -> (time, mean absolute difference) [n, 2].

    Raises:
        CaptureError: If a file is missing.
    """
    return _read_courses(folder / "motion", frames)


def read_brightness(folder: Path, frames: FrameSet) -> dict[str, Float[np.ndarray, "_ _"]]:
    """The brightness of rows of an ingest folder: name -> (time, level of each band of rows) [n, 1 + bands].

    Raises:
        CaptureError: If a file is missing.
    """
    return _read_courses(folder / "brightness", frames)


def _read_courses(folder: Path, frames: FrameSet) -> dict[str, np.ndarray]:
    courses = {}
    for name, camera in frames.cameras.items():
        if camera.role in SOUND_ROLES:
            path = folder / f"{name}.npy"
            try:
                courses[name] = read_npy(path)
            except ArrayError as error:
                raise CaptureError(error.code, f"{error}; run again with --from ingest") from None
    return courses


def _separate_joint_clips(session: CaptureSession) -> dict[str, Path]:
    return {f"joint_{c}": p for c, p in session.joint_clips.items() if not session.shares_joint_clip(c)}


def with_clock_cues(frames: CameraFrames, sound: Sound | None, path: Path, whole: bool) -> CameraFrames:
    """The frames of a clip with what is known of their clock: sound, creation time, timecode.

    Args:
        frames: Without that.
        sound: The clip's; None where there is nothing to hear.
        path: The clip.
        whole: They are all of the clip's, with its own times, so that they last as long as the sound.
    """
    recorded = read_recorded(path)
    frames = replace(
        frames,
        created_s=recorded.created_s,
        timecode_s=recorded.timecode_s,
        timecode_fps=recorded.timecode_fps,
        faults=(*frames.faults, *rate_faults(recorded.timecode_fps, frames.fps_mean)),
    )
    if sound is None:
        try:
            note = "no sound track" if read_sound(path) is None else "the sound track is silent"
        except CaptureError as error:
            wrong = str(error).removeprefix(f"{path}: ")
            return replace(frames, faults=(*frames.faults, Measure("not-used", wrong, why="damaged")))
        return replace(frames, notes=(*frames.notes, note))
    notes = list(frames.notes)
    if sound.recorded_hz not in (None, sound.rate_hz):
        notes.append(f"sound resampled from {sound.recorded_hz} to {sound.rate_hz} Hz")
    if sound.taken:
        notes.append(f"sound: {sound.taken}")
    if abs(sound.start_s) > LATE_SOUND_S:
        notes.append(f"sound starts {1e3 * sound.start_s:+.0f} ms from the file's start; counted")
    shown = [f.time_s for f in frames.frames if f.time_s is not None]
    lasts_s = max(shown) - min(shown) if whole and shown else 0.0
    faults = (*frames.faults, *length_faults(lasts_s, sound.end_s - sound.start_s, frames.fps_mean))
    return replace(frames, has_audio=True, audio_start_s=sound.start_s, notes=tuple(notes), faults=faults)
