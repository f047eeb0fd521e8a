"""A capture that has been calibrated, as a scene: its pictures with cameras and exact times, and its box."""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.spans import span_of
from devrf.calibration.colour.colours import read_colours
from devrf.calibration.extent.bounds import MAX_ERROR_PX, MIN_TRACK, Bounds, Silhouettes, scene_bounds
from devrf.calibration.extent.box_checks import points_of_subject
from devrf.calibration.rigs.rig import ARBITRARY, Rig, read_rig
from devrf.calibration.sweep.static_poses import SweepModel, read_static_poses
from devrf.capture.frames import FrameSet
from devrf.capture.mattes.given import SWEEP
from devrf.capture.measure import ENOUGH_CAMERAS, Measure, noted, of_test
from devrf.capture.scene import PosedFrame, Scene, SparsePoints, by_camera
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import part
from devrf.pipelines.health.box_rows import box_measures
from devrf.pipelines.health.left_out import NO_PICTURE, left_out
from devrf.pipelines.health.matte_rows import matte_measures
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.scene.clock_check import checked_clocks, untimed
from devrf.pipelines.stages.scene.filmed_clips import filmed_clip, stretches_of
from devrf.pipelines.stages.scene.measured_rest import rest_time
from devrf.pipelines.stages.scene.scene_mattes import scene_mattes
from devrf.reconstruct.sampling.pictures import training

PLAIN = "white"  # behind a subject with mattes, as behind data sets' pictures with alpha
TIME_SLACK_S = 1e-6
FEWEST_PICTURES = 2  # of a training camera, which is asked what moves from one to the next


def scene_from_capture(
    context: StageContext, across: Callable[[tuple[PosedFrame, ...]], float]
) -> tuple[Scene, Bounds]:
    """The scene of a run's finished stages, and how its box was found.

    Args:
        context: Of stage `scene`.
        across: Of all pictures, how many of their widths a mean side of the box may be long.
    """
    config, ingest = context.config, context.run_dir / "ingest"
    assert config.capture is not None
    frames = FrameSet.read(ingest)
    rig_file, sweep_folder = context.run_dir / "rig" / "rig.json", context.run_dir / "static_poses"
    rig = read_rig(rig_file) if frames.moving else Rig({}, ARBITRARY)
    lost = [name for name in frames.trained if name not in rig.cameras]
    context.measures += noted(
        [f"without {', '.join(lost)}, which has no place in the rig"] if lost else [], "cameras"
    )
    frames = _placed(frames, rig)
    whole = read_static_poses(sweep_folder) if (sweep_folder / "static_poses.json").is_file() else None
    every = config.evaluate.holdout_every
    model = None if whole is None else whole.without_held_out(every)
    factor = rig.scale.factor
    static = () if whole is None else _sweep_frames(whole, ingest, factor, every)
    clocks = checked_clocks(context, frames, rig)
    frames = _timed(context, frames, clocks)
    dynamic, t0_s, t1_s = _moving_frames(context, frames, rig, clocks)
    context.measures += unused(frames.trained, frames.tests, dynamic)
    static, dynamic = _with_looks(context.run_dir / "colour", static, dynamic)
    context.progress(0.4, "what moves")
    points = None if whole is None else _points(whole, factor, every)
    mattes = scene_mattes(context, frames, static, dynamic, part(context.progress, 0.4, 0.4))
    if mattes is not None:
        static, dynamic = mattes.static, mattes.dynamic
    used = {frame.camera_name for frame in dynamic if frame.split == "train"}
    clips = {
        name: filmed_clip(ingest, camera, rig.cameras[name].camera, clocks[name])
        for name, camera in frames.moving.items()
        if name in used
    }
    moves = {name: mask for name, clip in clips.items() if (mask := clip.mask()) is not None}
    if mattes is None:
        masks = list(moves.values())
    else:
        for name in frames.tests.keys() & mattes.cameras.keys():
            context.measures += of_test(name, matte_measures(mattes.only([name])))
        mattes = mattes.only([SWEEP, *frames.trained])
        context.measures += matte_measures(mattes)
        masks = mattes.hull_masks
        if points is not None and mattes.everywhere:
            small = [fact.small for fact in mattes.cameras[SWEEP].facts]
            points = points_of_subject(points, mattes.small[SWEEP], small)
    xyz, distances = np.zeros((0, 3)), np.zeros(0)
    if points is not None:
        start, end = points.lines_of_sight(static)
        xyz, distances = points.xyz, np.linalg.norm(end - start, axis=1)
    context.progress(0.8, "box")
    bounds = scene_bounds(
        [f.camera for f in training(static)],
        [rig.cameras[name].camera for name in frames.trained],
        xyz,
        distances,
        Silhouettes(
            masks,
            "what moves" if mattes is None else "the subject's mattes",
            stretches_of([clips[name] for name in moves], (t0_s, t1_s)) if mattes is None else [],
            across(training(static + dynamic)),
        ),
    )
    context.measures += box_measures(bounds, moves, mattes, dynamic, training(static))
    rest = None
    if dynamic:
        filmed = {n: clip for n, clip in by_camera(dynamic).items() if n in moves and len(clip) > 1}
        sweep = None if model is None else (model, factor)
        rest, seen = rest_time(config.capture.rest, filmed, moves, _shared(training(dynamic)), sweep, ingest)
        context.measures += seen
    scene = Scene(
        static=static,
        dynamic=dynamic,
        box_from_world=bounds.box_from_world,
        aabb=bounds.aabb,
        near=bounds.near,
        far=bounds.far,
        kind=bounds.kind,
        background=PLAIN if mattes is not None and mattes.everywhere else "shell",
        t0_s=t0_s,
        t1_s=t1_s,
        rest_time=rest,
        image_scale=1.0,
        metric=rig.scale.metric,
        points=points,
    )
    return scene, bounds


