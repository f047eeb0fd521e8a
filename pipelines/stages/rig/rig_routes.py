"""The routes to a rig: given, from the sweep, from a board; test cameras, each by itself; metric scale."""

from dataclasses import replace

import numpy as np

from devrf.calibration.boards.find import find_board
from devrf.calibration.rigs.bump import find_bump
from devrf.calibration.rigs.graph import Link, camera_graph
from devrf.calibration.rigs.joint import adjust_together, disagreement, rig_in_world, world_from_rig
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale
from devrf.calibration.rigs.rig_cameras import rig_camera
from devrf.calibration.rigs.scale import combined, scale_from_board, scale_from_distances
from devrf.calibration.rigs.sweep_route import SweepRig
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.frames import some
from devrf.capture.measure import Measure, noted, of_test
from devrf.capture.system.errors import CalibrationError, HealthError, InputError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.pipelines.health.judge import refuses_at
from devrf.pipelines.health.left_out import left_out
from devrf.pipelines.health.rig_rows import (
    bump_measures,
    graph_measures,
    route_measures,
    sweep_measures,
)
from devrf.pipelines.stages.rig.rig_job import RigJob, clock_of

MIN_CAMERAS = 2  # of a rig from a board
SWEEP_BOARD_TRIES = 40  # sweep pictures that are searched for the board first; all, if it is seen in them


def route(job: RigJob) -> str:
    """given, sweep or board."""
    method = job.settings.method
    joint = [name for name in job.trained if name in job.frames.joint]
    if method == "auto":
        has_rig = job.given is not None and job.given.rig is not None
        method = "given" if has_rig else "sweep" if job.has_sweep else "board"
    if method == "given" and (job.given is None or job.given.rig is None):
        what = "names no file" if job.given is None else "holds intrinsics only"
        raise InputError(
            "rig-without-poses",
            f"calibration.rig.method is given, but calibration.rig.given {what}; expected the poses of all "
            "cameras; film a sweep or a board and set method to auto",
        )
    if method == "sweep" and not job.has_sweep:
        text = "calibration.rig.method is sweep, but capture.static is missing; film a sweep or use board"
        raise InputError("sweep-missing", text)
    if method == "board":
        missing = [name for name in job.trained if name not in joint]
        if job.spec is None or len(joint) < MIN_CAMERAS or missing:
            raise InputError(
                "rig-without-source",
                "the rig needs a sweep (capture.static), a board that the cameras see at once "
                "(capture.board.joint_clips) or a calibration file (calibration.rig.given); "
                + (f"no joint clip of {', '.join(missing)}" if joint else "none of them is there"),
            )
    return method


def from_given(job: RigJob) -> Rig:
    """Route C: a calibration people own. Its world must be the sweep's where there is one."""
    assert job.given is not None and job.given.rig is not None
    return _given_into_sweep(job, job.given.rig) if job.has_sweep else job.given.rig


def from_sweep(job: RigJob) -> Rig:
    """Route A: one clean picture of each camera into the sweep's model; with joint clips one adjustment of both."""
    context, model = job.context, job.model
    known = job.clip_calibrations(job.trained, part(context.progress, 0.0, 0.3)) | job.given_lenses
    swept = job.register(model, job.trained, known, part(context.progress, 0.3, 0.6))
    cameras = {n: job.named_lens(n, c) for n, c in swept.cameras.items()}
    for name, c in cameras.items():
        job.measures += sweep_measures(name, c)
    job.leave_out(swept.left_out)
    context.progress(0.65, "metric scale")
    job.scales = _scales(job, model, {n: c.camera.centre for n, c in cameras.items()})
    joint = [name for name in cameras if name in job.frames.joint]
    graph = camera_graph(swept.solution.problem, swept.index)
    if job.spec is not None and len(joint) >= MIN_CAMERAS:
        together = _together(job, swept, cameras, joint, part(context.progress, 0.7, 0.3))
        if together is not None:
            cameras, graph = together
    job.swept = replace(swept, cameras=cameras)
    scale = combined(job.scales) if job.scales else ARBITRARY
    placed = {n: _scaled(c, scale.factor) for n, c in cameras.items()}
    return Rig(placed, scale, "sweep", graph, swept.left_out)


