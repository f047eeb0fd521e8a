"""Structure from motion of the sweep: one moving camera films the scene at rest, we recover where it was.

COLMAP's SIFT and incremental mapper (Schoenberger & Frahm, CVPR 2016) through the worker process, with fixed
seeds: the same pictures give the same model. A capture that the default settings cannot start or finish goes
down a ladder: fewer inliers and smaller start angles, then global mapping. The result is in the scale and
frame of the mapper; `rig` finds the metric scale.
"""

import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from devrf.calibration.sweep.devices import PRINCIPAL_POINT_FROM, DeviceGroup
from devrf.calibration.sweep.gps import UP_STD, local_metres, why_not
from devrf.calibration.sweep.pairs import plan_pairs
from devrf.calibration.sweep.sfm_output import camera_at
from devrf.calibration.sweep.sfm_process import run_job
from devrf.calibration.sweep.two_views import against_model, kinds_report, read_two_views, torn_apart
from devrf.capture.bursts import held_out
from devrf.capture.camera import Camera
from devrf.capture.exif import Place
from devrf.capture.system.arrays import read_npz
from devrf.capture.system.errors import CalibrationError, HealthError
from devrf.capture.system.progress import Progress, no_progress

Mapper = Literal["incremental", "global", "both"]

MAX_IMAGE_SIZE = 1280  # SIFT on larger pictures costs seconds each and gains little
MAX_FEATURES = 1600  # per picture; orientation copies come on top; matching time grows with the square
# Pictures up to this size are doubled first (SIFT octave -1), larger ones need not be.
FINE_OCTAVE_BELOW = 720
FEWEST_SIGHTINGS = 2  # of a point, for its place
MIN_MODEL = 3  # two pictures always fit each other; such a model says nothing
HOMOGRAPHY_SHARE = 0.8  # of verified pairs; in a sweep with depth and sideways motion most have a parallax
OVERLAY_SHARE = 0.5  # of verified pairs; what does not move then hides the rest
# the worker keeps its time budget itself; it is stopped at 1.2 times that and a minute
LATE, LATE_S = 1.2, 60.0
LADDER: tuple[dict[str, Any], ...] = (
    {"name": "incremental", "mapper": "incremental", "pose_inliers": 30, "init_inliers": 100,
     "init_angle_deg": 16.0, "accept": 0.8},
    {"name": "incremental 15 inliers", "mapper": "incremental", "pose_inliers": 15, "init_inliers": 50,
     "init_angle_deg": 4.0, "accept": 0.8},
    {"name": "global", "mapper": "global", "accept": 0.8},
)  # fmt: skip


@dataclass(frozen=True)
class SweepOptions:
    """How the sweep is recovered.

    Attributes:
        mapper: Which mapper to begin with; `both`: run both and keep the better model.
        time_s: Budget, seconds; None for none.
        threads: Pictures whose features are found at once, and pairs that are matched at once; None: one per core.
            They change no result.
        side_px: Longer side to which larger pictures are reduced before features are found.
    """

    mapper: Mapper = "incremental"
    time_s: float | None = None
    threads: int | None = None
    side_px: int = MAX_IMAGE_SIZE


DEFAULT_OPTIONS = SweepOptions()


@dataclass(frozen=True)
class SweepPictures:
    """The pictures of a sweep.

    Attributes:
        folder: Folder that the groups' names are relative to.
        groups: Pictures by device.
        ordered: They follow each other in time (a video), so neighbours overlap.
        masks: What `prepare_masks` wrote; None without masks.
        places: Where they were taken, by GPS.
    """

    folder: Path
    groups: list[DeviceGroup]
    ordered: bool = True
    masks: Path | None = None
    places: Mapping[str, Place | None] = field(default_factory=dict)


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

    def held_out(self, every: int) -> Bool[np.ndarray, " N"]:
        """Which pictures are kept out of everything but structure from motion: every n-th one, bursts whole."""
        number = {name: n for n, name in enumerate(self.names)}
        return held_out(len(number), every, [[number[n] for n in of] for of in self.report.get("bursts", ())])

    def without_held_out(self, every: int) -> "SweepModel":
        """The model without these pictures, what they show, and points that fewer than two others show."""
        kept = ~self.held_out(every)
        seen = kept[self.obs_image]
        points = np.bincount(self.obs_point[seen], minlength=len(self.xyz)) >= FEWEST_SIGHTINGS
        seen &= points[self.obs_point]
        image, point = np.cumsum(kept) - 1, np.cumsum(points) - 1
        pictures = np.flatnonzero(kept).tolist()
        return replace(
            self,
            names=tuple(self.names[n] for n in pictures),
            cameras=tuple(self.cameras[n] for n in pictures),
            xyz=self.xyz[points],
            rgb=self.rgb[points],
            error_px=self.error_px[points],
            obs_point=point[self.obs_point[seen]],
            obs_image=image[self.obs_image[seen]],
            obs_xy=self.obs_xy[seen],
            obs_descriptor=self.obs_descriptor[seen],
        )


