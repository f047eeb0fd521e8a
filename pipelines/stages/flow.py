"""Stage `flow`: backward optical flow of every training camera's clip, and whether it can be trusted."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from devrf.capture.formats.flow_files import Flow, read_flow_file
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.flow.clip import FlowChecks, clip_flow
from devrf.flow.estimator import FlowEstimator, create_estimator
from devrf.flow.given import METHOD, given_clip_flow
from devrf.flow.store import write_flow
from devrf.pipelines.health import HealthRow, note, row
from devrf.pipelines.stage import StageContext


def run(context: StageContext) -> None:
    """Write `<camera>.npz` per training camera, and `flow.json` with what the flow says about itself."""
    scene = read_scene(context.run_dir / "scene")
    clips = training_clips(scene)
    given = bool(clips) and all(f.flow is not None for frames in clips.values() for f in frames[1:])
    estimator = None if given else _estimator(context)
    checks: dict[str, FlowChecks] = {}
    for n, (camera, frames) in enumerate(clips.items()):
        small = frames[0].camera.scaled(scene.image_scale)
        index, size = [frame.index for frame in frames], (small.width, small.height)

        def load(k: int, frames: list[PosedFrame] = frames) -> UInt8[np.ndarray, "h w 3"]:
            return load_image(frames[k], 1.0, scene.background)

        def progress(share: float, text: str, n: int = n) -> None:
            context.progress((n + share) / len(clips), text)

        if estimator is None:
            paths = [frame.flow for frame in frames]
            flow, checks[camera] = given_clip_flow(
                camera, index, load, lambda k, paths=paths: _read(paths[k]), size, progress
            )
        else:
            times = [_time(frame) for frame in frames]
            flow, checks[camera] = clip_flow(camera, index, times, load, size, estimator, progress)
        write_flow(context.out, flow)
    method = METHOD if estimator is None else estimator.name
    _write_json(
        context.out / "flow.json",
        {"method": method, "cameras": {camera: asdict(check) for camera, check in checks.items()}},
    )
    if given:
        context.health.append(note("flow", "given with the data set"))
    context.health.extend(health(checks, given))


def _estimator(context: StageContext) -> FlowEstimator:
    weights = context.config.flow.weights
    return create_estimator(
        context.config.flow.method, context.config.path(context.scene_dir, weights) if weights else None
    )


def _read(path: Path | None) -> Flow:
    assert path is not None  # every frame but the first has one
    return read_flow_file(path)


def training_clips(scene: Scene) -> dict[str, list[PosedFrame]]:
    """The frames of each training camera, in order of time; test cameras need no flow."""
    clips: dict[str, list[PosedFrame]] = {}
    for frame in scene.dynamic:
        if frame.split == "train":
            clips.setdefault(frame.camera_name, []).append(frame)
    return {camera: sorted(frames, key=_time) for camera, frames in clips.items()}


def health(checks: dict[str, FlowChecks], given: bool = False) -> list[HealthRow]:
    """Rows for the worst camera of each check (docs: capture, hand-off to training).

    Given flow need not be consistent with a way back that nobody knows; its mask may leave out the backdrop.
    """
    if not checks:
        return [note("flow", "no training camera sees the scene move: no flow")]
    rows = [] if given else [_consistent(checks)]
    moving = {name: check for name, check in checks.items() if check.moving_valid is not None}
    if not moving:
        return [*rows, note("motion", "nothing moves by more than half a pixel between frames")]
    camera = min(moving, key=lambda name: moving[name].moving_valid or 0.0)
    rows.append(
        row(
            f"consistent share of what moves, worst camera ({camera})",
            moving[camera].moving_valid,
            "",
            warn=0.5,
            remedy="The motion is too fast, blurred or without texture: raise the frame rate or give the "
            "subject more texture.",
        )
    )
    camera = max(moving, key=lambda name: moving[name].warp_ratio or 0.0)
    rows.append(
        row(
            f"what warping leaves of the difference between frames, worst camera ({camera})",
            moving[camera].warp_ratio,
            "",
            warn=0.8,
            fail=1.05,
            low_is_bad=False,
            remedy="Following the flow does not lead to the previous frame: frames are out of order, or the "
            "light flickers; lock the exposure.",
        )
    )
    camera = max(moving, key=lambda name: moving[name].large)
    rows.append(
        row(
            f"share of moving pixels beyond 1/8 of the width, worst camera ({camera})",
            moving[camera].large,
            "",
            warn=0.05,
            low_is_bad=False,
            remedy="The subject moves too far between frames for this flow: raise the frame rate."
            if not given
            else "The subject moves far between the data set's times: more times would help the motion.",
        )
    )
    gaps = {name: check.gaps for name, check in checks.items() if check.gaps}
    if gaps:
        total = sum(check.gaps + check.pairs for check in checks.values())
        text = ", ".join(f"{name}: {count}" for name, count in gaps.items())
        rows.append(
            note(
                "gaps in the clips",
                f"{text} (of {total} pairs); no flow across them",
                verdict="warn",
                remedy="Frames were dropped while filming: use faster cards, or a lower resolution.",
            )
        )
    return rows


def _consistent(checks: dict[str, FlowChecks]) -> HealthRow:
    camera = min(checks, key=lambda name: checks[name].valid or 0.0)
    return row(
        f"consistent share of what can be followed, worst camera ({camera})",
        checks[camera].valid,
        "",
        warn=0.7,
        fail=0.3,
        remedy="Most of the flow contradicts itself: film with a higher frame rate, a shorter shutter "
        "and more light; check that frames are in order.",
    )


def _time(frame: PosedFrame) -> float:
    return float(frame.time_s if frame.time_s is not None else frame.time or 0.0)


def _write_json(path: Path, value: dict) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
