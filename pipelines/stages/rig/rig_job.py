"""What the routes to a rig share: frames, board, calibrations, and what was learned on the way."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from devrf.calibration.boards.calibrate import MIN_VIEWS, BoardCalibration
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import BoardRig, rig_from_board
from devrf.calibration.rigs.clean_picture import clean_pictures
from devrf.calibration.rigs.cross_check import cross_check
from devrf.calibration.rigs.given import Given
from devrf.calibration.rigs.rig import RigCamera, Scale
from devrf.calibration.rigs.rig_cameras import rig_camera
from devrf.calibration.rigs.sweep_route import FixedCameraInput, SweepRig, rig_from_sweep
from devrf.calibration.sweep.static_poses import SweepModel, read_static_poses
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.measure import Measure
from devrf.capture.system.errors import CalibrationError, HealthError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.pipelines.budget.at_once import registered_at_once
from devrf.pipelines.health.board_rows import board_measures, fits
from devrf.pipelines.health.rig_rows import (
    joint_measures,
)
from devrf.pipelines.inputs.board_clips import BoardClips, files_of
from devrf.pipelines.inputs.board_spec import board_spec, lens_choice
from devrf.pipelines.inputs.given_calibration import given_calibration
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.rig.joint_clips import JointViews, read_joint_views


class RigJob:
    """What the routes share: frames, board, calibrations."""

    def __init__(self, context: StageContext) -> None:
        self.context = context
        self.ingest = context.run_dir / "ingest"
        self.frames = FrameSet.read(self.ingest)
        self.no_lens = self.frames.without_lens
        self.trained, self.tests = (
            {name: c for name, c in of.items() if name not in self.no_lens}
            for of in (self.frames.trained, self.frames.tests)
        )
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

    def leave_out(self, cameras: Mapping[str, str]) -> None:
        """Say that nothing is used of these cameras that were to be trained on, and why."""
        self.measures += [
            Measure("camera-left-out", "no place in the rig", name, facts={"reason": f"{why}."})
            for name, why in cameras.items()
        ]

    @cached_property
    def model(self) -> SweepModel:
        """The sweep, without what is held out of it."""
        return read_static_poses(self.sweep_folder).without_held_out(
            self.context.config.evaluate.holdout_every
        )

    def register(
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

    def clip_calibrations(
        self, cameras: Mapping[str, CameraFrames], progress: Progress
    ) -> dict[str, Intrinsics]:
        """Intrinsics from each camera's own board clip, else from its joint clip where that shows enough.

        A camera whose clip says nothing, or does not fit, goes without, as one that has no such clip.

        Raises:
            HealthError: The board is seen in none of the clips that were filmed for it: it is another one than told.
        """
        if self.clips is None:
            return {}
        unseen: dict[str, HealthError] = {}
        for n, name in enumerate(cameras):
            own, joint = self.clips.own(name), self.frames.joint.get(name)
            entry = own or joint
            if entry is None:
                continue
            step = part(progress, n / len(cameras), 1 / len(cameras))
            try:
                clip = self.clips.search(name, entry, progress=step, required=own is not None)
                if own is None and len(clip.views) < MIN_VIEWS:
                    continue
                if fits(clip.calibration):
                    self.boards[name] = clip.calibration
                else:
                    self.measures += board_measures(name, clip.calibration)
            except HealthError as error:
                unseen[name] = error
        if unseen and not self.boards:
            raise next(iter(unseen.values()))
        for name, error in unseen.items():
            whose, facts = f"board clip of {name}", {"error": str(error)}
            self.measures.append(Measure("board-unseen", "never", whose, "never", facts))
        return {name: board.intrinsics for name, board in self.boards.items() if name in cameras}

    def board_rig(self, names: list[str], progress: Progress) -> tuple[JointViews, BoardRig]:
        """Cameras from the joint clips, with clocks applied, and what they measure on views kept out of a fit."""
        seen, found = self.by_board(names, progress)
        progress(0.9, "held-out lengths")
        measured = self.board_is_measured  # without a measured square there are no millimetres to check
        check = cross_check(seen.views, seen.spec, seen.start, seen.known) if measured else None
        self.measures += joint_measures(found, check)
        return seen, found

    def by_board(self, names: list[str], progress: Progress) -> tuple[JointViews, BoardRig]:
        assert self.clips is not None
        known = self.given_lenses
        with_own = {n: self.frames.moving[n] for n in names if n not in known and self.clips.own(n)}
        known |= self.clip_calibrations(with_own, no_progress)
        seen = read_joint_views(self.clips, names, known, part(progress, 0.0, 0.7))
        self.boards = seen.own | self.boards
        found = rig_from_board(seen.views, seen.spec, seen.start, seen.known, part(progress, 0.7, 0.2))
        return seen, replace(found, left_out=seen.left_out | found.left_out)

    def of_board(self, name: str, seen: JointViews, found: BoardRig) -> RigCamera:
        """A camera as the joint clips show it, in the board rig's world.

        Raises:
            CalibrationError: They do not tie it to the others.
        """
        if name not in found.views.names:
            raise CalibrationError("rig-unlinked-camera", found.left_out[name])
        c = found.views.names.index(name)
        support = np.flatnonzero(found.solution.problem.obs_camera == c)
        lens = "given" if name in self.given_lenses else "board"
        return rig_camera(found.solution, c, seen.start[name], lens, support, clock_of(found, name))

    def named_lens(self, name: str, camera: RigCamera) -> RigCamera:
        """The camera with what its lens is from, where that was given."""
        return replace(camera, intrinsics_source="given") if name in self.given_lenses else camera


def clock_of(board: BoardRig, name: str) -> dict[str, float]:
    """What has to be added to a camera's times to have the first camera's clock, for rig.json."""
    n = board.views.names.index(name)
    return {"delay_ms": 1e3 * board.delay_s[name], "delay_std_ms": 1e3 * float(board.solution.delay_std_s[n])}