def recover_static_poses(
    sweep: SweepPictures,
    out: Path,
    options: SweepOptions = DEFAULT_OPTIONS,
    progress: Progress = no_progress,
) -> SweepModel:
    """Register the sweep and write `static_poses.json`, `colmap/`, `points.npz` and `colmap.log` into `out`.

    Args:
        sweep: Its pictures.
        out: Existing folder.
        options: Mapper, time.
        progress: Told how far it is.
    Raises:
        CalibrationError: The worker crashed; carries its last log lines.
        HealthError: Nothing could be registered; says how near the best pair came.
    """
    groups, ordered = sweep.groups, sweep.ordered
    names = sorted(name for group in groups for name in group.names)
    if len(names) < MIN_MODEL:
        text = f"the sweep has {len(names)} pictures, need at least {MIN_MODEL}; film longer"
        raise CalibrationError("sweep-too-short", text)
    metres, std_m = local_metres(sweep.places)
    if why_not(metres, std_m, len(names)):
        metres = {}
    nowhere = np.full(3, np.nan)
    plan = plan_pairs(names, ordered, np.array([metres.get(n, nowhere) for n in names]) if metres else None)
    first = "global" if options.mapper == "global" else "incremental"
    with tempfile.TemporaryDirectory(dir=out, prefix="work-") as work:
        result = run_job(
            {
                "task": "map",
                "work": work,
                "image_path": str(sweep.folder),
                "mask_path": None if sweep.masks is None else str(sweep.masks),
                "groups": [_worker_group(group) for group in groups],
                "places": {n: _prior(metres[n], std_m[n]) for n in metres},
                "film": ordered,
                "pairs": plan.pairs,
                "wanted": plan.wanted,
                "features": feature_options(
                    max(max(g.intrinsics.width, g.intrinsics.height) for g in groups), options.side_px
                ),
                "threads": options.threads,
                "ladder": sorted(LADDER, key=lambda rung: rung["mapper"] != first),
                "both": options.mapper == "both",
                "principal_point_from": PRINCIPAL_POINT_FROM,
                "budget_s": options.time_s,
                "out": work,
            },
            Path(work),
            out / "colmap.log",
            progress,
            None if options.time_s is None else LATE * options.time_s + LATE_S,
        )
        views = read_two_views(Path(work) / "two_views.npz")
        _refuse_unregistered(result, kinds_report(views), len(names))
        for made in ("colmap", "points.npz"):
            shutil.move(str(Path(work) / made), out / made)
    report = {key: result[key] for key in (
        "given", "mean_reprojection_px", "mean_track_length", "points", "mapper", "attempts", "adjustment", "weak",
        "stopped", "pairs", "best_pair", "features_per_image", "frames", "cameras",
    )}  # fmt: skip
    report["registered"] = len(result["frames"])
    report["models"] = [len(model) for model in result["models"]]
    report["other_models"] = result["models"][1:]
    report["unregistered"] = sorted(set(names) - set(result["frames"]))
    report["start"] = _starts(groups, result)
    (out / "static_poses.json").write_text(json.dumps(report))
    model = read_static_poses(out)
    registered = dict(zip(model.names, model.cameras, strict=True))
    report["verified_pairs"] = kinds_report(views) | against_model(views, registered)
    report["torn"] = torn_apart(names, report["verified_pairs"]["contradicting"]) if ordered else []
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
        pose = np.array(frame["camera_from_world"], dtype=np.float64)
        cameras.append(camera_at(report["cameras"][str(frame["camera_id"])], pose))
    return SweepModel(names, tuple(cameras), report=report, **read_npz(folder / "points.npz"))


