"""`devrf-pipeline check SCENE`: go or no-go before the crew leaves, from a few pictures of each clip.

The rows are those of the stages where a stage has one; the stages look at all pictures and have the last word.
"""

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from devrf.calibration.field.fixed import glance_at_fixed
from devrf.calibration.field.matching import Features, features
from devrf.calibration.field.steady import steadiness
from devrf.calibration.field.sweep import glance_at_sweep
from devrf.capture.audio import Sound, read_sound
from devrf.capture.errors import DevrfError
from devrf.capture.frames import SWEEP, CameraFrames, FrameSet, grey_small, sharpness
from devrf.capture.pictures import list_pictures, read_picture
from devrf.capture.planned import planned_frames, sweep_pictures
from devrf.capture.progress import Progress
from devrf.capture.sampled import read_runs, spread_starts
from devrf.capture.session import CaptureSession
from devrf.capture.survey import Look, Picture, look_at_clip, look_at_photos, small
from devrf.pipelines.capture_session import capture_session
from devrf.pipelines.check import rows as check_rows
from devrf.pipelines.check.clocks import clock_rows
from devrf.pipelines.check.estimate import estimate_rows
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import Talk, describe, duration
from devrf.pipelines.health.rows import HealthRow
from devrf.pipelines.stages import ingest

SWEEP_PICTURES = 40  # that are looked at
SHARP_OF = 3  # successive pictures, of which the sharpest counts, as ingest takes the sharpest of a window
SIZE_PICTURES = 4  # that tell its size and brightness
CAMERA_PICTURES = 12
REST_PICTURES = 4
WORDS = {"ok": "go", "warn": "warn", "fail": "no-go"}
STYLE = {"ok": "green", "warn": "yellow", "fail": "red"}


def check(talk: Talk, config: SceneConfig, scene_dir: Path, run_dir: Path, json_file: Path | None) -> bool:
    """Look at a scene whose files are readable, print a table and say go or no-go.

    Returns:
        Whether it is a go.
    """
    begin = time.monotonic()
    with talk.progress("checking") as progress:
        rows = field_rows(config, scene_dir, run_dir, progress)
    verdicts = [row.verdict for row in rows]
    go = "fail" not in verdicts
    for row in rows:
        talk.say(f"{WORDS[row.verdict]:>6}  {describe(row)}", style=STYLE[row.verdict])
    warnings = verdicts.count("warn")
    word = (
        "NO-GO: film again what is red"
        if not go
        else "GO" + (f", with {warnings} warnings" if warnings else "")
    )
    seconds = time.monotonic() - begin
    talk.say(
        f"{word} ({duration(seconds)} for a few pictures of each clip; `run` looks at all)", style="bold"
    )
    if json_file is not None:
        content = {"go": go, "seconds": round(seconds, 1), "rows": [row.as_dict() for row in rows]}
        json_file.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    return go


def field_rows(config: SceneConfig, scene_dir: Path, run_dir: Path, progress: Progress) -> list[HealthRow]:
    """All rows of a scene made of raw files."""
    session = capture_session(config, scene_dir)
    rows: list[HealthRow] = []
    planned: dict[str, CameraFrames] = {}
    looks: dict[str, Look] = {}
    sweep: list[Features] = []
    if session.static is not None:
        progress(0.0, "the sweep")
        looks[SWEEP], planned[SWEEP], sweep, found = _sweep(session.static, progress)
        rows += [*ingest.health(FrameSet({SWEEP: planned[SWEEP]})), *found]
    sounds: dict[str, Sound] = {}
    fixed: list[HealthRow] = []
    for n, (name, path) in enumerate(session.cameras.items()):
        progress(0.5 + 0.3 * n / len(session.cameras), name)
        looks[name] = look_at_clip(path, CAMERA_PICTURES)
        sound = _sound(path)
        if sound is not None:
            sounds[name] = sound
        role = "test" if name in session.test_names else "camera"
        planned[name] = planned_frames(looks[name], role, path.name, sound)
        fixed += _camera(name, looks[name], session, sweep)
    moving = {name: frames for name, frames in planned.items() if name != SWEEP}
    if moving:
        rows += [*ingest.health(FrameSet(moving)), *fixed]
        progress(0.8, "clocks")
        rows += clock_rows(config, session, moving, sounds)
    progress(0.95, "disk and time")
    return [
        *rows,
        *estimate_rows(config, run_dir, planned, looks, shutil.disk_usage(_existing(run_dir)).free),
    ]