def _sweep_frames(model: SweepModel, ingest: Path, factor: float, every: int) -> tuple[PosedFrame, ...]:
    """The registered sweep in the rig's unit; every n-th picture is held out."""
    unit = np.diag([factor, factor, factor, 1.0])
    out = []
    for name, camera, held in zip(model.names, model.cameras, model.held_out(every).tolist(), strict=True):
        out.append(
            PosedFrame(
                path=ingest / "frames" / name,
                camera=camera.moved(unit),
                camera_name="static",
                index=int(Path(name).stem),
                time_s=None,
                time=None,
                split="test" if held else "train",
            )
        )
    return tuple(out)


def _with_looks(folder: Path, *parts: tuple[PosedFrame, ...]) -> tuple[tuple[PosedFrame, ...], ...]:
    """The frames with what stage `colour` found of their colours."""
    colours = read_colours(folder)
    return tuple(
        tuple(replace(frame, look=colours.look(frame.camera_name, frame.index)) for frame in part)
        for part in parts
    )


def _placed(frames: FrameSet, rig: Rig) -> FrameSet:
    """What was filmed, without cameras that have no place in the rig."""
    lost = frames.moving.keys() - rig.cameras.keys()
    return replace(frames, cameras={n: c for n, c in frames.cameras.items() if n not in lost})


def _timed(context: StageContext, frames: FrameSet, clocks: dict[str, Clock]) -> FrameSet:
    """What was filmed, without training cameras whose clocks nothing tells."""
    lost = untimed({name: clocks[name] for name in frames.trained}, frames.trained)
    facts = {"reason": "its clock is not known; another row says what to do."}
    context.measures += [
        Measure("camera-left-out", "nothing of it is used", name, facts=facts) for name in lost
    ]
    return replace(frames, cameras={n: c for n, c in frames.cameras.items() if n not in lost})