def from_board(job: RigJob) -> Rig:
    """Route B: the board before several cameras at once; metres, in the first camera's frame."""
    seen, found = job.board_rig(list(job.trained), job.context.progress)
    job.leave_out(found.left_out)
    index = {name: c for c, name in enumerate(found.views.names)}
    cameras = {name: job.of_board(name, seen, found) for name in index}
    if job.board_is_measured:
        job.scales = [Scale(True, "board seen by several cameras at once", 1.0, None)]
    scale = job.scales[0] if job.scales else ARBITRARY
    rig = Rig(cameras, scale, "board", camera_graph(found.solution.problem, index), found.left_out)
    job.measures += graph_measures(rig.graph, rig)
    return rig


def with_test_cameras(job: RigJob, rig: Rig) -> Rig:
    """The rig with its test cameras, each placed by itself against what stands; those that cannot be are named.

    Cameras whose pictures no lens makes are left out, wherever their poses came from.
    """
    placed = {name: c for name, c in rig.cameras.items() if name not in job.no_lens}
    missing = rig.left_out | job.no_lens
    job.leave_out({name: why for name, why in job.no_lens.items() if name in job.frames.trained})
    job.measures += [left_out(name, why) for name, why in job.no_lens.items() if name in job.frames.tests]
    for name in job.tests:
        try:
            placed[name] = rig.cameras.get(name) or _test_camera(job, name, rig)
        except (HealthError, InputError, CalibrationError) as error:
            missing[name] = str(error)
            job.measures.append(left_out(name, str(error)))
    return replace(rig, cameras=placed, left_out=missing)


def _test_camera(job: RigJob, name: str, rig: Rig) -> RigCamera:
    """A test camera in the sweep's world, or where there is no sweep in the board's."""
    alone = {name: job.tests[name]}
    if job.swept is None:
        return _test_camera_by_board(job, name, rig)
    known = job.clip_calibrations(alone, no_progress) | job.given_lenses
    found = job.register(job.model, alone, known, job.context.progress, job.swept).cameras[name]
    found = job.named_lens(name, found)
    job.measures += of_test(name, sweep_measures(name, found))
    return _scaled(found, rig.scale.factor)


def _test_camera_by_board(job: RigJob, name: str, rig: Rig) -> RigCamera:
    """By the board that it sees at once with the others, which stay where they are."""
    if name not in job.frames.joint:
        text = f"camera '{name}' has no clip of the board that others see at once (capture.board.joint_clips)"
        raise CalibrationError("rig-without-source", text)
    trained = [n for n in job.trained if n in rig.cameras]
    seen, found = job.by_board([*trained, name], job.context.progress)
    camera = job.of_board(name, seen, found)
    into = world_from_rig({n: rig.cameras[n].camera for n in trained}, found.cameras)
    return replace(camera, camera=camera.camera.moved(into))


def _together(
    job: RigJob, swept: SweepRig, cameras: dict[str, RigCamera], names: list[str], progress: Progress
) -> tuple[dict[str, RigCamera], tuple[Link, ...]] | None:
    """Both routes compared, then one adjustment of both; None where the joint clips cannot be used."""
    try:
        seen, board = job.board_rig(names, progress)
    except HealthError as error:
        job.measures.append(Measure("rig-routes", str(error), why="unused"))
        return None
    ours = {n: c.camera for n, c in cameras.items()}
    joint = adjust_together(swept.solution, swept.index, ours, board)
    unit = joint.problem.unit
    found, same = route_measures(disagreement(ours, board.cameras), cameras, board, unit)
    job.measures += found
    if not same:
        job.measures.append(
            Measure("rig-routes", "the board's does not fit, the sweep's is used", why="unfit")
        )
        return None
    names = list(board.views.names)
    source = f"board seen at once by {', '.join(names)}"
    if job.board_is_measured:
        job.scales.append(Scale(True, source, 1 / unit, joint.unit_std))
    out = {}
    for name, c in cameras.items():
        own = np.flatnonzero(joint.problem.obs_camera == swept.index[name])
        boards = own[own >= len(swept.solution.problem.obs_body)]
        details = {k: c.details[k] for k in ("picture", "matches", "verified", "inlier_area")}
        out[name] = rig_camera(
            joint,
            swept.index[name],
            seen.start.get(name, swept.like[name]),
            "board" if name in names and c.intrinsics_source == "self" else c.intrinsics_source,
            np.concatenate([swept.support[name], boards]),
            details | (clock_of(board, name) if name in names else {}),
        )
    return out, camera_graph(joint.problem, swept.index)