def feature_options(longest_side_px: int, side_px: int = MAX_IMAGE_SIZE) -> dict[str, Any]:
    """SIFT settings for pictures whose longer side is `longest_side_px`, reduced to at most `side_px`."""
    return {
        "max_image_size": side_px,
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
    least = [np.clip((group @ group.T).min(), -1, 1) for group in np.split(rays[order], starts[1:])]
    return float(np.median(np.degrees(np.arccos(least)))) if least else 0.0


def _worker_group(group: DeviceGroup) -> dict[str, Any]:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = group.intrinsics.vector.tolist()
    fisheye = group.intrinsics.model == "OPENCV_FISHEYE"  # its vector is already COLMAP's: k3, k4 for p1, p2
    rich = group.fixed and k3 != 0.0
    params = [fx, fy, cx, cy, k1, k2, p1, p2] + ([k3, 0.0, 0.0, 0.0] if rich else [])
    return {
        "names": list(group.names),
        "model": "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV" if rich else "OPENCV",
        "params": None if group.source == "guess" else params,
        "fixed": group.fixed,
    }


def _prior(position_m: np.ndarray, std_m: float) -> dict[str, list[float]]:
    return {"position": position_m.tolist(), "std": [std_m, std_m, UP_STD * std_m]}


def _starts(groups: list[DeviceGroup], result: dict[str, Any]) -> list[dict[str, Any]]:
    """What each camera began with, and its number in `cameras` (None where none of its pictures is registered)."""
    frames = result["frames"]
    return [
        {
            "names": len(g.names),
            "registered": sum(name in frames for name in g.names),
            "label": g.label,
            "camera_id": next((frames[name]["camera_id"] for name in g.names if name in frames), None),
            "focal_px": g.intrinsics.K[0, 0],
            "source": g.source,
            "fixed": g.fixed,
        }
        for g in groups
    ]


def _refuse_unregistered(result: dict[str, Any], pairs: dict[str, Any], given: int) -> None:
    largest = max((len(model) for model in result["models"]), default=0)
    if largest >= MIN_MODEL:
        return
    pair, features = result["best_pair"], result["features_per_image"]
    median = float(np.median(list(features.values()))) if features else 0.0
    what = "two pictures always fit each other, so this says nothing" if largest else "nothing to start from"
    angle = "" if pair["angle_deg"] is None else f" and {pair['angle_deg']:.1f} degrees"
    code, cause = _cause(pairs, any(attempt["out_of_time"] for attempt in result["attempts"]))
    best = f"{pair['inliers']} inliers{angle} {' - '.join(pair['names'])}, need 100 and 16 degrees"
    found = f"the sweep could not be registered: {largest} of {given} pictures ({what}); best pair: {best}"
    seen = f"between views (50 and 4 were tried too); {median:.0f} features per picture in the median"
    raise HealthError(code, f"{found} {seen}. {cause}")


def _cause(pairs: dict[str, Any], late: bool) -> tuple[str, str]:
    """The code of the likeliest reason why nothing was registered, and its text with a remedy."""
    if late:
        remedy = "raise budget.time_minutes, or use fewer pictures"
        return "sweep-out-of-time", f"There was not enough time: {remedy}"
    if pairs["watermark_share"] > OVERLAY_SHARE:
        return (
            "sweep-under-overlay",
            f"{100 * pairs['watermark_share']:.0f} % of its pairs match on a static overlay (logo, time stamp, dirt on "
            "the lens): switch it off, crop it, or mask it (calibration.static_poses.masks)",
        )
    if pairs["verified"] >= MIN_MODEL and pairs["homography_share"] > HOMOGRAPHY_SHARE:
        return (
            "sweep-without-parallax",
            f"{100 * pairs['homography_share']:.0f} % of its pairs fit a homography: the camera turned and did not "
            "move, or it saw one flat surface. Walk sideways around the scene, with depth in view",
        )
    return (
        "sweep-unregistered",
        "Film a scene with texture (blank walls give none), walk sideways instead of turning on the spot, and keep "
        "70 % overlap",
    )
