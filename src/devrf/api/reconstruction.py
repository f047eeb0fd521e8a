"""A trained scene as arrays: its cameras, pictures of any view at any time, its surface, its parts and their motion.

Everything is in the world of the calibration: OpenCV axes (x right, y down, z forward of a camera), metres where
`metric`, else of arbitrary scale. Times are seconds on the first camera's clock; None is the scene at rest.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from devrf.capture.camera import Camera
from devrf.capture.frames import some
from devrf.capture.scene import PosedFrame, Scene, by_camera
from devrf.capture.system.durable import read_json
from devrf.capture.system.errors import InputError
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.run_folder.outcomes import check_made
from devrf.pipelines.run_folder.trained_model import trained_scene

if TYPE_CHECKING:  # they need torch
    from devrf.reconstruct.geometry.cloud import Cloud
    from devrf.reconstruct.rendering.model import DynamicModel

SLACK = 1e-6  # of the clip, by which a time may lie outside: rounding


class RenderedView(NamedTuple):
    """A picture of the model.

    Attributes:
        colour: RGB in [0, 1], gamma-encoded, with what surrounds the scene box.
        depth: Along the camera's axis, world units, of surfaces in the scene box; 0 where there is none.
        opacity: In [0, 1], of what is in the scene box.
    """

    colour: Float32[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    opacity: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class MovingPart:
    """A rigid or soft thing that moves.

    Attributes:
        number: As in the report, counted from 1.
        rigid: It turns and goes; a soft one stretches, too.
        poses: World of each of `times_s` from the world at rest [T, 4, 4]: `x = poses[t] @ x_rest`, homogeneous.
    """

    number: int
    rigid: bool
    poses: Float[np.ndarray, "T 4 4"] = field(repr=False)


@dataclass(frozen=True)
class Reconstruction:
    """A trained scene, as `load` and `train` give it.

    Attributes:
        run_folder: Where it was read from.
        scene: Its pictures with cameras and times, its box and its points, in the world.
        model: In the box frame; not part of the public API.
    """

    run_folder: Path
    scene: Scene = field(repr=False)
    model: "DynamicModel" = field(repr=False)

    @property
    def metric(self) -> bool:
        """Whether lengths are metres."""
        return self.scene.metric

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """Calibrated cameras at the size they were trained at: `cam0`; of one that moves each picture, `static/12`."""
        cameras = cameras_of(self.scene.dynamic + self.scene.static)
        return {name: camera.scaled(self.scene.image_scale) for name, camera in cameras.items()}

    @cached_property
    def times_s(self) -> Float[np.ndarray, " T"]:
        """Moments that the motion was found at [T], seconds, rising; empty where nothing moves. Between two of them,
        motion is interpolated, so that any time from the first to the last modelled one can be asked for."""
        span_s = self.scene.t1_s - self.scene.t0_s
        return self.scene.t0_s + span_s * np.array(self._moments, dtype=np.float64)

    @cached_property
    def _moments(self) -> list[float]:
        from devrf.reconstruct.rendering.model import moments_of

        return moments_of(self.model)

    @cached_property
    def parts(self) -> tuple[MovingPart, ...]:
        """What moves, part by part; empty where nothing does, or where motion is a field and knows no parts."""
        movers = self.model.movers
        if movers is None:
            return ()
        stretches = movers.stretched().double().numpy()
        rotations, shifts = movers.rotations.double().numpy(), movers.shifts.double().numpy()
        poses = np.tile(np.eye(4), (*shifts.shape[:2], 1, 1))
        poses[..., :3, :3], poses[..., :3, 3] = rotations @ stretches, shifts
        poses = np.linalg.inv(self.scene.box_from_world) @ poses @ self.scene.box_from_world
        rigid = [bool(np.allclose(stretches[:, n], np.eye(3))) for n in range(movers.parts)]
        return tuple(MovingPart(n + 1, rigid[n], poses[:, n]) for n in range(movers.parts))

    @property
    def metrics(self) -> dict[str, Any]:
        """What stage `evaluate` measured: evaluate/metrics.json (docs/formats.md).

        Raises:
            DevrfError: `stage-not-made`.
        """
        check_made(self.run_folder, ("evaluate",))
        return read_json(self.run_folder / "evaluate" / "metrics.json")

    def render(self, camera: Camera | str, time_s: float | None = None) -> RenderedView:
        """What a camera sees at a time.

        Args:
            camera: In the world; or the name of one of `cameras`.
            time_s: Seconds; None: the scene at rest.
        Raises:
            DevrfError: `camera-unknown`; `option-out-of-range`: a time outside the clip; `scene-without-motion`;
                `stage-not-made`: the motion is not trained yet.
        """
        from devrf.reconstruct.film.depth_layer import DepthScale, planar_depth
        from devrf.reconstruct.rendering.model import render_layers

        scene, time = self.scene, self._share(time_s)
        view = (self._named(camera) if isinstance(camera, str) else camera).moved(scene.box_from_world)
        world_per_box = 1 / float(np.cbrt(np.linalg.det(scene.box_from_world[:3, :3])))
        scale = DepthScale.of([view], scene.aabb, self.model.rest.near, world_per_box, scene.metric)
        layers = render_layers(self.model, view, time)
        return RenderedView(layers[0], planar_depth(view, layers, scale), layers[2])

    def between(self, first: str, second: str, share: float = 0.5) -> Camera:
        """A camera on the way from one of `cameras` (share 0) to another of the same size (1), turned from the one to
        the other.

        Raises:
            DevrfError: `camera-unknown`.
        """
        from devrf.reconstruct.geometry.paths import through

        return through([self._named(first), self._named(second)], np.array([share]))[0]

    def points(self, time_s: float | None = None) -> "Cloud":
        """The surface in the scene box at a time: `xyz` [N, 3] and unit `normals` [N, 3] in the world, `rgb` [N, 3] in
        [0, 1]. Of what training cameras can see, rendered from their poses.

        Args:
            time_s: Seconds; None: the scene at rest.
        Raises:
            DevrfError: As `render`.
        """
        from devrf.reconstruct.geometry.cloud import point_cloud
        from devrf.reconstruct.geometry.seen import look, poses, solid

        time, model = self._share(time_s), solid(self.model)
        cloud = point_cloud([look(model, c, time) for c in poses(self.scene.in_box_frame())])
        world_from_box = np.linalg.inv(self.scene.box_from_world)
        turn = np.linalg.inv(self.scene.box_from_world[:3, :3]) / np.cbrt(
            np.linalg.det(world_from_box[:3, :3])
        )
        return replace(cloud, xyz=_mapped(world_from_box, cloud.xyz), normals=cloud.normals @ turn.T)

    def tracks(
        self, points: Float[np.ndarray, "n 3"] | None = None, time_s: float | None = None
    ) -> Float[np.ndarray, "T n 3"]:
        """Where surface points are at each of `times_s` [T, N, 3]; what does not move stays.

        Args:
            points: In the world [N, 3], as they lie at `time_s`; None: `points(time_s).xyz`.
            time_s: Seconds; None: the scene at rest.
        Raises:
            DevrfError: As `render`.
        """
        from devrf.reconstruct.geometry.field import moved

        if points is None:
            points = self.points(time_s).xyz
        time = self._share(time_s)
        boxed, world_from_box = (
            _mapped(self.scene.box_from_world, points),
            np.linalg.inv(self.scene.box_from_world),
        )
        ways = [_mapped(world_from_box, moved(self.model, boxed, time, then)) for then in self._moments]
        return np.stack(ways) if ways else np.zeros((0, *boxed.shape))

    def _named(self, name: str) -> Camera:
        if name not in self.cameras:
            text = f"camera {name!r}: not in {self.run_folder}; expected one of {some(list(self.cameras))}"
            raise InputError("camera-unknown", text)
        return self.cameras[name]

    def _share(self, time_s: float | None) -> float | None:
        """A time in [0, 1] of one in seconds."""
        if time_s is None:
            return None
        t0_s, t1_s = self.scene.t0_s, self.scene.t1_s
        if self.model.motion is None:
            if self.scene.dynamic:
                check_made(self.run_folder, ("deformation",))
            text = f"time_s {time_s:g}: nothing moves in {self.run_folder}; expected None, the scene at rest"
            raise InputError("scene-without-motion", text)
        # moments of tracking begin and end with the clip that does so first and last
        first_s, last_s = min(t0_s, *self.times_s[:1]), max(t1_s, *self.times_s[-1:])
        slack_s = SLACK * (t1_s - t0_s)
        if not first_s - slack_s <= time_s <= last_s + slack_s:
            expected = (
                f"{first_s:.3f} to {last_s:.3f} s on the first camera's clock, or None: the scene at rest"
            )
            text = f"time_s {time_s:g}: outside the clip; expected {expected}"
            raise InputError("option-out-of-range", text)
        return float((np.clip(time_s, first_s, last_s) - t0_s) / (t1_s - t0_s))


def load(run_folder: str | Path, *, device: str = "auto") -> Reconstruction:
    """The trained scene of a run folder; nothing is written.

    Args:
        run_folder: Where the stages' folders lie (`output` in scene.yaml).
        device: auto, cpu or cuda: where pictures are rendered.
    Raises:
        DevrfError: `folder-missing`; `stage-not-made`; `model-wrong-kind`: of another version; `file-damaged`;
            `gpu-missing`.
    """
    folder = Path(run_folder).expanduser()
    if not folder.is_dir():
        text = f"{folder}: no such folder; name a run folder, which holds canonical/ and deformation/"
        raise InputError("folder-missing", text)
    check_made(folder, ("scene", "canonical"))
    device = resolve_device(device)
    from devrf.reconstruct.storage.model_io import load_model

    return Reconstruction(folder, trained_scene(folder), load_model(folder, device))


def cameras_of(frames: Iterable[PosedFrame]) -> dict[str, Camera]:
    """Cameras by name; of one that moves, such as the sweep's, each picture: `static/12`."""
    out: dict[str, Camera] = {}
    for name, own in by_camera(frames).items():
        stands = len({frame.camera.view for frame in own}) == 1
        out |= {name if stands else f"{name}/{frame.index}": frame.camera for frame in own}
    return out


def _mapped(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
