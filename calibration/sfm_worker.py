"""The one place that imports pycolmap; run as `python -m devrf.calibration.sfm_worker job.json`.

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
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

MAPPER_THREADS = 1  # more: whichever first pair is found first begins the model; as fast at 70 pictures
DISTORTION_OF = {  # our order k1, k2, p1, p2, k3 -> position in COLMAP's parameter vector
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {},
    "SIMPLE_RADIAL": {0: 3},
    "RADIAL": {0: 3, 1: 4},
    "OPENCV": {0: 4, 1: 5, 2: 6, 3: 7},
    "FULL_OPENCV": {0: 4, 1: 5, 2: 6, 3: 7, 4: 8},
    "OPENCV_FISHEYE": {0: 4, 1: 5, 2: 6, 3: 7},
}


def main(job_file: Path) -> None:
    """Do the job and write `result.json` beside it."""
    job = json.loads(job_file.read_text())
    result = {"map": map_images, "extract": extract_only}[job["task"]](job)
    (job_file.parent / "result.json").write_text(json.dumps(result))


def map_images(job: dict[str, Any]) -> dict[str, Any]:
    """Structure from motion of `job["groups"]` (pictures that share one camera each).

    The order import -> extract -> match -> map with fixed seeds, and mapping on one thread, gives the same
    model every time.
    """
    work = Path(job["work"])
    database = work / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = [name for group in job["groups"] for name in group["names"]]
    for group in job["groups"]:
        _import_group(database, job["image_path"], group)
    _say(0.02, f"features of {len(names)} pictures")
    _extract(database, job["image_path"], names, job["features"])
    _say(0.35, f"matching {len(job['pairs'])} pairs")
    _match(database, work, job["pairs"])
    best_pair = _best_pair(database)
    attempts = []
    for attempt in job["ladder"]:
        _say(0.7, f"mapping ({attempt['name']})")
        models = _attempt(database, work, job, attempt, names)
        registered = sorted((m.num_reg_images() for m in models), reverse=True)
        attempts.append({"name": attempt["name"], "registered": registered})
        if registered and registered[0] >= attempt["accept"] * len(names):
            break
        attempts[-1]["models"] = models
    else:
        models = max((a["models"] for a in attempts), key=_largest)
    chosen = (
        next(a for a in attempts if a["registered"] and a["registered"][0] == _largest(models))
        if models
        else {}
    )
    out: dict[str, Any] = {
        "given": len(names),
        "best_pair": best_pair,
        "mapper": chosen.get("name"),
        "attempts": [{"name": a["name"], "registered": a["registered"]} for a in attempts],
        "features_per_image": _features_per_image(database),
        "models": [],
    }
    if not models:
        return out
    models = sorted(models, key=lambda m: -m.num_reg_images())
    _say(0.98, "bundle adjustment")
    _polish(models[0], job)
    out["models"] = [sorted(i.name for i in m.images.values() if i.has_pose) for m in models]
    out.update(_write_model(models[0], database, Path(job["out"])))
    return out


def extract_only(job: dict[str, Any]) -> dict[str, Any]:
    """SIFT of single pictures: `<name>.npz` with xy [N, 2] and descriptors uint8 [N, 128] in job["out"]."""
    database = Path(job["work"]) / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = job["names"]
    pycolmap.import_images(str(database), job["image_path"], pycolmap.CameraMode.PER_IMAGE, names)
    _extract(database, job["image_path"], names, job["features"])
    db = pycolmap.Database.open(str(database))
    for image in db.read_all_images():
        xy, descriptors = _features(db, image.image_id)
        np.savez(Path(job["out"]) / f"{Path(image.name).stem}.npz", xy=xy, descriptors=descriptors)
    db.close()
    return {"names": names}


def _import_group(database: Path, image_path: str, group: dict[str, Any]) -> None:
    options = pycolmap.ImageReaderOptions()
    options.camera_model = group["model"]
    if group["params"] is not None:
        options.camera_params = ",".join(repr(float(p)) for p in group["params"])
    pycolmap.import_images(str(database), image_path, pycolmap.CameraMode.SINGLE, group["names"], options)
    if group["params"] is not None:
        db = pycolmap.Database.open(str(database))
        image = next(i for i in db.read_all_images() if i.name == group["names"][0])
        camera = db.read_camera(image.camera_id)
        camera.has_prior_focal_length = True
        db.update_camera(camera)
        db.close()


def _extract(database: Path, image_path: str, names: list[str], features: dict[str, Any]) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = features["max_image_size"]
    options.sift.max_num_features = features["max_num_features"]
    options.sift.first_octave = features["first_octave"]
    options.sift.peak_threshold = features["peak_threshold"]
    pycolmap.extract_features(
        str(database), image_path, names, extraction_options=options, device=pycolmap.Device.cpu
    )


def _match(database: Path, work: Path, pairs: list[list[str]]) -> None:
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
    database: Path, work: Path, job: dict[str, Any], attempt: dict[str, Any], names: list[str]
) -> list[pycolmap.Reconstruction]:
    output = work / attempt["name"].replace(" ", "_")
    output.mkdir()
    fixed = any(group["fixed"] for group in job["groups"])
    if attempt["mapper"] == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = 0
        options.num_threads = MAPPER_THREADS
        if not fixed:
            pycolmap.calibrate_view_graph(str(database))
        options.mapper.bundle_adjustment.refine_focal_length = not fixed
        options.mapper.bundle_adjustment.refine_extra_params = not fixed
        models = pycolmap.global_mapping(str(database), job["image_path"], str(output), options)
        return list(models.values())
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = MAPPER_THREADS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = (
        1.3  # _polish ends with a full one anyway
    )
    options.ba_refine_focal_length = options.ba_refine_extra_params = not fixed
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not fixed
    options.mapper.abs_pose_min_num_inliers = attempt["pose_inliers"]
    options.mapper.init_min_num_inliers = attempt["init_inliers"]
    options.mapper.init_min_tri_angle = attempt["init_angle_deg"]
    done = [0]

    def registered() -> None:
        done[0] += 1
        share = min(1.0, done[0] / len(names))
        _say(0.7 + 0.28 * share, f"mapping ({attempt['name']}): {done[0]} of {len(names)} pictures")

    models = pycolmap.incremental_mapping(
        str(database), job["image_path"], str(output), options, next_image_callback=registered
    )
    return list(models.values())


def _polish(model: pycolmap.Reconstruction, job: dict[str, Any]) -> None:
    """Bundle adjustment with a robust loss and, where enough pictures support it, a free principal point.

    COLMAP's mapper holds the principal point; phones are off by 1 % of the width, which turns every camera by
    half a degree. A principal point that runs away from the centre is put back.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.num_threads = MAPPER_THREADS
    fixed = any(group["fixed"] for group in job["groups"])
    options.refine_focal_length = options.refine_extra_params = not fixed
    options.refine_principal_point = not fixed and model.num_reg_images() >= job["principal_point_from"]
    before = {k: (c.principal_point_x, c.principal_point_y) for k, c in model.cameras.items()}
    pycolmap.bundle_adjustment(model, options)
    if any(
        max(abs(c.principal_point_x - before[k][0]), abs(c.principal_point_y - before[k][1])) > 0.05 * c.width
        for k, c in model.cameras.items()
    ):
        for k, c in model.cameras.items():
            c.principal_point_x, c.principal_point_y = before[k]
        options.refine_principal_point = False
        pycolmap.bundle_adjustment(model, options)