def _sweep(path: Path, progress: Progress) -> tuple[Look, CameraFrames, list[Features], list[HealthRow]]:
    """The sweep: what ingest will use of it, features of some pictures, and rows."""
    look = look_at_photos(path, SIZE_PICTURES) if path.is_dir() else look_at_clip(path, SIZE_PICTURES)
    used = sweep_pictures(look)
    chosen = used[np.unique(np.linspace(0, len(used) - 1, SWEEP_PICTURES).round().astype(int))]
    length = min(SHARP_OF, int(np.diff(chosen).min(initial=look.count)))  # runs that do not overlap
    photos = list_pictures(path) if path.is_dir() else []

    def read(indices: Sequence[int]) -> Iterator[list[Picture]]:
        if photos:
            yield from ([small(read_picture(photos[n])[:, :, :3])] for n in indices)
        else:
            starts = [float(look.times_s[n]) for n in indices]
            for run in read_runs(path, look.times_s, starts, length):
                yield [small(frame.rgb) for frame in run]

    found: list[Features] = []
    sharp: list[float] = []
    kept: list[int] = []
    for n, (index, pictures) in enumerate(zip(chosen.tolist(), read(chosen.tolist()), strict=True)):
        progress(0.4 * n / len(chosen), "the sweep")
        if pictures:
            sharpest = max(pictures, key=_sharpness)
            sharp.append(_sharpness(sharpest))
            found.append(features(sharpest))
            kept.append(index)

    def between(n: int) -> Picture | None:
        inside = used[(used > kept[n]) & (used < kept[n + 1])]
        pictures = next(read([int(inside[len(inside) // 2])])) if len(inside) else []
        return pictures[0] if pictures else None

    progress(0.4, "overlap of the sweep")
    glance = glance_at_sweep(found, between)
    where = [_place(look, index) for index in kept]
    return (
        look,
        planned_frames(look, "sweep", path.name, sharpness=sharp),
        found,
        check_rows.sweep_rows(glance, where),
    )


def _camera(name: str, look: Look, session: CaptureSession, sweep: list[Features]) -> list[HealthRow]:
    steady = steadiness(look.greys)
    rest: list[Picture] = []
    if session.rest != "none":
        starts = spread_starts(look.times_s, 2, REST_PICTURES)
        at = starts[0] if session.rest == "start" else starts[-1]
        rest = [small(f.rgb) for f in next(read_runs(look.path, look.times_s, [at], REST_PICTURES))]
    at_rest = features(rest[0]) if rest else features(look.pictures[0])
    glance = glance_at_fixed(look.pictures, rest, at_rest, sweep)
    return check_rows.camera_rows(name, glance, steady, look.black, session.rest, has_sweep=bool(sweep))


def _sound(path: Path) -> Sound | None:
    try:
        sound = read_sound(path)
    except DevrfError:
        return None  # preflight has said what is wrong with it, or the stage will
    return None if sound is None or sound.silent else sound


def _sharpness(picture: Picture) -> float:
    return sharpness(grey_small(picture))


def _place(look: Look, index: int) -> str:
    return f"{look.times_s[index]:.1f} s" if look.is_clip else f"photo {index + 1}"


def _existing(path: Path) -> Path:
    return next(place for place in (path, *path.absolute().parents) if place.exists())