def look_for_bumps(job: RigJob, rig: Rig) -> None:
    """Whether the fixed cameras stayed where they were over their clips."""
    for name in rig.cameras:
        camera = job.frames.moving[name]
        seen = camera.filmed(job.ingest)
        job.measures += bump_measures(name, find_bump([f.file for f in seen], [f.time_s for f in seen]))


def _scales(job: RigJob, model: SweepModel, centres: dict[str, np.ndarray]) -> list[Scale]:
    """Metres from the board in the sweep and from a known distance."""
    found: list[Scale] = []
    if job.board_is_measured:
        scale, text = _scale_from_sweep_board(job, model)
        found += [] if scale is None else [scale]
        job.measures += noted([text] if scale is None and text else [], "board in the sweep")
    distance = job.settings.known_distance_m
    if distance is not None and (lost := [n for n in list(job.frames.trained)[:2] if n not in centres]):
        text = f"calibration.rig.known_distance_m is not used, since {' and '.join(lost)} has no place"
        job.measures += noted([text], "known distance")
    elif distance is not None:
        first, second = list(centres)[:2]
        true = {first: np.zeros(3), second: np.array([distance, 0.0, 0.0])}
        scale = scale_from_distances(true, centres, f"known distance from {first} to {second}")
        found += [] if scale is None else [scale]
    return found


def _scale_from_sweep_board(job: RigJob, model: SweepModel) -> tuple[Scale | None, str]:
    assert job.spec is not None
    files = [job.ingest / "frames" / name for name in model.names]
    step = max(1, len(files) // SWEEP_BOARD_TRIES)
    views, spec = find_board("the sweep", files[::step], job.spec, required=False)
    if not views:
        return None, ""
    if step > 1:
        views, spec = find_board("the sweep", files, job.spec, required=False)
    return scale_from_board(views, list(model.cameras), spec)


def _given_into_sweep(job: RigJob, rig: Rig) -> Rig:
    """A given rig moved into the sweep's world by registering its cameras there; metres stay metres."""
    assert job.given is not None
    found = job.register(job.model, job.trained, job.given.intrinsics, job.context.progress).cameras
    if len(found) < 3:
        raise InputError(
            "rig-given-untied",
            "calibration.rig.given: fewer than three cameras cannot align a given rig with the sweep; "
            "set calibration.rig.method to sweep",
        )
    lost = [n for n in job.trained if n not in found]
    if lost:
        job.measures += noted([f"{some(lost)} not found in the sweep, and placed as given"], "given")
    percent = 100 / max(float(np.median([c.details["median_distance"] for c in found.values()])), 1e-9)
    places = ({n: rig.cameras[n].camera for n in found}, {n: c.camera for n, c in found.items()})
    placed_rig = rig_in_world(*places, refuses_at("rig-given-moved") / percent)
    unit = float(np.cbrt(np.linalg.det(placed_rig.world_from_rig[:3, :3])))
    world_from_given = np.diag([1 / unit, 1 / unit, 1 / unit, 1.0]) @ placed_rig.world_from_rig
    cameras = {n: replace(c, camera=c.camera.moved(world_from_given)) for n, c in rig.cameras.items()}
    job.measures.append(
        Measure("rig-given-moved", percent * max(placed_rig.off[n] for n in placed_rig.fitted))
    )
    for name in found.keys() - set(placed_rig.fitted):
        cameras[name] = _scaled(found[name], 1 / unit)
        off = percent * placed_rig.off[name]
        job.measures.append(Measure("rig-given-moved", off, name, "one", refuses=False))
    return Rig(cameras, replace(rig.scale, factor=1 / unit), "given")


def _scaled(c: RigCamera, factor: float) -> RigCamera:
    """The camera in a world whose lengths are `factor` times larger."""
    similarity_matrix = np.diag([factor, factor, factor, 1.0])
    lengths = ("axis_std", "sideways_std", "median_distance")
    details = {k: v * factor if k in lengths and v is not None else v for k, v in c.details.items()}
    if "position_covariance" in details:
        details["position_covariance"] = (np.array(details["position_covariance"]) * factor**2).tolist()
    std = None if c.position_std is None else c.position_std * factor
    return replace(c, camera=c.camera.moved(similarity_matrix), position_std=std, details=details)