def _largest(models: list[pycolmap.Reconstruction]) -> int:
    return max((m.num_reg_images() for m in models), default=0)


def _best_pair(database: Path) -> dict[str, Any]:
    """The pair with the most verified matches: what a failed start is measured by."""
    db = pycolmap.Database.open(str(database))
    names = {image.image_id: image.name for image in db.read_all_images()}
    pair_ids, inliers = db.read_two_view_geometry_num_inliers()
    verified = int(sum(n >= 15 for n in inliers))
    best = int(np.argmax(inliers)) if len(inliers) else -1
    out = {"inliers": 0, "names": [], "verified_pairs": verified}
    if best >= 0:
        out["inliers"] = int(inliers[best])
        out["names"] = [names[i] for i in _image_ids(pair_ids[best])]
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


def _write_model(model: pycolmap.Reconstruction, database: Path, out: Path) -> dict[str, Any]:
    """The COLMAP files, `points.npz` (points, observations, descriptors), and poses for the caller."""
    folder = out / "colmap"
    folder.mkdir(parents=True)
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
    model = camera.model.name
    distortion = [0.0] * 5
    for ours, theirs in DISTORTION_OF[model].items():
        distortion[ours] = float(camera.params[theirs])
    return {
        "model": model,
        "width": camera.width,
        "height": camera.height,
        "K": camera.calibration_matrix().tolist(),
        "distortion": distortion,
    }


def _say(fraction: float, message: str) -> None:
    print(f"PROGRESS {fraction:.3f} {message}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
