"""The one place that imports pycolmap; run as `python -m devrf.calibration.sweep.sfm_worker job.json`.

A separate process, because pycolmap can abort (its C++ checks end in std::terminate) and installs its own
handlers for SIGTERM and SIGSEGV. `zlib` is imported first: the pycolmap 4.2 wheel carries its own zlib, and
if it is the first to load one, PNG and npz writing corrupt the heap (facts: LD_DEBUG bindings).

A job is JSON: `task` is `map` or `extract`; the answer is `result.json` beside it, plus npz files. Lines
`PROGRESS <fraction> <text>` go to stdout, COLMAP's log to stderr. Pixels follow COLMAP: the centre of the
top-left pixel is (0.5, 0.5).
"""

import zlib  # noqa: F401, I001  must stay the first import, see above
import copy
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from devrf.calibration.sweep.pairs import Pair
from devrf.calibration.sweep.sfm_budget import Deadline, Matching
from devrf.calibration.sweep.sfm_mapping import Mapping
from devrf.calibration.sweep.sfm_output import (
    best_pair,
    cameras_of,
    features,
    features_per_image,
    write_model,
    write_two_views,
)
from devrf.calibration.sweep.two_views import against_model, read_two_views, torn_apart
from devrf.calibration.sweep.zoom_step import TwoLenses, zoom_step
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.durable import whole
from devrf.capture.system.processes import die_with_parent

MAPPER_THREADS = 1  # more: whichever first pair is found first begins the model; as fast at 70 pictures
SEED = 0  # the same sweep gives the same model
POLISH_TOLERANCE = 1e-8  # relative fall of the cost in one step; at 1e-6 focals still move by 0.01 px
POLISH_ITERATIONS = 200  # 20 to 40 are usual
# Where lenses have neither tangential distortion nor oblong pixels, residuals are at most 1.0005 times as large
# without them (ten captures).
PLAIN_LENS = 1.002
LEAST_POINTS = 30  # of a picture; with fewer its pose is a guess, and health refuses what is built on it
MOST_WEAK = 0.2  # of the pictures: where more are weak, leaving them out mends nothing
# Whether crops move about is seen long before the solver is done, and by these points of ten thousands.
CROP_POINTS, CROP_ITERATIONS = 3000, 25
FULL, PLAIN = pycolmap.CameraModelId.OPENCV, pycolmap.CameraModelId.RADIAL


def main(job_file: Path) -> None:
    """Do the job and write `result.json` beside it."""
    job = json.loads(job_file.read_text())
    die_with_parent(job["parent"])
    _leave(job, {"map": map_images, "extract": extract_only}[job["task"]](job))


def map_images(job: dict[str, Any]) -> dict[str, Any]:
    """Structure from motion of `job["groups"]` (pictures that share one camera each).

    The order import -> extract -> match -> map with fixed seeds, and mapping on one thread, gives the same
    model every time, as long as the time budget (`job["budget_s"]`) cuts nothing short.
    """
    work, deadline = Path(job["work"]), Deadline(job["budget_s"])
    database = work / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = [name for group in job["groups"] for name in group["names"]]
    cameras = [_import_group(database, job["image_path"], group) for group in job["groups"]]
    if job["places"]:
        _write_places(database, job["places"])
    _say(0.02, f"features of {len(names)} pictures")
    _extract(database, job, names)
    with pycolmap.Database.open(str(database)) as db:
        counts = features_per_image(db)
    matching = Matching(job["pairs"], job["wanted"], lambda some: _match(database, job, some), deadline)
    _say(0.35, f"matching {job['wanted']} pairs")
    matching.begin()
    held = {camera for camera, group in zip(cameras, job["groups"], strict=True) if group["fixed"]}

    def attempt(folder: Path, rung: dict[str, Any], left_s: float) -> list[pycolmap.Reconstruction]:
        return _attempt(database, folder, job, rung, held, left_s)

    def torn(model: pycolmap.Reconstruction) -> int:
        if not job["film"]:
            return 0
        with pycolmap.Database.open(str(database)) as db:
            write_two_views(db, _images_of, _kind, work)
        found = against_model(read_two_views(work / "two_views.npz"), cameras_of(model))
        return len(torn_apart(sorted(names), found["contradicting"]))

    mapping = Mapping(attempt, torn, work, len(names), deadline, _say)
    mapping.climb(job["ladder"])
    if mapping.registered < len(names) and matching.go_on():
        mapping.climb(job["ladder"][:1])
    with pycolmap.Database.open(str(database)) as db:
        pair = best_pair(db, _images_of)
    out: dict[str, Any] = {
        "given": len(names),
        "best_pair": pair,
        "pairs": matching.report(),
        "features_per_image": counts,
        "models": [],
    }
    if mapping.best is None:
        with pycolmap.Database.open(str(database)) as db:
            write_two_views(db, _images_of, _kind, Path(job["out"]))
        return out | mapping.report()
    if other := mapping.other_mapper(job["both"], job["ladder"]):
        # global mapping has no limit of its own: leave what there is
        _leave(job, out | _publish(mapping, database, job, None))
        mapping.climb(other)
    return out | _publish(mapping, database, job, held)


