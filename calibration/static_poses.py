"""Structure from motion of the sweep: one moving camera films the scene at rest, we recover where it was.

COLMAP's SIFT and incremental mapper (Schoenberger & Frahm, CVPR 2016) through the worker process, with fixed
seeds: the same pictures give the same model. A capture that the default settings cannot start or finish goes
down a ladder: fewer inliers and smaller start angles, then global mapping. The result is in the scale and
frame of the mapper; `rig` finds the metric scale.
"""

import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.calibration.intrinsics import Intrinsics, guess
from devrf.calibration.sfm_process import run_job
from devrf.capture.camera import Camera, LensModel
from devrf.capture.errors import CalibrationError, HealthError
from devrf.capture.progress import Progress, no_progress

Mapper = Literal["incremental", "global"]

MAX_IMAGE_SIZE = 1280  # SIFT on larger pictures costs seconds each and gains little
MAX_FEATURES = 1600  # per picture; orientation copies come on top; matching time grows with the square
FINE_OCTAVE_BELOW = (
    720  # pictures up to this size are doubled first (SIFT octave -1), larger ones need not be
)
PRINCIPAL_POINT_FROM = 20  # registered pictures; fewer do not fix the principal point
EXHAUSTIVE_UP_TO = 70  # pictures; all pairs beyond that would take many minutes without a GPU
OVERLAP = 8  # neighbours in a longer sequence
LOOP_PICTURES = 28  # of a longer sequence are matched with each other, to close loops
MIN_MODEL = 3  # two pictures always fit each other; such a model says nothing
LADDER: tuple[dict[str, Any], ...] = (
    {"name": "incremental", "mapper": "incremental", "pose_inliers": 30, "init_inliers": 100,
     "init_angle_deg": 16.0, "accept": 0.8},
    {"name": "incremental 15 inliers", "mapper": "incremental", "pose_inliers": 15, "init_inliers": 50,
     "init_angle_deg": 4.0, "accept": 0.8},
    {"name": "global", "mapper": "global", "accept": 0.0},
)  # fmt: skip


@dataclass(frozen=True)
class DeviceGroup:
    """Pictures of one device at one size: they share a camera.

    Attributes:
        names: Picture files, relative to the picture folder.
        intrinsics: Start values, or what to hold fixed.
        trusted: The focal is a prior (EXIF, board), not a guess.
        fixed: Hold the intrinsics (they come from a board).
    """

    names: tuple[str, ...]
    intrinsics: Intrinsics
    trusted: bool = False
    fixed: bool = False


