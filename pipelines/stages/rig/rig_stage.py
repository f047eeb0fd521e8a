"""Stage `rig`: the fixed cameras in one world with the sweep, their doubts, and the length of a unit."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from devrf.calibration.boards.calibrate import MIN_VIEWS, BoardCalibration
from devrf.calibration.boards.find import find_board
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import BoardRig, rig_from_board
from devrf.calibration.rigs.bump import find_bump
from devrf.calibration.rigs.clean_picture import clean_pictures
from devrf.calibration.rigs.cross_check import cross_check
from devrf.calibration.rigs.given import Given
from devrf.calibration.rigs.graph import Link, camera_graph
from devrf.calibration.rigs.joint import adjust_together, disagreement, world_from_rig
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale, write_rig
from devrf.calibration.rigs.rig_cameras import rig_camera
from devrf.calibration.rigs.scale import combined, scale_from_board, scale_from_distances
from devrf.calibration.rigs.sweep_route import FixedCameraInput, SweepRig, rig_from_sweep
from devrf.calibration.sweep.static_poses import SweepModel, read_static_poses
from devrf.calibration.truth import similarity
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.measure import Measure, noted, of_test
from devrf.capture.system.errors import CalibrationError, HealthError, InputError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.pipelines.budget.at_once import registered_at_once
from devrf.pipelines.health.board_rows import board_measures
from devrf.pipelines.health.left_out import left_out
from devrf.pipelines.health.rig_rows import (
    bump_measures,
    graph_measures,
    joint_measures,
    route_measures,
    scale_measures,
    sweep_measures,
)
from devrf.pipelines.inputs.board_clips import BoardClips, files_of
from devrf.pipelines.inputs.board_spec import board_spec, lens_choice
from devrf.pipelines.inputs.given_calibration import given_calibration
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.rig.joint_clips import JointViews, read_joint_views

MIN_CAMERAS = 2  # of a rig from a board
SWEEP_BOARD_TRIES = 40  # sweep pictures that are searched for the board first; all, if it is seen in them


def run(context: StageContext) -> None:
    """Write `rig.json`, and in `clean/` the pictures of the fixed cameras that were registered."""
    job = _Job(context)
    route = job.route()
    rig = {"given": job.from_given, "sweep": job.from_sweep, "board": job.from_board}[route]()
    rig = job.with_test_cameras(rig)
    job.look_for_bumps()
    told = {
        n: c.details | {"board": job.boards[n].as_dict()} for n, c in rig.cameras.items() if n in job.boards
    }
    cameras = {n: replace(c, details=told.get(n, c.details)) for n, c in rig.cameras.items()}
    write_rig(context.out / "rig.json", replace(rig, cameras=cameras))
    for name, calibration in job.boards.items():
        found = board_measures(name, calibration)
        context.measures += found if name in job.trained else of_test(name, found)
    unmeasured_board = job.spec is not None and not job.board_is_measured
    context.measures += [*job.measures, *scale_measures(job.scales, rig.scale, unmeasured_board)]


class _Job:
    """What the routes share: frames, board, calibrations."""

    def __init__(self, context: StageContext) -> None:
        self.context = context
        self.ingest = context.run_dir / "ingest"
        self.frames = FrameSet.read(self.ingest)
        self.trained, self.tests = self.frames.trained, self.frames.tests
        self.spec = board_spec(context.config)
        self.clips = (
            None
            if self.spec is None
            else BoardClips(context.run_dir, self.frames, self.spec, lens_choice(context.config))
        )
        self.settings = context.config.calibration.rig
        self.sweep_folder = context.run_dir / "static_poses"
        self.has_sweep = (self.sweep_folder / "static_poses.json").is_file()
        self.measures: list[Measure] = []
        self.scales: list[Scale] = []
        self.boards: dict[str, BoardCalibration] = {}
        self.swept: SweepRig | None = None

    def route(self) -> str:
        """given, sweep or board."""
        method = self.settings.method
        joint = [name for name in self.trained if name in self.frames.joint]
        if method == "auto":
            has_rig = self.given is not None and self.given.rig is not None
            method = "given" if has_rig else "sweep" if self.has_sweep else "board"
        if method == "given" and (self.given is None or self.given.rig is None):
            what = "names no file" if self.given is None else "holds intrinsics only"
            raise InputError(
                "rig-without-poses",
                f"calibration.rig.method is given, but calibration.rig.given {what}; expected the poses of all "
                "cameras; film a sweep or a board and set method to auto",
            )
        if method == "sweep" and not self.has_sweep:
            text = "calibration.rig.method is sweep, but capture.static is missing; film a sweep or use board"
            raise InputError("sweep-missing", text)
        if method == "board":
            missing = [name for name in self.trained if name not in joint]
            if self.spec is None or len(joint) < MIN_CAMERAS or missing:
                raise InputError(
                    "rig-without-source",
                    "the rig needs a sweep (capture.static), a board that the cameras see at once "
                    "(capture.board.joint_clips) or a calibration file (calibration.rig.given); "
                    + (f"no joint clip of {', '.join(missing)}" if joint else "none of them is there"),
                )
        return method

    def from_given(self) -> Rig:
        """Route C: a calibration people own. Its world must be the sweep's where there is one."""
        assert self.given is not None and self.given.rig is not None
        return self._given_into_sweep(self.given.rig) if self.has_sweep else self.given.rig

    @property
    def board_is_measured(self) -> bool:
        """Whether there is a board whose squares have a known size."""
        board = self.context.config.board
        return board is not None and board.metric

    @cached_property
    def given(self) -> Given | None:
        """What `calibration.rig.given` names, at the sizes of the clips."""
        found = given_calibration(self.context.config, self.context.scene_dir, self.frames.moving)
        self.measures += () if found is None else found.measures
        return found

    @property
    def given_lenses(self) -> dict[str, Intrinsics]:
        """The intrinsics in it."""
        return {} if self.given is None else dict(self.given.intrinsics)

    def from_sweep(self) -> Rig:
        """Route A: one clean picture of each camera into the sweep's model; with joint clips one adjustment of both."""
        context, model = self.context, self.model
        known = self._clip_calibrations(self.trained, part(context.progress, 0.0, 0.3)) | self.given_lenses
        swept = self._register(model, self.trained, known, part(context.progress, 0.3, 0.6))
        cameras = {n: self._named_lens(n, c) for n, c in swept.cameras.items()}
        for name, c in cameras.items():
            self.measures += sweep_measures(name, c)
        context.progress(0.65, "metric scale")
        self.scales = self._scales(model, {n: c.camera.centre for n, c in cameras.items()})
        joint = [name for name in cameras if name in self.frames.joint]
        graph = camera_graph(swept.solution.problem, swept.index)
        if self.spec is not None and len(joint) >= MIN_CAMERAS:
            together = self._together(swept, cameras, joint, part(context.progress, 0.7, 0.3))
            if together is not None:
                cameras, graph = together
        self.swept = replace(swept, cameras=cameras)
        scale = combined(self.scales) if self.scales else ARBITRARY
        return Rig({n: _scaled(c, scale.factor) for n, c in cameras.items()}, scale, "sweep", graph)

    def from_board(self) -> Rig:
        """Route B: the board before several cameras at once; metres, in the first camera's frame."""
        seen, found = self._board_rig(list(self.trained), self.context.progress)
        index = {name: c for c, name in enumerate(found.views.names)}
        cameras = {name: self._of_board(name, seen, found) for name in index}
        if self.board_is_measured:
            self.scales = [Scale(True, "board seen by several cameras at once", 1.0, None)]
        scale = self.scales[0] if self.scales else ARBITRARY
        rig = Rig(cameras, scale, "board", camera_graph(found.solution.problem, index))
        self.measures += graph_measures(rig.graph, rig)
        return rig

    def with_test_cameras(self, rig: Rig) -> Rig:
        """The rig with its test cameras, each placed by itself against what stands; those that cannot be are named."""
        placed, missing = dict(rig.cameras), {}
        for name in self.tests:
            try:
                placed[name] = rig.cameras.get(name) or self._test_camera(name, rig)
            except (HealthError, InputError, CalibrationError) as error:
                missing[name] = str(error)
                self.measures.append(left_out(name, str(error)))
        return replace(rig, cameras=placed, left_out=missing)

    def _test_camera(self, name: str, rig: Rig) -> RigCamera:
        """A test camera in the sweep's world, or where there is no sweep in the board's."""
        alone = {name: self.tests[name]}
        if self.swept is None:
            return self._test_camera_by_board(name, rig)
        known = self._clip_calibrations(alone, no_progress) | self.given_lenses
        found = self._register(self.model, alone, known, self.context.progress, self.swept).cameras[name]
        found = self._named_lens(name, found)
        self.measures += of_test(name, sweep_measures(name, found))
        return _scaled(found, rig.scale.factor)

    def _test_camera_by_board(self, name: str, rig: Rig) -> RigCamera:
        """By the board that it sees at once with the others, which stay where they are."""
        if name not in self.frames.joint:
            text = f"camera '{name}' has no clip of the board that others see at once (capture.board.joint_clips)"
            raise CalibrationError("rig-without-source", text)
        seen, found = self._by_board([*self.trained, name], self.context.progress)
        camera = self._of_board(name, seen, found)
        into = world_from_rig({n: rig.cameras[n].camera for n in self.trained}, found.cameras)
        return replace(camera, camera=camera.camera.moved(into))

    def _of_board(self, name: str, seen: JointViews, found: BoardRig) -> RigCamera:
        """A camera as the joint clips show it, in the board rig's world."""
        c = found.views.names.index(name)
        support = np.flatnonzero(found.solution.problem.obs_camera == c)
        lens = "given" if name in self.given_lenses else "board"
        return rig_camera(found.solution, c, seen.start[name], lens, support, _clock(found, name))

    def _named_lens(self, name: str, camera: RigCamera) -> RigCamera:
        """The camera with what its lens is from, where that was given."""
        return replace(camera, intrinsics_source="given") if name in self.given_lenses else camera

    @cached_property
    def model(self) -> SweepModel:
        """The sweep, without what is held out of it."""
        return read_static_poses(self.sweep_folder).without_held_out(
            self.context.config.evaluate.holdout_every
        )

    def _together(
        self, swept: SweepRig, cameras: dict[str, RigCamera], names: list[str], progress: Progress
    ) -> tuple[dict[str, RigCamera], tuple[Link, ...]] | None:
        """Both routes compared, then one adjustment of both; None where the joint clips cannot be used."""
        try:
            seen, board = self._board_rig(names, progress)
        except HealthError as error:
            self.measures.append(Measure("rig-routes", str(error), why="unused"))
            return None
        ours = {n: c.camera for n, c in cameras.items()}
        joint = adjust_together(swept.solution, swept.index, ours, board)
        unit = joint.problem.unit
        found, same = route_measures(disagreement(ours, board.cameras), cameras, board, unit)
        self.measures += found
        if not same:
            self.measures.append(
                Measure("rig-routes", "the board's does not fit, the sweep's is used", why="unfit")
            )
            return None
        source = f"board seen at once by {', '.join(names)}"
        if self.board_is_measured:
            self.scales.append(Scale(True, source, 1 / unit, joint.unit_std))
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
                details | (_clock(board, name) if name in names else {}),
            )
        return out, camera_graph(joint.problem, swept.index)

    def look_for_bumps(self) -> None:
        """Whether the fixed cameras stayed where they were over their clips."""
        for name, camera in self.frames.moving.items():
            seen = camera.filmed(self.ingest)
            self.measures += bump_measures(name, find_bump([f.file for f in seen], [f.time_s for f in seen]))

    def _register(
        self,
        model: SweepModel,
        cameras: Mapping[str, CameraFrames],
        known: dict[str, Intrinsics],
        progress: Progress,
        standing: SweepRig | None = None,
    ) -> SweepRig:
        clean = self.context.out / "clean"
        clean.mkdir(exist_ok=True)
        rest, inputs = self.context.config.rest, []
        for name, camera in cameras.items():
            pictures = clean_pictures(name, files_of(self.context.run_dir, camera), rest, clean)
            inputs.append(
                FixedCameraInput(
                    name, pictures, camera.width, camera.height, known.get(name), camera.pixel_aspect
                )
            )
        at_once = registered_at_once(self.context, list(cameras.values()), len(model.names))
        found = rig_from_sweep(model, inputs, self.context.out, progress, at_once, standing)
        used = {c.details["picture"] for c in found.cameras.values()}
        for picture in (path for item in inputs for path in item.pictures):
            if picture.stem not in used:
                picture.unlink()
        return found

    def _clip_calibrations(
        self, cameras: Mapping[str, CameraFrames], progress: Progress
    ) -> dict[str, Intrinsics]:
        """Intrinsics from each camera's own board clip, else from its joint clip where that shows enough."""
        if self.clips is None:
            return {}
        for n, name in enumerate(cameras):
            own, joint = self.clips.own(name), self.frames.joint.get(name)
            entry = own or joint
            if entry is None:
                continue
            step = part(progress, n / len(cameras), 1 / len(cameras))
            clip = self.clips.search(name, entry, progress=step, required=own is not None)
            if own is not None or len(clip.views) >= MIN_VIEWS:
                self.boards[name] = clip.calibration
        return {name: board.intrinsics for name, board in self.boards.items() if name in cameras}

    def _board_rig(self, names: list[str], progress: Progress) -> tuple[JointViews, BoardRig]:
        """Cameras from the joint clips, with clocks applied, and what they measure on views kept out of a fit."""
        seen, found = self._by_board(names, progress)
        progress(0.9, "held-out lengths")
        measured = self.board_is_measured  # without a measured square there are no millimetres to check
        check = cross_check(seen.views, seen.spec, seen.start, seen.known) if measured else None
        self.measures += joint_measures(found, check)
        return seen, found

    def _by_board(self, names: list[str], progress: Progress) -> tuple[JointViews, BoardRig]:
        assert self.clips is not None
        known = self.given_lenses
        for name in names:
            own = self.clips.own(name)
            if name not in known and own is not None:
                self.boards[name] = self.clips.search(name, own).calibration
                known[name] = self.boards[name].intrinsics
        seen = read_joint_views(self.clips, names, known, part(progress, 0.0, 0.7))
        self.boards = seen.own | self.boards
        return seen, rig_from_board(seen.views, seen.spec, seen.start, seen.known, part(progress, 0.7, 0.2))

    def _scales(self, model: SweepModel, centres: dict[str, np.ndarray]) -> list[Scale]:
        """Metres from the board in the sweep and from a known distance."""
        found: list[Scale] = []
        if self.board_is_measured:
            scale, text = self._scale_from_sweep_board(model)
            found += [] if scale is None else [scale]
            self.measures += noted([text] if scale is None and text else [], "board in the sweep")
        distance = self.settings.known_distance_m
        if distance is not None:
            first, second = list(centres)[:2]
            true = {first: np.zeros(3), second: np.array([distance, 0.0, 0.0])}
            scale = scale_from_distances(true, centres, f"known distance from {first} to {second}")
            found += [] if scale is None else [scale]
        return found

    def _scale_from_sweep_board(self, model: SweepModel) -> tuple[Scale | None, str]:
        assert self.spec is not None
        files = [self.ingest / "frames" / name for name in model.names]
        step = max(1, len(files) // SWEEP_BOARD_TRIES)
        views, spec = find_board("the sweep", files[::step], self.spec, required=False)
        if not views:
            return None, ""
        if step > 1:
            views, spec = find_board("the sweep", files, self.spec, required=False)
        return scale_from_board(views, list(model.cameras), spec)

    def _given_into_sweep(self, rig: Rig) -> Rig:
        """A given rig moved into the sweep's world by registering its cameras there; metres stay metres."""
        assert self.given is not None
        found = self._register(self.model, self.trained, self.given.intrinsics, self.context.progress).cameras
        if len(found) < 3:
            raise InputError(
                "rig-given-untied",
                "calibration.rig.given: fewer than three cameras do not tie a given rig to the sweep; "
                "set calibration.rig.method to sweep",
            )
        names = list(found)
        sweep_from_given = similarity(
            np.array([rig.cameras[n].camera.centre for n in names]),
            np.array([found[n].camera.centre for n in names]),
        )
        unit = float(np.cbrt(np.linalg.det(sweep_from_given[:3, :3])))
        metres = np.diag([1 / unit, 1 / unit, 1 / unit, 1.0])
        world_from_given = metres @ sweep_from_given
        cameras = {n: replace(c, camera=c.camera.moved(world_from_given)) for n, c in rig.cameras.items()}
        miss = max(
            float(np.linalg.norm(cameras[n].camera.centre - found[n].camera.centre / unit)) for n in names
        )
        distance = float(np.median([c.details["median_distance"] for c in found.values()])) / unit
        self.measures.append(Measure("rig-given-moved", 100 * miss / max(distance, 1e-9)))
        return Rig(cameras, replace(rig.scale, factor=1 / unit), "given")


def _clock(board: BoardRig, name: str) -> dict[str, float]:
    """What has to be added to a camera's times to have the first camera's clock, for rig.json."""
    n = board.views.names.index(name)
    return {"delay_ms": 1e3 * board.delay_s[name], "delay_std_ms": 1e3 * float(board.solution.delay_std_s[n])}


def _scaled(c: RigCamera, factor: float) -> RigCamera:
    """The camera in a world whose lengths are `factor` times larger."""
    similarity_matrix = np.diag([factor, factor, factor, 1.0])
    lengths = ("axis_std", "sideways_std", "median_distance")
    details = {k: v * factor if k in lengths and v is not None else v for k, v in c.details.items()}
    if "position_covariance" in details:
        details["position_covariance"] = (np.array(details["position_covariance"]) * factor**2).tolist()
    std = None if c.position_std is None else c.position_std * factor
    return replace(c, camera=c.camera.moved(similarity_matrix), position_std=std, details=details)