def _publish(mapping: Mapping, database: Path, job: dict[str, Any], held: set[int] | None) -> dict[str, Any]:
    """Adjust the best model, but for the intrinsics of held cameras, write it, and say what there is to say of it.

    Args:
        held: None leaves it as it is.
    """
    assert mapping.best is not None
    adjusted, weak = None, list[str]()
    if held is not None:
        _say(0.98, "bundle adjustment")
        weak = _without_weak(mapping.best)
        mapping.best, adjusted = _polish(mapping.best, job["principal_point_from"], held)
        asked = job["film"] and not held and mapping.deadline.left_s() > 0
        adjusted["zoom"] = _zoomed(mapping.best, not adjusted["plain_lens"]) if asked else None
        adjusted["crops"] = _crops(mapping.best) if mapping.deadline.left_s() > 0 else None
    with pycolmap.Database.open(str(database)) as db:
        write_two_views(db, _images_of, _kind, Path(job["out"]))
        written = write_model(mapping.best, db, Path(job["out"]))
    return {
        **mapping.report(),
        "models": [sorted(i.name for i in m.images.values() if i.has_pose) for m in mapping.models],
        "adjustment": adjusted,
        "weak": weak,
        **written,
    }


def _images_of(pair: Any) -> tuple[int, int]:
    """The images of a pair, as one number or two."""
    first, second = pair if isinstance(pair, (tuple, list)) else pycolmap.pair_id_to_image_pair(pair)
    return int(first), int(second)


def _kind(config: int) -> str:
    """COLMAP's name of what a pair fits."""
    return pycolmap.TwoViewGeometryConfiguration(config).name


def _leave(job: dict[str, Any], result: dict[str, Any]) -> None:
    """Write `result.json`; whoever has to stop this process finds the best so far."""
    with whole(Path(job["work"]) / "result.json") as new:
        new.write_text(json.dumps(result))


def extract_only(job: dict[str, Any]) -> dict[str, Any]:
    """SIFT of single pictures: `<name>.npz` with xy [N, 2] and descriptors uint8 [N, 128] in job["out"]."""
    database = Path(job["work"]) / "database.db"
    pycolmap.Database.open(str(database)).close()
    names = job["names"]
    pycolmap.import_images(str(database), job["image_path"], pycolmap.CameraMode.PER_IMAGE, names)
    _extract(database, job, names)
    with pycolmap.Database.open(str(database)) as db:
        for image in db.read_all_images():
            xy, descriptors = features(db, image.image_id)
            np.savez(Path(job["out"]) / f"{Path(image.name).stem}.npz", xy=xy, descriptors=descriptors)
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
    wanted = job["features"]
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = wanted["max_image_size"]
    options.sift.max_num_features = wanted["max_num_features"]
    options.sift.first_octave = wanted["first_octave"]
    options.sift.peak_threshold = wanted["peak_threshold"]
    options.num_threads = _threads(job)
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


def _threads(job: dict[str, Any]) -> int:
    return job["threads"] or usable_cores()


