"""Stage `flow`: backward optical flow of every training camera's clip, and whether it can be trusted.

Pairs are written to `.flow` in the run folder as they are found, and become the stage's when all are there: a run that
was stopped finds only those that are missing.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from devrf.capture.formats.parts.flow_files import Flow, read_flow_file
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.measure import noted
from devrf.capture.scene import PosedFrame, load_image
from devrf.capture.system.durable import write_json
from devrf.capture.system.progress import part
from devrf.capture.system.remove import remove_tree
from devrf.flow.checks import FlowChecks
from devrf.flow.clip import ClipPictures, clip_flow, gaps_of
from devrf.flow.given import METHOD, given
from devrf.flow.pair import estimated
from devrf.pipelines.budget.at_once import flow_at_once
from devrf.pipelines.health.flow_rows import flow_measures
from devrf.pipelines.inputs.flow_clips import flow_estimator, is_brought, time_of, training_clips
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stamps.stamp import identity_key

UNFINISHED = ".flow"  # in the run folder
MADE_OF = "made_of"  # in it: what its pairs belong to
# Times the size of training at which flow is found, unless pictures are smaller: it is stored at the size of training,
# and a pair of 2880 x 2160 pictures takes 3.4 s whole and 0.6 s so.
FINER = 3


def run(context: StageContext) -> None:
    """Write `<camera>/<index>.npz` of every pair, and `flow.json` with what the flow says about itself."""
    scene = read_scene(context.run_dir / "scene")
    clips = training_clips(scene)
    brought = is_brought(clips)
    estimator = None if brought else flow_estimator(context.config, context.scene_dir, context.device)
    scale = min(1.0, FINER * scene.image_scale) if estimator is not None else 1.0
    whole = max(frame.camera.width * frame.camera.height for frames in clips.values() for frame in frames)
    side_by_side = estimator is None or estimator.parallel
    at_once = flow_at_once(context, round(scale**2 * whole)) if side_by_side else 1
    unfinished = _unfinished(context)
    checks: dict[str, FlowChecks] = {}
    for n, (camera, frames) in enumerate(clips.items()):
        small = frames[0].camera.scaled(scene.image_scale)

        def load(k: int, frames: list[PosedFrame] = frames) -> UInt8[np.ndarray, "h w 3"]:
            return load_image(frames[k], scale, scene.background)

        gap = gaps_of(camera, [time_of(frame) for frame in frames])
        paths = [frame.flow for frame in frames]
        index = [frame.index for frame in frames]
        found = clip_flow(
            ClipPictures(camera, index, gap if estimator is not None else np.zeros_like(gap), load),
            (small.width, small.height),
            given(lambda k, paths=paths: _read(paths[k])) if estimator is None else estimated(estimator),
            unfinished,
            at_once,
            part(context.progress, n / len(clips), 1 / len(clips)),
        )
        checks[camera] = found if _stands_still(frames) else replace(found, shake_px=None)
    for camera in clips:
        (unfinished / camera).rename(context.out / camera)
    remove_tree(unfinished)
    method = METHOD if estimator is None else estimator.name
    content = {"method": method, "cameras": {name: asdict(check) for name, check in checks.items()}}
    write_json(context.out / "flow.json", content)
    if brought:
        first = [name for name, frames in clips.items() if frames[0].flow is not None]
        ignored = [f"that of a first frame is ignored: {', '.join(first)}"] if first else []
        context.measures += noted(["given with the data set", *ignored], "flow")
    context.measures += flow_measures(checks, brought)


def _unfinished(context: StageContext) -> Path:
    """The folder of pairs found so far; emptied where they belong to something else."""
    made_of = identity_key("flow", context.made_from)
    folder = context.run_dir / UNFINISHED
    mark = folder / MADE_OF
    if not (mark.is_file() and mark.read_text() == made_of):
        remove_tree(folder)
        folder.mkdir()
        mark.write_text(made_of)
    return folder


def _stands_still(frames: Sequence[PosedFrame]) -> bool:
    first = frames[0].camera.cam_from_world
    return all(np.array_equal(frame.camera.cam_from_world, first) for frame in frames)


def _read(path: Path | None) -> Flow:
    assert path is not None  # every frame but the first has one
    return read_flow_file(path)
