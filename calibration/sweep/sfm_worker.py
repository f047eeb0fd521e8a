"""The one place that imports pycolmap; run as `python -m devrf.calibration.sweep.sfm_worker job.json`.

A separate process, because pycolmap can abort (its C++ checks end in std::terminate) and installs its own
handlers for SIGTERM and SIGSEGV. `zlib` is imported first: the pycolmap 4.2 wheel carries its own zlib, and
if it is the first to load one, PNG and npz writing corrupt the heap (facts: LD_DEBUG bindings).

A job is JSON: `task` is `map` or `extract`; the answer is `result.json` beside it, plus npz files. Lines
`PROGRESS <fraction> <text>` go to stdout, COLMAP's log to stderr. Pixels follow COLMAP: the centre of the
top-left pixel is (0.5, 0.5).
"""

import zlib  # noqa: F401, I001  must stay the first import, see above
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from devrf.calibration.sweep.agreement import disagreement_deg
from devrf.calibration.sweep.pairs import Pair
from devrf.calibration.sweep.sfm_budget import Clock, Matching
from devrf.capture.formats.colmap import intrinsics
from devrf.capture.formats.colmap_model import ModelCamera

MAPPER_THREADS = 1  # more: whichever first pair is found first begins the model; as fast at 70 pictures
POLISH_TOLERANCE = 1e-8  # relative fall of the cost in one step; at 1e-6 focals still move by 0.01 px
POLISH_ITERATIONS = 200  # 20 to 40 are usual
MIN_POINTS = 30  # COLMAP's minimum for one pose; global mapping of a camera that only turned leaves fewer
FEWEST_INLIERS = 15  # of a verified pair (COLMAP's own bound)
EXTRACT_PROBE = 4  # pictures whose time tells what the others will take
EXTRACT_SHARE = 0.4  # of the time that is left; matching and mapping take about as long
GLOBAL_COST = 2.0  # global mapping takes one to two times as long as incremental mapping of the same pairs


def main(job_file: Path) -> None:
    """Do the job and write `result.json` beside it."""
    job = json.loads(job_file.read_text())
    _leave(job, {"map": map_images, "extract": extract_only}[job["task"]](job))


def map_images(job: dict[str, Any]) -> dict[str, Any]:
    """Structure from motion of `job["groups"]` (pictures that share one camera each).

    The order import -> extract -> match -> map with fixed seeds, and mapping on one thread, gives the same
    model every time, as long as the time budget (`job["budget_s"]`) cuts nothing short.
    """
    work, clock = Path(job["work"]), Clock(job["budget_s"])
    database = work / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = [name for group in job["groups"] for name in group["names"]]
    cameras = [_import_group(database, job["image_path"], group) for group in job["groups"]]
    if job["places"]:
        _write_places(database, job["places"])
    _say(0.02, f"features of {len(names)} pictures")
    skipped = _extract_in_time(database, job, names, clock)
    pairs = [pair for pair in job["pairs"] if not skipped.intersection(pair)]
    wanted = len(pairs) if len(pairs) < len(job["pairs"]) else job["wanted"]
    features = _features_per_image(database)
    matching = Matching(pairs, wanted, features, lambda some: _match(database, work, some), clock)
    _say(0.35, f"matching {wanted} pairs")
    matching.begin()
    held = {camera for camera, group in zip(cameras, job["groups"], strict=True) if group["fixed"]}
    mapping = _Mapping(database, work, job, names, held, clock)
    mapping.climb(job["ladder"])
    if mapping.registered < len(names) - len(skipped) and matching.go_on():
        mapping.climb(job["ladder"][:1])
    out: dict[str, Any] = {
        "given": len(names),
        "skipped_pictures": sorted(skipped),
        "best_pair": _best_pair(database),
        "pairs": matching.report(),
        "features_per_image": features,
        "models": [],
    }
    if mapping.best is None:
        _write_two_views(database, Path(job["out"]))
        return out | mapping.report()
    other = mapping.other_mapper(job["compare"], job["ladder"])
    if other is not None:
        # global mapping has no limit of its own: leave what there is
        _leave(job, out | _publish(mapping, database, job, adjust=False))
        mapping.compare(other, seed=0)
    if job["check_seed"] and mapping.seconds < clock.left_s():
        mapping.compare(mapping.rung, seed=1)
    return out | _publish(mapping, database, job)