def _match(database: Path, job: dict[str, Any], pairs: list[Pair]) -> None:
    pair_file = Path(job["work"]) / "pairs.txt"
    pair_file.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pair_file)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = _threads(job)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.match_image_pairs(str(database), matching, pairing, verification, pycolmap.Device.cpu)


def _attempt(
    database: Path,
    output: Path,
    job: dict[str, Any],
    rung: dict[str, Any],
    held: set[int],
    left_s: float,
) -> list[pycolmap.Reconstruction]:
    if rung["mapper"] == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = SEED
        options.num_threads = MAPPER_THREADS
        if not held:
            focal_lengths = pycolmap.ViewGraphCalibrationOptions()
            focal_lengths.random_seed = SEED  # it estimates relative poses anew
            pycolmap.calibrate_view_graph(str(database), focal_lengths)
        options.mapper.bundle_adjustment.refine_focal_length = not held
        options.mapper.bundle_adjustment.refine_extra_params = not held
        models = pycolmap.global_mapping(str(database), job["image_path"], str(output), options)
        return list(models.values())
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.num_threads = MAPPER_THREADS
    # _polish ends with a full one anyway
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
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
    done, pictures = [0], sum(len(group["names"]) for group in job["groups"])

    def registered() -> None:
        done[0] += 1
        share = min(1.0, done[0] / pictures)
        # Pictures that fit no model are tried in another.
        placed = f"{done[0]} of {pictures} pictures" if share < 1 else f"{pictures} pictures"
        _say(0.7 + 0.28 * share, f"mapping ({rung['name']}): {placed}")

    models = pycolmap.incremental_mapping(
        str(database), job["image_path"], str(output), options, next_image_callback=registered
    )
    return list(models.values())


def _without_weak(model: pycolmap.Reconstruction) -> list[str]:
    """Take pictures out whose few points do not fix them (shaken ones, mostly), and name them."""
    seen = [i for i in model.images.values() if i.has_pose]
    weak = [i for i in seen if i.num_points3D < LEAST_POINTS]
    if len(weak) > MOST_WEAK * len(seen):
        return []
    for image in weak:
        model.deregister_frame(image.frame_id)
    return sorted(i.name for i in weak)


def _zoomed(model: pycolmap.Reconstruction, doubted: bool) -> dict[str, Any] | None:
    """Where a film's lens zoomed: the first picture after it, both focal lengths, the residuals' size with them over
    that without.
    """
    seen = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    if len(model.cameras) > 1 or model.cameras[seen[0].camera_id].model != FULL:
        return None
    options = _adjustment()

    def fit(cut: int) -> TwoLenses:
        two = pycolmap.Reconstruction()
        for n, part in enumerate((seen[:cut], seen[cut:]), 1):
            if part:
                _add_pictures(two, n, part, _plain(model.cameras[part[0].camera_id]))
        _add_points(two, list(model.points3D.values()))
        _adjust(two, options, set())
        focals = [two.cameras[n].mean_focal_length() for n in sorted(two.cameras)]
        return TwoLenses(_error(two), focals[0], focals[-1])

    found = zoom_step(fit, len(seen), doubted)
    if found is None:
        return None
    cut, lenses, share = found
    return {
        "from": seen[cut].name,
        "focal_px": [lenses.before_px, lenses.after_px],
        "error": share,
    }


