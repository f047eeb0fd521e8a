"""Fixed cameras into the sweep's model: register one clean picture each, then refine all together.

The sweep stays where structure from motion put it. The joint refinement moves the fixed cameras, their
intrinsics as far as their priors allow, and every 3D point that they see, against all observations of these
points by the sweep and by the fixed cameras, with a Cauchy loss. Standard deviations come from the
same system.
"""

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.bundle.adjust import BundleSolution, adjust
from devrf.calibration.bundle.problem import Problem, bodies_of_points, lenses
from devrf.calibration.intrinsics import Intrinsics, guess
from devrf.calibration.rigs.registration import FEATURE_STD_PX, Registration, register, weak_prior
from devrf.calibration.rigs.rig import RigCamera
from devrf.calibration.rigs.rig_cameras import rig_camera
from devrf.calibration.sweep.sfm_process import run_job
from devrf.calibration.sweep.static_poses import SweepModel, feature_options
from devrf.capture.measure import ENOUGH_CAMERAS
from devrf.capture.system.arrays import read_npz
from devrf.capture.system.errors import HealthError
from devrf.capture.system.progress import Progress, no_progress

MIN_INLIERS = 30  # COLMAP's own minimum for a pose
PLENTY_INLIERS = 300  # another picture of the same camera would add nothing
INLIER_PX = 4.0
FILM_MORE = (
    "Add sweep pictures from near such a camera, looking the same way, and check that it films the same place"
)


@dataclass(frozen=True)
class FixedCameraInput:
    """What is known of one fixed camera before registration.

    Attributes:
        name: Of the camera.
        pictures: Clean pictures of it; tried in this order, the one that registers best is used.
        width, height: Their size.
        intrinsics: Board calibration with standard deviations, or None.
        pixel_aspect: Width of a pixel over its height.
    """

    name: str
    pictures: list[Path]
    width: int
    height: int
    intrinsics: Intrinsics | None
    pixel_aspect: float = 1.0

    @property
    def like(self) -> Intrinsics:
        """The calibration, or a guess in its place."""
        return self.intrinsics or guess(self.width, self.height, None, self.pixel_aspect)

    @property
    def intrinsics_source(self) -> str:
        """Where the intrinsics come from, as rig.json says it."""
        return "self" if self.intrinsics is None else "board"


@dataclass(frozen=True)
class SweepRig:
    """Fixed cameras in the sweep's world.

    Attributes:
        cameras: Name -> camera; index: name -> camera of the problem.
        solution: The adjusted problem; the sweep's cameras come first.
        support: Name -> its own observations that fit; like: name -> calibration or guess it started from.
        registrations: Name -> how it was registered.
        left_out: Name of a camera that shares no view with the sweep -> why.
    """

    cameras: dict[str, RigCamera]
    solution: BundleSolution
    index: dict[str, int]
    support: dict[str, Int[np.ndarray, " n"]]
    like: dict[str, Intrinsics]
    registrations: dict[str, Registration]
    left_out: dict[str, str]


def rig_from_sweep(
    model: SweepModel,
    inputs: list[FixedCameraInput],
    out: Path,
    progress: Progress = no_progress,
    threads: int | None = None,
    standing: SweepRig | None = None,
) -> SweepRig:
    """Register and refine the fixed cameras, in the sweep's unit.

    Args:
        model: The sweep.
        inputs: The cameras.
        out: Folder for logs and temporary files.
        progress: Called per camera.
        threads: Pictures whose features are found at once; None: one per core.
        standing: Cameras that are placed already: they stay, as the sweep does, and what they see counts.
    Raises:
        HealthError: Too few cameras share a view with the sweep to go on without the others, which are named with their
            inlier counts.
    """
    features = _features(inputs, out, threads)
    progress(0.2, "features of the fixed cameras")
    found: dict[str, tuple[Registration, str]] = {}
    lost: dict[str, str] = {}
    for n, item in enumerate(inputs):
        registration, label, most = _best_registration(model, item, features)
        if registration is None or most < MIN_INLIERS:
            lost[item.name] = _unlinked(item.name, most)
        else:
            found[item.name] = (registration, label)
        progress(0.2 + 0.6 * (n + 1) / len(inputs), f"{item.name}: {most} inliers")
    if len(found) < min(ENOUGH_CAMERAS, len(inputs)):
        remedy = f"{FILM_MORE}; or go on without: take cameras out of capture.cameras"
        raise HealthError("rig-unlinked-camera", f"{'; '.join(lost.values())}. {remedy}")
    around = model if standing is None else _with_standing(model, standing)
    rig = _refined(around, inputs, found)
    weak = {name: len(own) for name, own in rig.support.items() if len(own) < MIN_INLIERS}
    if weak and len(found) - len(weak) >= ENOUGH_CAMERAS:
        lost |= {name: _unlinked(name, most) for name, most in weak.items()}
        rig = _refined(around, inputs, {name: of for name, of in found.items() if name not in weak})
    return replace(rig, left_out={name: f"{why}. {FILM_MORE}" for name, why in lost.items()})


def _unlinked(name: str, inliers: int) -> str:
    return f"{name} shares no view with the sweep: {inliers} inliers, need {MIN_INLIERS} (100 are good)"