def _extract_in_time(database: Path, job: dict[str, Any], names: list[str], clock: Clock) -> set[str]:
    """Features of all pictures, or of evenly spaced ones where there is no time for all; those left out."""
    probe, rest = names[:EXTRACT_PROBE], names[EXTRACT_PROBE:]
    start, allowed = time.monotonic(), EXTRACT_SHARE * clock.left_s()
    _extract(database, job, probe)
    each_s = (time.monotonic() - start) / len(probe)
    room = max(0, int(min(len(rest), allowed / each_s - len(probe)))) if allowed < float("inf") else len(rest)
    kept = [rest[i * len(rest) // room] for i in range(room)]
    if kept:
        _extract(database, job, kept)
    return set(rest) - set(kept)


class _Mapping:
    """Models of the sweep by several mappers; the best so far is the one with the most pictures, then with the
    lowest error."""

    def __init__(
        self,
        database: Path,
        work: Path,
        job: dict[str, Any],
        names: list[str],
        held: set[int],
        clock: Clock,
    ) -> None:
        self.database, self.work, self.job, self.names = database, work, job, names
        self.held, self.clock = held, clock
        self.best: pycolmap.Reconstruction | None = None
        self.models: list[pycolmap.Reconstruction] = []  # of the best attempt, largest first
        self.name: str | None = None
        self.rung: dict[str, Any] = {}
        self.attempts: list[dict[str, Any]] = []
        self.compared: list[dict[str, Any]] = []

    @property
    def registered(self) -> int:
        """Pictures of the best model."""
        return 0 if self.best is None else self.best.num_reg_images()

    @property
    def seconds(self) -> float:
        """What the slowest attempt took."""
        return max((attempt["seconds"] for attempt in self.attempts), default=0.0)

    def climb(self, ladder: list[dict[str, Any]]) -> None:
        """Try one rung after the other until one registers its share of the pictures, or time is up."""
        for rung in ladder:
            if self.best is not None and self.clock.left_s() <= 0:
                break
            self._try(rung, seed=0)
            if self.registered >= rung["accept"] * len(self.names):
                break

    def other_mapper(self, rule: str, ladder: list[dict[str, Any]]) -> dict[str, Any] | None:
        """The rung of the mapper that was not tried, where it should be and there is time for it.

        Args:
            rule: `always`, or `weak`: only where pictures are missing from the best model.
            ladder: All rungs.
        """
        tried = {attempt["mapper"] for attempt in self.attempts}
        wanted = rule == "always" or self.registered < len(self.names)
        if not wanted or GLOBAL_COST * self.seconds >= self.clock.left_s():
            return None
        return next((rung for rung in ladder if rung["mapper"] not in tried), None)

    def compare(self, rung: dict[str, Any], seed: int) -> None:
        """Map once more and note how far the poses differ; with the same seed the better model is kept."""
        self._try(rung, seed, against=True)

    def report(self) -> dict[str, Any]:
        """For `static_poses.json`."""
        return {"mapper": self.name, "attempts": self.attempts, "compared": self.compared}

    def _try(self, rung: dict[str, Any], seed: int, against: bool = False) -> None:
        name = rung["name"] + (f" with seed {seed}" if seed else "")
        _say(0.7, f"mapping ({name})")
        start, left = time.monotonic(), self.clock.left_s()
        folder = self.work / f"attempt{len(self.attempts)}"
        folder.mkdir()
        models = _attempt(self.database, folder, self.job, rung, self.held, seed, left, len(self.names))
        models = [m for m in models if m.num_points3D() >= MIN_POINTS]
        models.sort(key=_worth, reverse=True)
        self.attempts.append(
            {
                "name": name,
                "mapper": rung["mapper"],
                "registered": [m.num_reg_images() for m in models],
                "mean_reprojection_px": models[0].compute_mean_reprojection_error() if models else None,
                "seconds": time.monotonic() - start,
                "out_of_time": time.monotonic() - start >= left,
            }
        )
        if not models:
            return
        if against and self.best is not None:
            apart = disagreement_deg(_poses(self.best), _poses(models[0]))
            self.compared.append({"name": name, "against": self.name, "apart_deg": apart})
        if not seed and (self.best is None or _worth(models[0]) > _worth(self.best)):
            self.best, self.models, self.name, self.rung = models[0], models, name, rung


def _worth(model: pycolmap.Reconstruction) -> tuple[int, float]:
    """A small model can look perfect: pictures count first, the error only among equals."""
    return model.num_reg_images(), -model.compute_mean_reprojection_error()


def _poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {i.name: i.cam_from_world().matrix() for i in model.images.values() if i.has_pose}


def _publish(mapping: _Mapping, database: Path, job: dict[str, Any], adjust: bool = True) -> dict[str, Any]:
    """Adjust the best model, write it, and say what there is to say of it."""
    assert mapping.best is not None
    adjusted = None
    if adjust:
        _say(0.98, "bundle adjustment")
        adjusted = _polish(mapping.best, job, mapping.held)
    out = Path(job["out"])
    _write_two_views(database, out)
    return {
        **mapping.report(),
        "models": [sorted(i.name for i in m.images.values() if i.has_pose) for m in mapping.models],
        "adjustment": adjusted,
        **_write_model(mapping.best, database, out),
    }


def _leave(job: dict[str, Any], result: dict[str, Any]) -> None:
    """Write `result.json`; whoever has to stop this process finds the best so far."""
    file = Path(job["work"]) / "result.json"
    half = file.with_suffix(".half")
    half.write_text(json.dumps(result))
    half.replace(file)


def extract_only(job: dict[str, Any]) -> dict[str, Any]:
    """SIFT of single pictures: `<name>.npz` with xy [N, 2] and descriptors uint8 [N, 128] in job["out"]."""
    database = Path(job["work"]) / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = job["names"]
    pycolmap.import_images(str(database), job["image_path"], pycolmap.CameraMode.PER_IMAGE, names)
    _extract(database, job, names)
    db = pycolmap.Database.open(str(database))
    for image in db.read_all_images():
        xy, descriptors = _features(db, image.image_id)
        np.savez(Path(job["out"]) / f"{Path(image.name).stem}.npz", xy=xy, descriptors=descriptors)
    db.close()
    return {"names": names}


def _import_group(database: Path, image_path: str, group: dict[str, Any]) -> int:
    """Enter a group's pictures; the id of their camera."""
    options = pycolmap.ImageReaderOptions()
    options.camera_model = group["model"]
    if group["params"] is not None:
        options.camera_params = ",".join(repr(float(p)) for p in group["params"])
    pycolmap.import_images(str(database), image_path, pycolmap.CameraMode.SINGLE, group["names"], options)
    db = pycolmap.Database.open(str(database))
    image = next(i for i in db.read_all_images() if i.name == group["names"][0])
    camera = db.read_camera(image.camera_id)
    if group["params"] is not None:
        camera.has_prior_focal_length = True
        db.update_camera(camera)
    db.close()
    return int(camera.camera_id)


def _write_places(database: Path, places: dict[str, dict[str, Any]]) -> None:
    """Priors of the cameras' positions: local metres [3] and standard deviations [3] by picture."""
    db = pycolmap.Database.open(str(database))
    for image in db.read_all_images():
        place = places.get(image.name)
        if place is not None:
            db.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=np.array(place["position"]),
                    position_covariance=np.diag(np.square(place["std"])),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
            )
    db.close()


def _extract(database: Path, job: dict[str, Any], names: list[str]) -> None:
    features = job["features"]
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = features["max_image_size"]
    options.sift.max_num_features = features["max_num_features"]
    options.sift.first_octave = features["first_octave"]
    options.sift.peak_threshold = features["peak_threshold"]
    reader = pycolmap.ImageReaderOptions()
    if job.get("mask_path"):
        reader.mask_path = job["mask_path"]
    pycolmap.extract_features(
        str(database),
        job["image_path"],
        names,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _match(database: Path, work: Path, pairs: list[Pair]) -> None:
    pair_file = work / "pairs.txt"
    pair_file.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pair_file)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_image_pairs(
        str(database),
        pycolmap.FeatureMatchingOptions(),
        pairing,
        verification,
        pycolmap.Device.cpu,
    )


def _attempt(
    database: Path,
    output: Path,
    job: dict[str, Any],
    rung: dict[str, Any],
    held: set[int],
    seed: int,
    left_s: float,
    pictures: int,
) -> list[pycolmap.Reconstruction]:
    if rung["mapper"] == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = seed
        options.num_threads = MAPPER_THREADS
        if not held:
            pycolmap.calibrate_view_graph(str(database))
        options.mapper.bundle_adjustment.refine_focal_length = not held
        options.mapper.bundle_adjustment.refine_extra_params = not held
        models = pycolmap.global_mapping(str(database), job["image_path"], str(output), options)
        return list(models.values())
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.num_threads = MAPPER_THREADS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = (
        1.3  # _polish ends with a full one anyway
    )
    options.constant_cameras = held
    options.mapper.constant_cameras = held
    refine = len(held) < len(job["groups"])
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refine
    options.mapper.abs_pose_min_num_inliers = rung["pose_inliers"]
    options.mapper.init_min_num_inliers = rung["init_inliers"]
    options.mapper.init_min_tri_angle = rung["init_angle_deg"]
    if job["places"]:
        options.use_prior_position = True
        options.use_robust_loss_on_prior_position = True
    if left_s < float("inf"):
        options.max_runtime_seconds = max(1, int(left_s))
    done = [0]

    def registered() -> None:
        done[0] += 1
        share = min(1.0, done[0] / pictures)
        _say(0.7 + 0.28 * share, f"mapping ({rung['name']}): {done[0]} of {pictures} pictures")

    models = pycolmap.incremental_mapping(
        str(database), job["image_path"], str(output), options, next_image_callback=registered
    )
    return list(models.values())


def _polish(model: pycolmap.Reconstruction, job: dict[str, Any], held: set[int]) -> dict[str, Any]:
    """Bundle adjustment with a robust loss and, where enough pictures support it, a free principal point.

    COLMAP's mapper holds the principal point; phones are off by 1 % of the width, which turns every camera by
    half a degree. A principal point that runs away from the centre is put back.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.max_num_iterations = POLISH_ITERATIONS
    options.ceres.solver_options.function_tolerance = POLISH_TOLERANCE
    options.ceres.solver_options.num_threads = MAPPER_THREADS
    seen = Counter(i.camera_id for i in model.images.values() if i.has_pose)
    free = {camera: count for camera, count in seen.items() if camera not in held}
    options.refine_principal_point = bool(free) and min(free.values()) >= job["principal_point_from"]
    before = {k: (c.principal_point_x, c.principal_point_y) for k, c in model.cameras.items()}
    converged = _adjust(model, options, held)
    away = [
        k
        for k, c in model.cameras.items()
        if max(abs(c.principal_point_x - before[k][0]), abs(c.principal_point_y - before[k][1]))
        > 0.05 * c.width
    ]
    if away:
        for k, c in model.cameras.items():
            c.principal_point_x, c.principal_point_y = before[k]
        options.refine_principal_point = False
        converged = _adjust(model, options, held)
    return {
        "converged": converged,
        "principal_point_free": options.refine_principal_point,
        "principal_point_put_back": away,
    }


def _adjust(
    model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions, held: set[int]
) -> bool:
    """Adjust everything but the intrinsics of held cameras; whether the solver says that it is done."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    for camera in held:
        config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE


def _best_pair(database: Path) -> dict[str, Any]:
    """The pair with the most verified matches: what a failed start is measured by."""
    db = pycolmap.Database.open(str(database))
    names = {image.image_id: image.name for image in db.read_all_images()}
    pair_ids, inliers = db.read_two_view_geometry_num_inliers()
    best = int(np.argmax(inliers)) if len(inliers) else -1
    out = {"inliers": 0, "names": [], "angle_deg": None}
    if best >= 0:
        ids = _image_ids(pair_ids[best])
        angle = db.read_two_view_geometry(*ids).tri_angle
        out["inliers"] = int(inliers[best])
        out["names"] = [names[i] for i in ids]
        out["angle_deg"] = float(np.degrees(angle)) if angle is not None and angle > 0 else None
    db.close()
    return out


def _image_ids(pair: Any) -> tuple[int, int]:
    if isinstance(pair, (tuple, list)):
        return int(pair[0]), int(pair[1])
    first, second = pycolmap.pair_id_to_image_pair(pair)
    return int(first), int(second)


def _features_per_image(database: Path) -> dict[str, int]:
    db = pycolmap.Database.open(str(database))
    out = {i.name: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}
    db.close()
    return out


def _features(db: pycolmap.Database, image_id: int) -> tuple[np.ndarray, np.ndarray]:
    xy = np.asarray(db.read_keypoints(image_id))[:, :2].astype(np.float32)
    descriptors = db.read_descriptors(image_id)
    return xy, np.asarray(getattr(descriptors, "data", descriptors), dtype=np.uint8).reshape(len(xy), 128)


def _write_two_views(database: Path, out: Path) -> None:
    """`two_views.npz`: what is known of every verified pair; see `two_views.TwoViews`."""
    db = pycolmap.Database.open(str(database))
    images = sorted(db.read_all_images(), key=lambda i: i.name)
    row_of = {image.image_id: n for n, image in enumerate(images)}
    keypoints = {i.image_id: np.asarray(db.read_keypoints(i.image_id))[:, :2] for i in images}
    pair_ids, geometries = db.read_two_view_geometries()
    pairs, kinds, match_pair, match_xy, match_inlier = [], [], [], [], []
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = _image_ids(pair_id)
        agreeing = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(agreeing) < FEWEST_INLIERS:
            continue
        matches = np.asarray(db.read_matches(a, b)).reshape(-1, 2)
        pairs.append((row_of[a], row_of[b]))
        kinds.append(pycolmap.TwoViewGeometryConfiguration(geometry.config).name)
        match_pair.append(np.full(len(matches), len(pairs) - 1))
        match_xy.append(np.stack([keypoints[a][matches[:, 0]], keypoints[b][matches[:, 1]]], axis=1))
        match_inlier.append(np.isin(matches @ (1 << 32, 1), agreeing @ (1 << 32, 1)))
    db.close()
    np.savez(
        out / "two_views.npz",
        names=np.array([i.name for i in images]),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        kinds=np.array(kinds, dtype=np.str_),
        match_pair=np.concatenate([*match_pair, np.zeros(0, np.int64)]).astype(np.int64),
        match_xy=np.concatenate([*match_xy, np.zeros((0, 2, 2))]).astype(np.float64),
        match_inlier=np.concatenate([*match_inlier, np.zeros(0, bool)]).astype(bool),
    )


def _write_model(model: pycolmap.Reconstruction, database: Path, out: Path) -> dict[str, Any]:
    """The COLMAP files, `points.npz` (points, observations, descriptors), and poses for the caller."""
    folder = out / "colmap"
    folder.mkdir(parents=True, exist_ok=True)
    model.update_point_3d_errors()
    model.write(str(folder))
    number = {point_id: n for n, point_id in enumerate(sorted(model.points3D))}
    db = pycolmap.Database.open(str(database))
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    point, view, xy, descriptors = [], [], [], []
    for n, image in enumerate(images):
        _, all_descriptors = _features(db, image.image_id)
        indices = list(image.get_observation_point2D_idxs())
        point += [number[image.point2D(i).point3D_id] for i in indices]
        view += [n] * len(indices)
        xy.append(np.array([image.point2D(i).xy for i in indices], dtype=np.float64).reshape(-1, 2))
        descriptors.append(all_descriptors[indices])
    db.close()
    points = [model.points3D[i] for i in sorted(model.points3D)]
    np.savez(
        out / "points.npz",
        xyz=np.array([p.xyz for p in points]).reshape(-1, 3),
        rgb=np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
        error_px=np.array([p.error for p in points]),
        obs_point=np.array(point, dtype=np.int64),
        obs_image=np.array(view, dtype=np.int64),
        obs_xy=np.concatenate(xy),
        obs_descriptor=np.concatenate(descriptors),
    )
    return {
        "mean_reprojection_px": model.compute_mean_reprojection_error(),
        "mean_track_length": model.compute_mean_track_length(),
        "points": len(points),
        "frames": {
            i.name: {"camera_from_world": i.cam_from_world().matrix().tolist(), "camera_id": i.camera_id}
            for i in images
        },
        "cameras": {str(k): _camera(c) for k, c in model.cameras.items()},
    }


def _camera(camera: pycolmap.Camera) -> dict[str, Any]:
    model, width, height = camera.model.name, camera.width, camera.height
    params = tuple(float(p) for p in camera.params)
    K, distortion, _ = intrinsics(ModelCamera(model, width, height, params), "the sweep's model")
    return {
        "model": model,
        "width": width,
        "height": height,
        "K": K.tolist(),
        "distortion": distortion.tolist(),
    }


def _say(fraction: float, message: str) -> None:
    print(f"PROGRESS {fraction:.3f} {message}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