@dataclass(frozen=True)
class SweepModel:
    """The registered sweep and its point cloud, as `read_static_poses` finds them on disk.

    Attributes:
        names: Registered pictures, sorted [N].
        cameras: Their calibrated cameras [N].
        xyz, rgb, error_px: Points [P, 3], [P, 3], mean reprojection error [P].
        obs_point, obs_image, obs_xy: Which point was seen in which picture, and where [M], [M], [M, 2].
        obs_descriptor: SIFT descriptor of every observation [M, 128].
        report: The whole of static_poses.json.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"]
    error_px: Float[np.ndarray, " points"]
    obs_point: Int[np.ndarray, " observations"]
    obs_image: Int[np.ndarray, " observations"]
    obs_xy: Float[np.ndarray, "observations 2"]
    obs_descriptor: UInt8[np.ndarray, "observations 128"]
    report: dict[str, Any]


def recover_static_poses(
    image_folder: Path,
    groups: list[DeviceGroup],
    out: Path,
    *,
    mapper: Mapper = "incremental",
    ordered: bool = True,
    progress: Progress = no_progress,
    timeout_s: float | None = None,
) -> SweepModel:
    """Register the sweep and write `static_poses.json`, `colmap/`, `points.npz` and `colmap.log` into `out`.

    Args:
        image_folder: Folder that the groups' names are relative to.
        groups: Pictures by device.
        out: Existing folder.
        mapper: Which mapper to begin with.
        ordered: The pictures follow each other in time (a video), so neighbours overlap.
        progress: Told how far it is.
        timeout_s: Limit for the whole worker.
    Raises:
        CalibrationError: The worker crashed; carries its last log lines.
        HealthError: Nothing could be registered; says how near the best pair came.
    """
    names = sorted(name for group in groups for name in group.names)
    if len(names) < MIN_MODEL:
        raise CalibrationError(f"the sweep has {len(names)} pictures, need at least {MIN_MODEL}; film longer")
    ladder = [rung for rung in LADDER if rung["mapper"] == mapper]
    ladder += [rung for rung in LADDER if rung["mapper"] != mapper]
    with tempfile.TemporaryDirectory(dir=out, prefix="work-") as work:
        result = run_job(
            {
                "task": "map",
                "work": work,
                "image_path": str(image_folder),
                "groups": [_worker_group(group) for group in groups],
                "pairs": plan_pairs(names, ordered),
                "features": feature_options(
                    max(max(g.intrinsics.width, g.intrinsics.height) for g in groups)
                ),
                "ladder": ladder,
                "principal_point_from": PRINCIPAL_POINT_FROM,
                "out": work,
            },
            Path(work),
            out / "colmap.log",
            progress,
            timeout_s,
        )
        _refuse_unregistered(result, len(names))
        for made in ("colmap", "points.npz"):
            shutil.move(str(Path(work) / made), out / made)
    report = {key: result[key] for key in (
        "given", "mean_reprojection_px", "mean_track_length", "points", "mapper", "attempts", "best_pair",
        "features_per_image", "frames", "cameras",
    )}  # fmt: skip
    report["registered"] = len(result["frames"])
    report["models"] = [len(model) for model in result["models"]]
    report["other_models"] = result["models"][1:]
    report["unregistered"] = sorted(set(names) - set(result["frames"]))
    report["start"] = [
        {"names": len(g.names), "focal_px": g.intrinsics.K[0, 0], "trusted": g.trusted, "fixed": g.fixed}
        for g in groups
    ]
    (out / "static_poses.json").write_text(json.dumps(report))
    model = read_static_poses(out)
    report["median_triangulation_angle_deg"] = median_triangulation_angle_deg(model)
    report["points_per_image"] = {
        name: int(n)
        for name, n in zip(
            model.names, np.bincount(model.obs_image, minlength=len(model.names)).tolist(), strict=True
        )
    }
    (out / "static_poses.json").write_text(json.dumps(report, indent=1))
    return replace(model, report=report)


def read_static_poses(folder: Path) -> SweepModel:
    """Read what `recover_static_poses` wrote."""
    report = json.loads((folder / "static_poses.json").read_text())
    names = tuple(sorted(report["frames"]))
    cameras = []
    for name in names:
        frame = report["frames"][name]
        c = report["cameras"][str(frame["camera_id"])]
        pose = np.array(frame["camera_from_world"], dtype=np.float64)
        lens: LensModel = "OPENCV_FISHEYE" if c["model"] == "OPENCV_FISHEYE" else "OPENCV"
        cameras.append(
            Camera(c["width"], c["height"], np.array(c["K"]), pose, np.array(c["distortion"]), lens)
        )
    with np.load(folder / "points.npz") as data:
        arrays = {key: data[key] for key in data.files}
    return SweepModel(names, tuple(cameras), report=report, **arrays)


def plan_pairs(names: list[str], ordered: bool) -> list[tuple[str, str]]:
    """Which pictures to match: all pairs of a small set; neighbours and a loop-closing sample else."""
    n = len(names)
    if n <= EXHAUSTIVE_UP_TO or not ordered:
        return [(names[i], names[j]) for i in range(n) for j in range(i + 1, n)]
    pairs = {(i, i + step) for i in range(n) for step in range(1, OVERLAP + 1) if i + step < n}
    pairs |= {(i, i + 2**k) for i in range(n) for k in range(3, n.bit_length()) if i + 2**k < n}
    sample = np.unique(np.linspace(0, n - 1, LOOP_PICTURES).round().astype(int)).tolist()
    pairs |= {(a, b) for k, a in enumerate(sample) for b in sample[k + 1 :]}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def feature_options(longest_side_px: int) -> dict[str, Any]:
    """SIFT settings for pictures whose longer side is `longest_side_px`."""
    return {
        "max_image_size": MAX_IMAGE_SIZE,
        "max_num_features": MAX_FEATURES,
        "first_octave": -1 if longest_side_px <= FINE_OCTAVE_BELOW else 0,
        "peak_threshold": 0.02 / 3,
    }


def median_triangulation_angle_deg(model: SweepModel) -> float:
    """Median over points of the widest angle between two of the rays that see the point."""
    centres = np.array([camera.centre for camera in model.cameras])
    rays = model.xyz[model.obs_point] - centres[model.obs_image]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    order = np.argsort(model.obs_point, kind="stable")
    starts = np.flatnonzero(np.diff(model.obs_point[order], prepend=-1))
    angles = []
    for group in np.split(rays[order], starts[1:]):
        angles.append(np.degrees(np.arccos(np.clip((group @ group.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def device_groups(
    sizes: dict[str, tuple[int, int]], focal_px: float | None, known: Intrinsics | None
) -> list[DeviceGroup]:
    """Group pictures by size; each group shares a camera.

    Args:
        sizes: (width, height) of each picture.
        focal_px: Focal length by EXIF at the first picture's size, or None.
        known: Board calibration of the device; used where the size agrees: held in a short sweep, a start
            in a longer one, which fixes the lens better than a board clip does.
    """
    groups = []
    first = max(next(iter(sizes.values())))
    for size in sorted(set(sizes.values())):
        names = tuple(sorted(name for name, s in sizes.items() if s == size))
        if known is not None and (known.width, known.height) == size:
            groups.append(DeviceGroup(names, known, trusted=True, fixed=len(names) < PRINCIPAL_POINT_FROM))
        else:
            focal = None if focal_px is None else focal_px * max(size) / first
            groups.append(DeviceGroup(names, guess(*size, focal), trusted=focal is not None))
    return groups


def _worker_group(group: DeviceGroup) -> dict[str, Any]:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = group.intrinsics.vector.tolist()
    fisheye = group.intrinsics.model == "OPENCV_FISHEYE"  # its vector is already COLMAP's: k3, k4 for p1, p2
    rich = group.fixed and k3 != 0.0
    params = [fx, fy, cx, cy, k1, k2, p1, p2] + ([k3, 0.0, 0.0, 0.0] if rich else [])
    return {
        "names": list(group.names),
        "model": "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV" if rich else "OPENCV",
        "params": params if group.trusted else None,
        "fixed": group.fixed,
    }


def _refuse_unregistered(result: dict[str, Any], given: int) -> None:
    largest = max((len(model) for model in result["models"]), default=0)
    if largest >= MIN_MODEL:
        return
    pair, features = result["best_pair"], result["features_per_image"]
    median = float(np.median(list(features.values()))) if features else 0.0
    what = "two pictures always fit each other, so this says nothing" if largest else "nothing to start from"
    raise HealthError(
        f"the sweep could not be registered: {largest} of {given} pictures ({what}); best pair: "
        f"{pair['inliers']} inliers {' - '.join(pair['names'])}, need 100 and 16 degrees between views "
        f"(50 and 4 were tried too); {median:.0f} features per picture in the median. Film a scene with "
        "texture (blank walls give none), walk sideways instead of turning on the spot, and keep 70 % overlap"
    )
