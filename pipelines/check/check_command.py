"""`devrf-pipeline check SCENE`: go or no-go before the crew leaves, from a few pictures of each clip.

The rows are those of the stages where a stage has one; the stages look at all pictures and have the last word.
"""

import time
from pathlib import Path

from devrf.calibration.preview.matching import Features
from devrf.calibration.rigs.rig import ARBITRARY
from devrf.capture.frames import SWEEP, CameraFrames, FrameSet
from devrf.capture.ingest.survey import Footage, find_material, look_at
from devrf.capture.measure import Measure, Verdict, noted
from devrf.capture.session import CaptureSession
from devrf.capture.system.amounts import GB, counted, size_text
from devrf.capture.system.durable import write_json
from devrf.capture.system.progress import Progress, part
from devrf.capture.video.audio import heard
from devrf.capture.video.timestamps import read_timestamps
from devrf.pipelines.budget.disk import room_of
from devrf.pipelines.budget.memory import allowed_bytes
from devrf.pipelines.check.board_pictures import board_measures
from devrf.pipelines.check.clip_pictures import camera_measures, planned_frames, see_sweep
from devrf.pipelines.check.clock_preview import clock_measures
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.judge import HealthRow, judge, worst
from devrf.pipelines.health.rig_rows import scale_measures
from devrf.pipelines.inputs.board_spec import board_spec
from devrf.pipelines.inputs.capture_session import capture_session
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.stages import ingest
from devrf.pipelines.terminal.console import describe, duration

Sections = dict[str, list[Measure]]  # what is looked at -> what was measured of it
RESOURCES, FILES = "disk and memory", "files"
CLIP_PICTURES = 12  # of each, that tell size, brightness and whether the camera stands
IN_JSON = ('"go": ', '"seconds": ', '"rows": ')  # what tells its file from others
SHOWN = (RESOURCES, FILES)  # whose rows are printed even where all is well
NO_GO = "NO-GO: mend what is marked so and check again"
WORDS: dict[Verdict, str] = {"ok": "go", "warn": "warn", "fail": "no-go"}
STYLE: dict[Verdict, str] = {"ok": "green", "warn": "yellow", "fail": "red"}


def check(job: Run, json_file: Path | None) -> bool:
    """Look at a scene whose files are readable, print a table and say go or no-go.

    Returns:
        Whether it is a go.
    """
    begin, talk, config = time.monotonic(), job.talk, job.config
    if config.kind == "dataset":
        said = ["can be read; there are no raw files to look at"]
        sections: Sections = {FILES: noted(said, "data set"), RESOURCES: _resources(config, job.run_dir)}
    else:
        with talk.progress("checking") as progress:
            sections = look_at_capture(config, job.scene_dir, job.run_dir, progress)
    judged: dict[str, list[HealthRow]] = {title: judge(measures) for title, measures in sections.items()}
    seconds = time.monotonic() - begin
    verdicts = [row.verdict for rows in judged.values() for row in rows]
    go = "fail" not in verdicts
    for title, rows in judged.items():
        verdict = worst(row.verdict for row in rows) or "ok"
        if talk.loudness == "quiet":  # what is wrong, for those who asked for errors alone
            for row in (row for row in rows if row.verdict == "fail"):
                talk.error(f"{WORDS[row.verdict]}  {title}: {describe(row)}", "check-failed")
        talk.say(f"{WORDS[verdict]:>6}  {title}, {counted(len(rows), 'check')}", style=STYLE[verdict])
        for row in rows:
            shown = row.verdict != "ok" or title in SHOWN
            (talk.say if shown else talk.detail)(f"    {WORDS[row.verdict]:>6}  {describe(row)}")
    warnings = f", with {counted(verdicts.count('warn'), 'warning')}" if "warn" in verdicts else ""
    word = f"GO{warnings}" if go else NO_GO
    if not go and talk.loudness == "quiet":
        talk.error(NO_GO, "check-no-go")
    talk.say(
        f"{word} ({duration(seconds)} for a few pictures of each clip; `run` looks at all)", style="bold"
    )
    if json_file is not None:
        found = [
            {**row.as_dict(), "about": title, "of": row.about}
            for title, rows in judged.items()
            for row in rows
        ]
        content = {"go": go, "seconds": round(seconds, 1), "rows": found}
        json_file.parent.mkdir(parents=True, exist_ok=True)
        write_json(json_file, content)
    return go


def look_at_capture(config: SceneConfig, scene_dir: Path, run_dir: Path, progress: Progress) -> Sections:
    """All that is measured of a scene made of raw files."""
    session = capture_session(config, scene_dir)
    sections: Sections = {}
    looks: dict[str, Footage] = {}
    sweep: list[Features] = []
    if session.static is not None:
        looks[SWEEP] = look_at(session.static, CLIP_PICTURES)
        seen = see_sweep(looks[SWEEP], part(progress, 0.0, 0.5))
        sweep = seen.features
        sections["sweep"] = [*ingest.ingested(FrameSet({SWEEP: seen.frames})), *seen.measures]
    sounds = {name: sound for name, path in session.cameras.items() if (sound := heard(path)) is not None}
    table = {} if session.timestamps is None else read_timestamps(session.timestamps, session.cameras)
    moving: dict[str, CameraFrames] = {}
    for n, (name, path) in enumerate(session.cameras.items()):
        progress(0.5 + 0.25 * n / len(session.cameras), name)
        looks[name] = look_at(path, CLIP_PICTURES)
        role = "test" if name in session.test_names else "camera"
        moving[name] = planned_frames(looks[name], role, path.name, sounds.get(name), table.get(name))
        sections[f"camera {name}"] = list(camera_measures(name, looks[name], session.rest, sweep))
    if moving:
        sections["all cameras"] = list(ingest.ingested(FrameSet(moving)))
        progress(0.75, "clocks")
        sections["clocks"] = clock_measures(config, session, moving, sounds)
    spec = board_spec(config)
    if spec is not None:
        sections["board"] = board_measures(session, spec, part(progress, 0.8, 0.15))
    sections["scale"] = _scale(config)
    sections[FILES] = left_out(session, scene_dir)
    sections[RESOURCES] = _resources(config, run_dir)
    return {title: measures for title, measures in sections.items() if measures}


def _scale(config: SceneConfig) -> list[Measure]:
    """A warning where nothing that was told gives metres, while the crew still has a ruler at the scene."""
    board, rig = config.board, config.calibration.rig
    if (board and board.metric) or rig.known_distance_m is not None or rig.given is not None:
        return []
    return list(scale_measures([], ARBITRARY, unmeasured_board=board is not None))


def left_out(session: CaptureSession, scene_dir: Path) -> list[Measure]:
    """Clips beside scene.yaml that it does not name: a camera that was forgotten, or one that `init` could not use."""
    used = {file.resolve() for file in session.files()}
    clips = [clip for clip in find_material(scene_dir).clips if clip.resolve() not in used]
    names = ", ".join(str(clip.relative_to(scene_dir)) for clip in clips)
    return noted([f"clips in this folder that scene.yaml does not use: {names}"] if clips else [], FILES)


def _resources(config: SceneConfig, run_dir: Path) -> list[Measure]:
    """What a run may use. How much it will need is not known before."""
    room = room_of(config, run_dir)
    facts = {"bound": room.bound, "mend": f"{room.remedy[0].upper()}{room.remedy[1:]}"}
    memory = f"a run may use {size_text(allowed_bytes(config))} of main memory"
    return [Measure("disk-room", room.count / GB, facts=facts), *noted([memory], "memory")]
