"""Stage `colour`: every camera brought to the look of the sweep's, or of the first camera where there is no sweep."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from devrf.calibration.colour.camera_points import camera_pairs
from devrf.calibration.colour.colours import CameraColour, Colours
from devrf.calibration.colour.flicker import steady_gains
from devrf.calibration.colour.match import Apart, Matched, match_cameras
from devrf.calibration.colour.surface import Pairs, View
from devrf.calibration.colour.sweep_points import SweepPoints, sweep_pairs
from devrf.calibration.rigs.clean_picture import REST_MOMENTS, rest_frames
from devrf.calibration.rigs.rig import ARBITRARY, Rig, read_rig
from devrf.calibration.sweep.static_poses import read_static_poses
from devrf.capture.colour.correction import Look, as_matrix
from devrf.capture.colour.light_course import LightCourse
from devrf.capture.frames import SWEEP, FrameSet, PictureFile
from devrf.capture.photos.picture_files import read_pixels
from devrf.pipelines.health.colour_rows import colour_measures
from devrf.pipelines.run_folder.clocks import read_clocks
from devrf.pipelines.stage import StageContext

# at which cameras are compared without a sweep: the subject shows several sides, in a minute's work
MOMENTS = 8


def run(context: StageContext) -> None:
    """Write `colour.json`, and where needed `gains_<camera>.npy`."""
    job = _Job(context)
    colours = job.colours()
    colours.write()
    context.measures += colour_measures(colours)


class _Job:
    """What is compared with what."""

    def __init__(self, context: StageContext) -> None:
        self.context = context
        self.ingest = context.run_dir / "ingest"
        self.frames = FrameSet.read(self.ingest)
        rig = context.run_dir / "rig" / "rig.json"
        self.rig = read_rig(rig) if self.frames.moving else Rig({}, ARBITRARY)
        self.trained = [name for name in self.frames.trained if name in self.rig.cameras]
        self.test_cameras = {name for name in self.frames.tests if name in self.rig.cameras}
        poses = context.run_dir / "static_poses"
        in_sweep = (poses / "static_poses.json").is_file() and self.rig.route != "board"
        every = context.config.evaluate.holdout_every
        self.model = read_static_poses(poses).without_held_out(every) if in_sweep else None
        self.reference = SWEEP if self.model is not None else self.trained[0]
        self.base = self._before_matching()

    def colours(self) -> Colours:
        """All cameras with what corrects them: those that are trained on together, test cameras against these."""
        if self.context.config.calibration.colour.method == "none":
            return self.base
        pairs = self._surface_pairs(self.trained)
        matched = match_cameras(pairs, self.reference)
        cameras = _with_match(self.base.cameras, matched)
        for name in sorted(self.test_cameras):  # of test pictures nothing is fitted
            measured = match_cameras([*pairs, *self._pairs_of_test(name)], self.reference, {name})
            cameras = _with_match(cameras, measured.only(name))
        return replace(self.base, reference=self.reference, cameras=cameras, total=matched.total)

    def _before_matching(self) -> Colours:
        """Unsteady light, as ingest measured it."""
        out, cameras = self.context.out, {}
        placed = [name for name in self.frames.moving if name in self.rig.cameras]
        for name in [*([SWEEP] if SWEEP in self.frames.cameras else []), *placed]:
            camera = CameraColour("reference" if name == self.reference else "none")
            light = self.ingest / "light" / f"{name}.npy"
            if light.is_file() and name not in self.frames.tests:
                course = LightCourse.read(light)
                gains = steady_gains(course)
                if gains is not None:
                    np.save(out / f"gains_{name}.npy", np.column_stack([course.index, gains]))
                    camera = replace(camera, gains=f"gains_{name}.npy")
            cameras[name] = camera
        return Colours(out, None, cameras, Apart(0, None, None))

    def _pairs_of_test(self, name: str) -> list[Pairs]:
        """Surface points that a test camera and others see."""
        pairs = self._surface_pairs([name] if self.model is not None else [*self.trained, name])
        return [pair for pair in pairs if name in (pair.first, pair.second)]

    def _surface_pairs(self, names: Sequence[str]) -> list[Pairs]:
        """Surface points that two cameras see, of these and the sweep's."""
        if self.model is None:
            return camera_pairs(self._moments(names))
        model, pairs = self.model, []

        def read(name: str) -> UInt8[np.ndarray, "_ _ 3"]:
            return np.ascontiguousarray(read_pixels(self.ingest / "frames" / name)[..., :3])

        for n, name in enumerate(names):
            self.context.progress(0.2 + 0.8 * n / len(names), f"points of {name}")
            view = View(self.rig.cameras[name].camera, self._clean(name))
            pairs.append(sweep_pairs(name, view, SweepPoints(model, self.rig.scale.factor, read)))
        return pairs

    def _clean(self, name: str) -> UInt8[np.ndarray, "_ _ 3"]:
        """The picture that was registered into the sweep, in steady light."""
        folder, used = self.context.run_dir / "rig" / "clean", self.frames.moving[name].used
        path = folder / f"{name}_clip.png"
        look = Look()  # a median of the whole clip has the clip's usual light
        for moment in REST_MOMENTS:
            at_rest = folder / f"{name}_{moment}.png"
            if at_rest.is_file():
                frames = rest_frames(moment, len(used))
                path, look = at_rest, self.base.before_matching(name, used[frames[len(frames) // 2]].index)
        return look.apply(read_pixels(path)[..., :3])

    def _moments(self, names: Sequence[str]) -> Iterator[dict[str, View]]:
        """Pictures of these cameras at a few moments that all of them saw."""
        clocks = read_clocks(self.context.run_dir)
        shown = {name: self.frames.moving[name].filmed(self.ingest) for name in names}
        times = {
            name: clocks[name].true_time(np.array([f.time_s for f in of])) for name, of in shown.items() if of
        }
        if len(times) < 2:
            return
        from_s, to_s = max(t[0] for t in times.values()), min(t[-1] for t in times.values())
        moments_s = np.linspace(from_s, to_s, MOMENTS + 2)[1:-1]  # clips begin and end with hands on cameras
        # by frames: a clip of a few frames has fewer moments
        moments = {tuple(int(np.argmin(np.abs(t - s))) for t in times.values()): float(s) for s in moments_s}
        for n, (frames, time_s) in enumerate(moments.items()):
            self.context.progress(0.2 + 0.8 * n / len(moments), f"what cameras share at {time_s:.1f} s")
            yield {name: self._view(name, shown[name][k]) for name, k in zip(times, frames, strict=True)}

    def _view(self, name: str, frame: PictureFile) -> View:
        look = self.base.before_matching(name, frame.index)
        rgb = look.apply(read_pixels(frame.file)[..., :3])
        return View(self.rig.cameras[name].camera, rgb)


def _with_match(cameras: dict[str, CameraColour], matched: Matched) -> dict[str, CameraColour]:
    """The cameras with what a match has found of them."""
    out = dict(cameras)
    for name, apart in matched.apart.items():
        stops, stops_std = matched.brightness.get(name, (None, None))
        out[name] = replace(out[name], apart=apart, stops=stops, stops_std=stops_std)
        if name in matched.corrections:
            found, fitted = matched.corrections[name], matched.fitted[name]
            matrix = as_matrix(found.matrix)
            out[name] = replace(out[name], source="points", kind=found.kind, matrix=matrix, fitted=fitted)
    return out