def _moving_frames(
    context: StageContext, frames: FrameSet, rig: Rig, clocks: dict[str, Clock]
) -> tuple[tuple[PosedFrame, ...], float, float]:
    """Frames of the fixed cameras with their exact times, cut to what is modelled; and that span."""
    if not frames.moving:
        return (), 0.0, 1.0
    assert context.config.capture is not None
    ingest = context.run_dir / "ingest"
    times: dict[str, list[tuple[int, Path, float]]] = {}
    for name, camera in frames.moving.items():
        times[name] = [(f.index, f.file, clocks[name].true_time(f.time_s)) for f in camera.filmed(ingest)]
        if not times[name] and name in frames.tests:
            del times[name]  # nothing of it is measured
        elif not times[name]:
            text = f"camera '{name}' has no frames; check its clip and capture.range_s"
            raise CaptureError("camera-without-frames", text)
    filmed = {name: (rows[0][2], rows[-1][2]) for name, rows in times.items()}
    taught = [span for name, span in filmed.items() if name in frames.trained]
    t0_s, t1_s = span_of(taught) or (0.0, 0.0)
    if context.config.capture.range_s is not None:
        from_s, to_s = context.config.capture.range_s
        t0_s, t1_s = max(t0_s, from_s), min(t1_s, to_s)
    if t1_s <= t0_s:
        spans = ", ".join(f"{name} {from_s:.2f} to {to_s:.2f} s" for name, (from_s, to_s) in filmed.items())
        text = f"the cameras share no time on {next(iter(times))}'s clock ({spans}); check capture.range_s"
        raise CaptureError("cameras-share-no-time", text)
    out = []
    for name, rows in times.items():
        for index, path, time_s in rows:
            if t0_s - TIME_SLACK_S <= time_s <= t1_s + TIME_SLACK_S:
                time = float(np.clip((time_s - t0_s) / (t1_s - t0_s), 0.0, 1.0))
                split = "test" if name in frames.tests else "train"
                out.append(PosedFrame(path, rig.cameras[name].camera, name, index, time_s, time, split))
    return without_single_pictures(out), t0_s, t1_s


def without_single_pictures(dynamic: Sequence[PosedFrame]) -> tuple[PosedFrame, ...]:
    """Without training cameras that show no motion: they took one picture in the modelled time.

    All of them stay where fewer than two others are left (one, where there is only one): such a scene is refused.
    """
    counts = Counter(frame.camera_name for frame in dynamic if frame.split == "train")
    single = {name for name, count in counts.items() if count < FEWEST_PICTURES}
    if len(counts) - len(single) < min(ENOUGH_CAMERAS, len(counts)):
        return tuple(dynamic)
    return tuple(frame for frame in dynamic if frame.camera_name not in single)


def unused(trained: Collection[str], tests: Collection[str], dynamic: Sequence[PosedFrame]) -> list[Measure]:
    """Cameras none of whose pictures is used."""
    used = {frame.camera_name for frame in dynamic}
    found = [left_out(name, NO_PICTURE) for name in tests if name not in used]
    facts = {
        "reason": "while two training cameras film it takes no picture, or a single one. Start all clips before the "
        "action and stop them after it, or check capture.range_s and the clocks."
    }
    names = [name for name in trained if name not in used]
    return [
        *(Measure("camera-left-out", "nothing of it is used", name, facts=facts) for name in names),
        *found,
    ]


def _shared(dynamic: Sequence[PosedFrame]) -> tuple[float, float]:
    """The first and the last time at which all of these cameras film; may be none, the first after the last."""
    times = [[frame.time or 0.0 for frame in of] for of in by_camera(dynamic).values()]
    return max(map(min, times)), min(map(max, times))


def _points(model: SweepModel, factor: float, every: int) -> SparsePoints:
    """Good points in the rig's unit, and the pictures that show them; those that are held out tell nothing."""
    told = ~model.held_out(every)[model.obs_image]
    track = np.bincount(model.obs_point[told], minlength=len(model.xyz))
    good = (model.error_px < MAX_ERROR_PX) & (track >= MIN_TRACK)
    number = np.cumsum(good) - 1
    seen = good[model.obs_point] & told
    return SparsePoints(factor * model.xyz[good], number[model.obs_point[seen]], model.obs_image[seen])
