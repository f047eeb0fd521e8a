"""Stage `rig`: the fixed cameras in one world with the sweep, their doubts, and the length of a unit."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from devrf.calibration.board import BoardSpec, find_board
from devrf.calibration.board_intrinsics import MIN_VIEWS, BoardCalibration, calibrate_intrinsics
from devrf.calibration.clean_picture import clean_pictures
from devrf.calibration.given import Given
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rig import ARBITRARY, Rig, RigCamera, Scale, write_rig
from devrf.calibration.rig_board import BoardRig, TimedView, joint_prior, rig_from_board
from devrf.calibration.rig_sweep import FixedCameraInput, rig_from_sweep
from devrf.calibration.scale import scale_from_board, scale_from_distances
from devrf.calibration.static_poses import SweepModel, read_static_poses
from devrf.calibration.truth import rotation_angle_deg, similarity
from devrf.capture.errors import HealthError, InputError
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.pipelines.board_spec import board_spec
from devrf.pipelines.clocks import read_clocks
from devrf.pipelines.given_calibration import given_calibration
from devrf.pipelines.health import HealthRow, note, row
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.static_poses import board_rows

MIN_CAMERAS = 2  # of a rig from a board
SWEEP_BOARD_TRIES = 40  # sweep pictures that are searched for the board first; all, if it is seen in them


def run(context: StageContext) -> None:
    """Write `rig.json`, and in `clean/` the pictures of the fixed cameras that were registered."""
    job = _Job(context)
    route = job.route()
    rig = {"given": job.from_given, "sweep": job.from_sweep, "board": job.from_board}[route]()
    write_rig(context.out / "rig.json", rig)
    context.health.extend([*job.rows, *health(rig)])


class _Job:
    """What the routes share: frames, board, calibrations."""

    def __init__(self, context: StageContext) -> None:
        self.context = context
        self.ingest = context.run_dir / "ingest"
        self.frames = FrameSet.read(self.ingest)
        self.moving = self.frames.moving
        self.spec = board_spec(context.config)
        self.settings = context.config.calibration.rig
        self.sweep_folder = context.run_dir / "static_poses"
        self.has_sweep = (self.sweep_folder / "static_poses.json").is_file()
        self.rows: list[HealthRow] = []

    def route(self) -> str:
        """given, sweep or board."""
        method = self.settings.method
        joint = [name for name in self.moving if name in self.frames.joint]
        if method == "auto":
            has_rig = self.given is not None and self.given.rig is not None
            method = "given" if has_rig else "sweep" if self.has_sweep else "board"
        if method == "given" and (self.given is None or self.given.rig is None):
            what = "names no file" if self.given is None else "holds intrinsics only"
            raise InputError(
                f"calibration.rig.method is given, but calibration.rig.given {what}; expected the poses of all "
                "cameras; film a sweep or a board and set method to auto"
            )
        if method == "sweep" and not self.has_sweep:
            raise InputError(
                "calibration.rig.method is sweep, but capture.static is missing; film a sweep or use board"
            )
        if method == "board":
            missing = [name for name in self.moving if name not in joint]
            if self.spec is None or len(joint) < MIN_CAMERAS or missing:
                raise InputError(
                    "the rig needs a sweep (capture.static), a board that the cameras see at once "
                    "(capture.board.joint_clips) or a calibration file (calibration.rig.given); "
                    + (f"no joint clip of {', '.join(missing)}" if joint else "none of them is there")
                )
        return method

    def from_given(self) -> Rig:
        """Route C: a calibration people own. Its world must be the sweep's where there is one."""
        assert self.given is not None and self.given.rig is not None
        return self._given_into_sweep(self.given.rig) if self.has_sweep else self.given.rig

    @cached_property
    def given(self) -> Given | None:
        """What `calibration.rig.given` names, at the sizes of the clips."""
        sizes = {name: (c.width, c.height) for name, c in self.moving.items()}
        found = given_calibration(self.context.config, self.context.scene_dir, sizes)
        for n in () if found is None else found.notes:
            self.rows.append(note(n.check, n.text, verdict="warn" if n.remedy else "ok", remedy=n.remedy))
        return found

    def from_sweep(self) -> Rig:
        """Route A: one clean picture of each camera into the sweep's model."""
        context = self.context
        model = read_static_poses(self.sweep_folder)
        calibrations = self._clip_calibrations(_part(context.progress, 0.0, 0.3))
        known = {name: c.intrinsics for name, c in calibrations.items()}
        given = {} if self.given is None else self.given.intrinsics
        cameras = self._register(model, known | given, _part(context.progress, 0.3, 0.7))
        cameras = {n: replace(c, intrinsics_source="given") if n in given else c for n, c in cameras.items()}
        context.progress(0.75, "metric scale")
        scale = self._scale(model, cameras)
        return Rig({name: _scaled(c, scale.factor) for name, c in cameras.items()}, scale, "sweep")

    def from_board(self) -> Rig:
        """Route B: the board before several cameras at once; metres, in the first camera's frame."""
        found, calibrations = self._board_rig(list(self.moving), self.context.progress)
        self.rows += _board_rig_rows(found)
        cameras = {}
        for name, camera in found.cameras.items():
            cameras[name] = RigCamera(
                camera,
                "board",
                found.rotation_std_deg[name],
                found.position_std_m[name],
                found.corners[name],
                found.rms_px,
                {"focal_px": float(camera.K[0, 0]), "board_rms_px": calibrations[name].rms_px},
            )
        return Rig(cameras, Scale(True, "board seen by several cameras at once", 1.0, None), "board")

    def _register(
        self, model: SweepModel, known: dict[str, Intrinsics], progress: Callable[[float, str], None]
    ) -> dict[str, RigCamera]:
        clean = self.context.out / "clean"
        clean.mkdir()
        rest = self.context.config.capture.rest if self.context.config.capture else "none"
        inputs = []
        for name, camera in self.moving.items():
            pictures = clean_pictures(name, self._files(camera), rest, clean)
            inputs.append(FixedCameraInput(name, pictures, camera.width, camera.height, known.get(name)))
        cameras = rig_from_sweep(model, inputs, self.context.out, progress)
        used = {c.details["picture"] for c in cameras.values()}
        for picture in clean.iterdir():
            if picture.stem not in used:
                picture.unlink()
        return cameras

    def _clip_calibrations(self, progress: Callable[[float, str], None]) -> dict[str, BoardCalibration]:
        """Intrinsics from each camera's own board clip, else from its joint clip."""
        if self.spec is None:
            return {}
        out: dict[str, BoardCalibration] = {}
        for n, (name, camera) in enumerate(self.moving.items()):
            clip, required = self.frames.cameras.get(f"board_{name}"), True
            if clip is None and name in self.frames.joint:
                clip, required = self.frames.cameras[self.frames.joint[name]], False
            if clip is None:
                continue
            step = _part(progress, n / len(self.moving), 1 / len(self.moving))
            views, spec = find_board(
                f"{clip.source} of camera '{name}'", self._files(clip), self.spec, step, required
            )
            if not required and len(views) < MIN_VIEWS:
                continue
            size = (clip.width, clip.height)
            if size != (camera.width, camera.height):
                raise InputError(
                    f"board clip {clip.source} is {size[0]}x{size[1]}, camera '{name}' films "
                    f"{camera.width}x{camera.height}; film the board in the same mode as the scene"
                )
            out[name] = calibrate_intrinsics(name, views, spec, size)
            self.rows += board_rows(name, out[name])
        return out

    def _board_rig(
        self, names: list[str], progress: Callable[[float, str], None]
    ) -> tuple[BoardRig, dict[str, BoardCalibration]]:
        """Cameras from the joint clips, with clocks applied."""
        assert self.spec is not None
        clocks = read_clocks(self.context.run_dir / "sync" / "sync.json")
        views: dict[str, list[TimedView]] = {}
        calibrations: dict[str, BoardCalibration] = {}
        priors: dict[str, Intrinsics] = {}
        spec: BoardSpec = self.spec
        for n, name in enumerate(names):
            entry = self.frames.joint[name]
            clip = self.frames.cameras[entry]
            step = _part(progress, 0.8 * n / len(names), 0.8 / len(names))
            seen, spec = find_board(f"{clip.source} of camera '{name}'", self._files(clip), self.spec, step)
            times = [frame.time_s for frame in clip.used if frame.file is not None]
            offset_s, rate = clocks.get(entry, (0.0, 1.0))
            views[name] = [
                TimedView(view, offset_s + rate * t) for view in seen if (t := times[view.frame]) is not None
            ]
            own = self.frames.cameras.get(f"board_{name}")
            size = (clip.width, clip.height)
            if own is None:
                calibrations[name] = calibrate_intrinsics(name, seen, spec, size)
                priors[name] = joint_prior(calibrations[name].intrinsics)
            else:
                own_views, _ = find_board(f"{own.source} of camera '{name}'", self._files(own), self.spec)
                calibrations[name] = calibrate_intrinsics(name, own_views, spec, size)
                priors[name] = calibrations[name].intrinsics
        start = {name: c.intrinsics for name, c in calibrations.items()}
        found = rig_from_board(views, spec, start, priors, _part(progress, 0.8, 0.2))
        for name, calibration in calibrations.items():
            self.rows += board_rows(name, calibration)
        return found, calibrations

    def _scale(self, model: SweepModel, cameras: dict[str, RigCamera]) -> Scale:
        """Metres from the board in the sweep, cameras that saw a board at once, or a known distance."""
        found: list[Scale] = []
        if self.spec is not None:
            scale, text = self._scale_from_sweep_board(model)
            if scale is not None:
                found.append(scale)
            elif text:
                self.rows.append(note("board in the sweep", text))
        centres = {name: c.camera.centre for name, c in cameras.items()}
        joint = [name for name in cameras if name in self.frames.joint]
        if self.spec is not None and len(joint) >= MIN_CAMERAS:
            found += self._scale_from_joint_clips(joint, cameras)
        distance = self.settings.known_distance_m
        if distance is not None:
            first, second = list(cameras)[:2]
            ours = {name: centres[name] for name in (first, second)}
            true = {first: np.zeros(3), second: np.array([distance, 0.0, 0.0])}
            scale = scale_from_distances(true, ours, f"known distance from {first} to {second}")
            found += [] if scale is None else [scale]
        if not found:
            return ARBITRARY
        for other in found[1:]:
            self.rows.append(
                row(
                    f"scale: {found[0].source} against {other.source}",
                    100 * abs(other.factor / found[0].factor - 1),
                    "%",
                    warn=1.0,
                    low_is_bad=False,
                    remedy="Two measures of length disagree: measure the squares and the distance again.",
                )
            )
        return found[0]

    def _scale_from_sweep_board(self, model: SweepModel) -> tuple[Scale | None, str]:
        assert self.spec is not None
        files = [self.ingest / "frames" / name for name in model.names]
        step = max(1, len(files) // SWEEP_BOARD_TRIES)
        tries, _ = find_board("the sweep", files[::step], self.spec, required=False)
        if not tries:
            return None, ""
        views, spec = find_board("the sweep", files, self.spec, required=False)
        return scale_from_board(views, list(model.cameras), spec)

    def _scale_from_joint_clips(self, names: list[str], cameras: dict[str, RigCamera]) -> list[Scale]:
        """Metres from the joint clips, and how far the two routes to the rig differ."""
        try:
            found, _ = self._board_rig(names, lambda fraction, message: None)
        except HealthError as error:
            self.rows.append(
                note("rig from the board", str(error), verdict="warn", remedy="Not used for the scale.")
            )
            return []
        metric = {name: c.centre for name, c in found.cameras.items()}
        ours = {name: cameras[name].camera.centre for name in names}
        scale = scale_from_distances(metric, ours, f"board seen at once by {', '.join(names)}")
        if len(names) >= 3:
            turn = similarity(np.array([ours[n] for n in names]), np.array([metric[n] for n in names]))
            R = turn[:3, :3] / np.cbrt(np.linalg.det(turn[:3, :3]))
            worst = max(
                rotation_angle_deg(
                    R @ cameras[n].camera.cam_from_world[:, :3].T, found.cameras[n].cam_from_world[:, :3].T
                )
                for n in names
            )
            self.rows.append(
                row(
                    "rig from the sweep against the rig from the board",
                    worst,
                    "deg",
                    warn=1.0,
                    low_is_bad=False,
                    remedy="The two routes disagree: was a camera touched between the clips?",
                )
            )
        return [] if scale is None else [scale]

    def _given_into_sweep(self, rig: Rig) -> Rig:
        """A given rig moved into the sweep's world by registering its cameras there; metres stay metres."""
        model = read_static_poses(self.sweep_folder)
        assert self.given is not None
        found = self._register(model, self.given.intrinsics, self.context.progress)
        if len(found) < 3:
            raise InputError(
                "calibration.rig.given: fewer than three cameras do not tie a given rig to the sweep; "
                "set calibration.rig.method to sweep"
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
        self.rows.append(
            row(
                "given rig against its registration in the sweep",
                100
                * miss
                / max(float(np.median([c.details["median_distance"] for c in found.values()])) / unit, 1e-9),
                "% of distance",
                warn=1.0,
                fail=5.0,
                low_is_bad=False,
                remedy="The given calibration does not fit what the cameras see: a camera was moved since.",
            )
        )
        return Rig(cameras, replace(rig.scale, factor=1 / unit), "given")

    def _files(self, camera: CameraFrames) -> list[Path]:
        return [self.ingest / frame.file for frame in camera.used if frame.file is not None]


def health(rig: Rig) -> list[HealthRow]:
    """Rows about each camera's support and about the scale."""
    rows: list[HealthRow] = []
    for name, c in rig.cameras.items():
        if rig.route == "sweep":
            rows += _sweep_rows(name, c)
    s = rig.scale
    if s.metric:
        std = "" if s.std is None else f", +- {100 * s.std:.2f} %"
        rows.append(note("scale", f"metres: {s.source}{std}"))
    else:
        remedy = "Lengths are not metres: let a board stand in the scene during the sweep (capture.board)."
        rows.append(note("scale", ARBITRARY.source, verdict="warn", remedy=remedy))
    return rows


def _sweep_rows(name: str, c: RigCamera) -> list[HealthRow]:
    d: dict[str, Any] = c.details
    rows = [
        row(
            f"points that {name} shares with the sweep",
            c.inliers,
            "",
            warn=100,
            fail=30,
            remedy=f"Film sweep pictures from near {name}, looking the same way; match exposure and colour.",
        ),
        row(
            f"share of the picture that {name}'s points cover",
            d.get("inlier_area"),
            "",
            warn=0.2,
            remedy=f"All points of {name} lie in one corner: film sweep pictures of what it sees elsewhere.",
        ),
    ]
    if c.position_std is not None and d.get("median_distance"):
        rows.append(
            row(
                f"position of {name}, standard deviation",
                100 * c.position_std / d["median_distance"],
                "% of distance",
                warn=0.5,
                low_is_bad=False,
                remedy=f"Focal length and distance trade off: film a board (capture.board.clips.{name}).",
            )
        )
    return rows


def _board_rig_rows(rig: BoardRig) -> list[HealthRow]:
    weakest = min(rig.links, key=lambda pair: rig.links[pair])
    dropped = ", ".join(f"{name} {frame}" for name, frame in rig.dropped) or "none"
    return [
        row(
            "reprojection error of the board rig, robust",
            rig.sigma_px,
            "px",
            warn=1.0,
            fail=4.0,
            low_is_bad=False,
            remedy="Move the board slowly and rest it often, use a flat, rigid print, and sync the cameras.",
        ),
        row(
            f"corners seen at once, weakest link ({weakest[0]}, {weakest[1]})",
            rig.links[weakest],
            "",
            warn=200,
            remedy=f"Hold the board where {weakest[0]} and {weakest[1]} both see it, for longer.",
        ),
        row(
            "time between views that count as one, largest",
            rig.gap_ms[1],
            "ms",
            warn=50.0,
            low_is_bad=False,
            remedy="The cameras do not expose together: move the board slowly, or rest it.",
        ),
        note("board views that do not fit", dropped),
    ]


def _scaled(c: RigCamera, factor: float) -> RigCamera:
    """The camera in a world whose lengths are `factor` times larger."""
    similarity_matrix = np.diag([factor, factor, factor, 1.0])
    lengths = ("axis_std", "sideways_std", "median_distance")
    details = {k: v * factor if k in lengths else v for k, v in c.details.items()}
    std = None if c.position_std is None else c.position_std * factor
    return replace(c, camera=c.camera.moved(similarity_matrix), position_std=std, details=details)


def _part(progress: Callable[[float, str], None], start: float, share: float) -> Callable[[float, str], None]:
    """A part of a larger piece of work."""
    return lambda fraction, message: progress(start + share * fraction, message)