def _with_standing(model: SweepModel, rig: SweepRig) -> SweepModel:
    """The model with more cameras and what they see, for a refinement; how that looks is not kept."""
    S, seen = len(model.cameras), list(rig.registrations.values())
    counts = [len(r.points) for r in seen]
    return replace(
        model,
        names=(*model.names, *rig.registrations),
        cameras=(*model.cameras, *(rig.cameras[name].camera for name in rig.registrations)),
        obs_point=np.concatenate([model.obs_point, *(r.points for r in seen)]),
        obs_image=np.concatenate([model.obs_image, np.repeat(S + np.arange(len(seen)), counts)]),
        obs_xy=np.concatenate([model.obs_xy, *(r.xy for r in seen)]),
        obs_descriptor=np.concatenate([model.obs_descriptor, np.zeros((sum(counts), 128), np.uint8)]),
    )


def _features(
    inputs: list[FixedCameraInput], out: Path, threads: int | None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """SIFT of every clean picture, by file stem."""
    longest = max(max(item.width, item.height) for item in inputs)
    with tempfile.TemporaryDirectory(dir=out, prefix="work-") as work:
        pictures = Path(work) / "pictures"
        pictures.mkdir()
        names = []
        for item in inputs:
            for picture in item.pictures:
                shutil.copy(picture, pictures / picture.name)
                names.append(picture.name)
        job: dict[str, Any] = {
            "task": "extract",
            "work": work,
            "image_path": str(pictures),
            "names": names,
            "features": feature_options(longest),
            "threads": threads,
            "out": work,
        }
        run_job(job, Path(work), out / "colmap.log")
        features = {}
        for name in names:
            data = read_npz(Path(work) / f"{Path(name).stem}.npz")
            features[Path(name).stem] = (data["xy"], data["descriptors"])
    return features


def _best_registration(
    model: SweepModel, item: FixedCameraInput, features: dict[str, tuple[np.ndarray, np.ndarray]]
) -> tuple[Registration | None, str, int]:
    best: tuple[Registration | None, str, int] = (None, "", 0)
    for picture in item.pictures:
        xy, descriptors = features[picture.stem]
        known = item.intrinsics is not None
        start = item.like
        registration, inliers = register(xy, descriptors, model, start, known)
        if inliers > best[2]:
            best = (registration, picture.stem, inliers)
        if best[2] >= PLENTY_INLIERS:
            break
    return best


def _refined(
    model: SweepModel, inputs: list[FixedCameraInput], found: dict[str, tuple[Registration, str]]
) -> SweepRig:
    inputs = [item for item in inputs if item.name in found]
    problem, first_own = _problem(model, inputs, found)
    solution = adjust(problem)
    index = {item.name: len(model.cameras) + n for n, item in enumerate(inputs)}
    support, cameras = {}, {}
    for item in inputs:
        name, longest = item.name, max(item.width, item.height)
        registration, label = found[name]
        mine = np.flatnonzero(problem.obs_camera[first_own:] == index[name]) + first_own
        error = np.linalg.norm(solution.residual_px[mine], axis=1)
        support[name] = mine[error < max(INLIER_PX * longest / 1000, 3 * solution.sigma_px)]
        details = {
            "picture": label,
            "matches": registration.matches,
            "verified": registration.verified,
            "inlier_area": _hull_share(problem.obs_xy[support[name]], item.width, item.height),
        }
        cameras[name] = rig_camera(
            solution, index[name], item.like, item.intrinsics_source, support[name], details
        )
    like = {item.name: item.like for item in inputs}
    registrations = {name: found[name][0] for name in index}
    return SweepRig(cameras, solution, index, support, like, registrations, {})


def _problem(
    model: SweepModel, inputs: list[FixedCameraInput], found: dict[str, tuple[Registration, str]]
) -> tuple[Problem, int]:
    """Sweep (held) and fixed cameras with the points these see; and where their own observations begin."""
    S, F = len(model.cameras), len(inputs)
    registrations = [found[item.name][0] for item in inputs]
    points = np.unique(np.concatenate([r.points for r in registrations]))
    number = np.full(len(model.xyz), -1)
    number[points] = np.arange(len(points))
    seen = np.flatnonzero(number[model.obs_point] >= 0)
    lens_of: dict[tuple[object, ...], int] = {}
    device = [lens_of.setdefault(c.lens, len(lens_of)) for c in model.cameras]
    held = [model.cameras[device.index(d)] for d in range(len(lens_of))]
    sweep = [Intrinsics(c.width, c.height, c.K, c.distortion, None, c.model) for c in held]
    starts = [r.camera for r in registrations]
    own = [Intrinsics(c.width, c.height, c.K, c.distortion, None, c.model) for c in starts]
    known = [
        item.intrinsics or weak_prior(item.like, len(r.points))
        for item, r in zip(inputs, registrations, strict=True)
    ]
    n = len(seen) + sum(len(r.points) for r in registrations)
    problem = Problem(
        poses=np.array([c.cam_from_world for c in (*model.cameras, *starts)]),
        free_pose=np.arange(S + F) >= S,
        device=np.array([*device, *range(len(sweep), len(sweep) + F)]),
        **lenses([*sweep, *own], [*sweep, *known]),
        bodies=bodies_of_points(model.xyz[points]),
        freedom=np.full(len(points), 3),
        obs_camera=np.concatenate(
            [model.obs_image[seen], *(np.full(len(r.points), S + n) for n, r in enumerate(registrations))]
        ),
        obs_body=number[np.concatenate([model.obs_point[seen], *(r.points for r in registrations)])],
        obs_local=np.zeros((n, 3)),
        obs_xy=np.concatenate([model.obs_xy[seen].astype(np.float64), *(r.xy for r in registrations)]),
        obs_std=np.full(n, FEATURE_STD_PX),
    )
    return problem, len(seen)


def _hull_share(xy: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """Area of the inliers' convex hull, as a share of the picture."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(xy).volume / (width * height))
    except (QhullError, ValueError):
        return 0.0