def _crops(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Whether each picture wants a principal point of its own, as where stabilisation moves a crop about the sensor.

    Returns:
        `apart`: how far these points lie from the median of their lens, over the width, median over pictures;
        `error`: the residuals' size with them over that without.
    """
    seen = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    points = [model.points3D[k] for k in sorted(model.points3D)]
    points = points[:: len(points) // CROP_POINTS + 1]
    own = pycolmap.Reconstruction()
    for image in seen:
        _add_pictures(own, image.image_id, [image], model.cameras[image.camera_id])
    _add_points(own, points)
    before = _error(own)
    options = _adjustment()
    options.ceres.solver_options.max_num_iterations = CROP_ITERATIONS
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_principal_point = True
    _adjust(own, options, set())
    off = []
    for number, lens in model.cameras.items():
        mine = [own.cameras[i.image_id] for i in seen if i.camera_id == number]
        centres = np.array([[c.principal_point_x, c.principal_point_y] for c in mine]).reshape(-1, 2)
        off += (np.linalg.norm(centres - np.median(centres, axis=0), axis=1) / lens.width).tolist()
    return {"apart": float(np.median(off)), "error": _error(own) / max(before, 1e-9)}


def _plain(lens: pycolmap.Camera) -> pycolmap.Camera:
    """One that begins as this one and has neither tangential distortion nor oblong pixels."""
    fx, fy, *centre_and_radial = lens.params[:6]
    params = [float(np.sqrt(fx * fy)), *centre_and_radial]
    return pycolmap.Camera(model=PLAIN, width=lens.width, height=lens.height, params=params)


def _add_pictures(
    model: pycolmap.Reconstruction, camera_id: int, images: list[pycolmap.Image], lens: pycolmap.Camera
) -> None:
    """Add pictures and where they show features, with a camera of their own that begins as this one."""
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=camera_id,
            model=lens.model,
            width=lens.width,
            height=lens.height,
            params=list(lens.params),
        )
    )
    for image in images:
        xy = pycolmap.Point2DList([pycolmap.Point2D(p.xy) for p in image.points2D])
        own = pycolmap.Image(name=image.name, points2D=xy, camera_id=camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(own, image.cam_from_world())


def _add_points(model: pycolmap.Reconstruction, points: list[pycolmap.Point3D]) -> None:
    for point in points:
        model.add_point3D(point.xyz, pycolmap.Track(list(point.track.elements)), point.color)


def _polish(
    model: pycolmap.Reconstruction, principal_point_from: int, held: set[int]
) -> tuple[pycolmap.Reconstruction, dict[str, Any]]:
    """Bundle adjustment with a robust loss, a principal point where pictures support it, and no richer a lens.

    COLMAP's mapper holds the principal point; phones are off by 1 % of the width, which turns every camera by
    half a degree. A principal point that runs away from the centre is put back. Lenses lose what does not
    make residuals smaller: tangential distortion looks like a principal point that is off.

    Args:
        model: Mapped pictures; changed.
        principal_point_from: Pictures of a camera from which its principal point is free.
        held: Cameras whose intrinsics are known.
    """
    adjusted = _adjusted(model, principal_point_from, held)
    plain = copy.deepcopy(model)
    lenses = [c for k, c in plain.cameras.items() if k not in held and c.model == FULL]
    for lens in lenses:
        fx, fy, *centre_and_radial = lens.params[:6]
        lens.model, lens.params = PLAIN, [(fx + fy) / 2, *centre_and_radial]
    again = _adjusted(plain, principal_point_from, held) if lenses else adjusted
    if not lenses or _error(plain) > PLAIN_LENS * _error(model):
        return model, adjusted | {"plain_lens": False}
    for lens in lenses:
        f, *centre_and_radial = lens.params
        lens.model, lens.params = FULL, [f, f, *centre_and_radial, 0.0, 0.0]
    return plain, again | {"plain_lens": True}


def _error(model: pycolmap.Reconstruction) -> float:
    model.update_point_3d_errors()
    return model.compute_mean_reprojection_error()


def _adjustment() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.max_num_iterations = POLISH_ITERATIONS
    options.ceres.solver_options.function_tolerance = POLISH_TOLERANCE
    options.ceres.solver_options.num_threads = MAPPER_THREADS
    return options


def _adjusted(model: pycolmap.Reconstruction, principal_point_from: int, held: set[int]) -> dict[str, Any]:
    options = _adjustment()
    seen = Counter(i.camera_id for i in model.images.values() if i.has_pose)
    free = {camera: count for camera, count in seen.items() if camera not in held}
    options.refine_principal_point = bool(free) and min(free.values()) >= principal_point_from
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


def _say(fraction: float, message: str) -> None:
    print(f"PROGRESS {fraction:.3f} {message}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
