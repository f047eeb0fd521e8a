"""A COLMAP model with its pictures as a scene at rest: `sparse/0`, `sparse/1`, … (or `sparse`) and `images/`.

Our addition, which other programs use too: `test.txt` beside the model, names of the test pictures. Written, pictures
in motion are a second folder of the same kind, `motion/`, with the fixed cameras as a rig.
"""

from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera, LensModel
from devrf.capture.formats.colmap.colmap_model import (
    UNKNOWN_ERROR_PX,
    Model,
    ModelCamera,
    ModelImage,
    ModelPoint,
    count_images,
    is_model,
    read_model,
    write_model,
)
from devrf.capture.formats.colmap.colmap_poses import pose, quat_wxyz
from devrf.capture.formats.colmap.colmap_rigs import (
    ModelFrame,
    ModelRig,
    common_rig,
    own_rigs,
    simultaneous,
    write_rigs,
)
from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.formats.parts.export import Export, copied
from devrf.capture.formats.parts.files import Header, find_picture, read_header
from devrf.capture.formats.parts.listed import TEST_LIST, pictures_of_list, read_names
from devrf.capture.formats.parts.point_colours import point_colours
from devrf.capture.photos.picture_files import PICTURE_SUFFIXES, natural_key
from devrf.capture.scene import PosedFrame, SparsePoints
from devrf.capture.system.errors import CaptureError

MOTION, TIMES = "motion", "times.csv"
LARGEST_ERROR_PX, SHORTEST_TRACK = 2.0, 3  # as for our own sweeps: points beyond are often wrong
READ_MODELS: dict[str, LensModel] = {  # without distortion, or with the first coefficients of ours
    "SIMPLE_PINHOLE": "OPENCV",
    "PINHOLE": "OPENCV",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "FULL_OPENCV": "OPENCV",
    "SIMPLE_FISHEYE": "OPENCV_FISHEYE",
    "FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
TWO_FOCAL = ("PINHOLE", "OPENCV", "FULL_OPENCV", "FISHEYE", "OPENCV_FISHEYE")


def read_colmap(folder: Path, notes: list[str]) -> Pictures:
    """A scene at rest with its sparse points."""
    place = model_folder(folder, notes)
    model = read_model(place)
    if not model.images:
        text = f"{place}: no image is registered; expected a model with pictures"
        raise CaptureError("pictures-none", text)
    names = read_names(place / TEST_LIST)
    order = sorted(model.images, key=lambda number: natural_key(model.images[number].name))
    test = pictures_of_list(names or [], [model.images[number].name for number in order], TEST_LIST, notes)
    frames, grey = [], 0
    for n, number in enumerate(order):
        image = model.images[number]
        where = f"{place}: image {number} ({image.name})"
        header = read_header(find_picture(folder / "images", image.name))
        grey += header.grey
        intrinsics = model.cameras.get(image.camera_id)
        if intrinsics is None:
            text = f"{where}: its camera {image.camera_id} is not in the model; export it again"
            raise CaptureError("camera-missing", text)
        split = "test" if n in test else "train"
        camera = _camera(intrinsics, image, header, where)
        frames.append(PosedFrame(header.path, camera, "static", n, None, None, split))
    if grey:
        notes.append(f"{grey} grey pictures, read as RGB")
    files = (folder / "images").rglob("*")
    beside = {p.resolve() for p in files if p.suffix.lower() in PICTURE_SUFFIXES and p.name[0] != "."}
    if unused := len(beside - {f.path for f in frames}):
        used = f"{len(beside) - unused} of the {len(beside)} pictures of images/"
        notes.append(f"{used} are in the model; the others have no camera and are not used")
    points = _points(model, order)
    if model.points and points is None:
        few = sum(len(set(point.images.tolist())) < SHORTEST_TRACK for point in model.points.values())
        notes.append(
            f"{len(model.points)} sparse points are not used, the box is a loose cube: {few} name fewer than "
            f"{SHORTEST_TRACK} pictures that show them, the others have errors of {LARGEST_ERROR_PX:g} px or more"
        )
    return Pictures(tuple(frames), has_split=names == [] or bool(test), points=points)


def write_colmap(export: Export) -> None:
    """`sparse/0` with each camera's own lens, the points, and the pictures as they are; motion in `motion/`."""
    scene = export.scene
    if not scene.static:
        text = "colmap holds a scene at rest, and this scene has no sweep; export to nerfstudio"
        raise CaptureError("rest-missing", text)
    still = copied(export, scene.static, "images")
    model = _model(still, export.folder / "images", scene.points, shared=True)
    _write(export.folder, model, *own_rigs(model), still)
    if not scene.dynamic:
        return
    moving = copied(export, scene.dynamic, f"{MOTION}/images")
    model = _model(moving, export.folder / MOTION / "images", None, shared=False)
    groups = simultaneous([(f.camera_name, f.time_s or 0.0) for f in moving])
    rigs, frames = common_rig(model, [[n + 1 for n in group] for group in groups])
    _write(export.folder / MOTION, model, rigs, frames, moving)
    frame_of = {image: number for number, frame in frames.items() for image in frame.images}
    rows = [
        f"{model.images[n + 1].name},{frame_of[n + 1]},{f.camera_name},{f.time_s:.6f},{f.split}\n"
        for n, f in enumerate(moving)
    ]
    (export.folder / MOTION / TIMES).write_text("image,frame,camera,time_s,split\n" + "".join(rows))
    how = (
        f"with its {len(model.cameras)} cameras as a rig, a frame for pictures taken at about the same time"
        if len(rigs) == 1
        else "a rig of one for each camera, because cameras move or change"
    )
    export.notes.append(
        f"the {len(moving)} pictures in motion are a model of their own, {MOTION}/sparse/0, in the same world, {how}; "
        f"COLMAP has no times: they are in {MOTION}/{TIMES}"
    )


def _model(frames: tuple[PosedFrame, ...], base: Path, points: SparsePoints | None, *, shared: bool) -> Model:
    """A model of written pictures; cameras of the same lens are one where they may be `shared`."""
    cameras: dict[tuple[str, ModelCamera], int] = {}
    images: dict[int, ModelImage] = {}
    for n, frame in enumerate(frames):
        camera = frame.camera
        key = ("" if shared else frame.camera_name, model_camera(camera))
        camera_id = cameras.setdefault(key, len(cameras) + 1)
        ids, keypoints = np.zeros(0, np.int64), np.zeros((0, 2))
        if points is not None:
            seen = points.obs_point[points.obs_frame == n]
            pixels = camera.project(points.xyz[seen])
            front = np.isfinite(pixels).all(axis=-1)
            ids, keypoints = seen[front].astype(np.int64) + 1, pixels[front]
        rotation = quat_wxyz(camera.cam_from_world[:, :3])
        name = frame.path.relative_to(base).as_posix()
        images[n + 1] = ModelImage(name, camera_id, rotation, camera.cam_from_world[:, 3], keypoints, ids)
    written: dict[int, ModelPoint] = {}
    if points is not None:
        none, colours = np.zeros(0, np.int64), point_colours(points, frames).tolist()
        for n, (xyz, rgb) in enumerate(zip(points.xyz, colours, strict=True)):
            written[n + 1] = ModelPoint(xyz, UNKNOWN_ERROR_PX, none, tuple(rgb))
    return Model({number: camera for (_, camera), number in cameras.items()}, images, written)


def _write(
    folder: Path,
    model: Model,
    rigs: dict[int, ModelRig],
    frames: dict[int, ModelFrame],
    written: tuple[PosedFrame, ...],
) -> None:
    place = folder / "sparse" / "0"
    write_model(place, model)
    write_rigs(place, rigs, frames)
    test = [model.images[n + 1].name for n, frame in enumerate(written) if frame.split == "test"]
    (place / TEST_LIST).write_text("".join(f"{name}\n" for name in test))


def model_folders(folder: Path) -> list[Path]:
    """Where a folder holds models: in folders of `sparse` (`0`, `1`, …) and `sparse`; else the folder itself."""
    sparse = folder / "sparse"
    below = sorted(sparse.iterdir(), key=lambda p: natural_key(p.name)) if sparse.is_dir() else []
    return list(filter(is_model, [*below, sparse])) or list(filter(is_model, [folder]))


def model_folder(folder: Path, notes: list[str]) -> Path:
    """The model with the most pictures: the mapper numbers models as it began them. Of equal ones the first.

    Args:
        folder: A data set, or a calibration.
        notes: Where there are several, what they hold is added here, in words.
    Raises:
        CaptureError: There is no model, or one whose pictures cannot be counted.
    """
    places = model_folders(folder)
    if not places:
        wrong = f"{folder}: no cameras.bin or cameras.txt in sparse/0, sparse or the folder itself"
        raise CaptureError("file-missing", f"{wrong}; expected a COLMAP model and images/")
    if len(places) == 1:
        return places[0]
    counts = {place: count_images(place) for place in places}
    largest = max(places, key=counts.__getitem__)
    each = ", ".join(f"{place.relative_to(folder)} {count} pictures" for place, count in counts.items())
    notes.append(f"{len(places)} models: {each}; the largest is read, {largest.relative_to(folder)}")
    return largest


def intrinsics(camera: ModelCamera, where: str) -> tuple[np.ndarray, np.ndarray, LensModel]:
    """K [3, 3], distortion [5] and lens model of a COLMAP camera.

    Raises:
        CaptureError: A lens model that is not read.
    """
    p = camera.params
    if camera.model not in READ_MODELS or (camera.model == "FULL_OPENCV" and any(p[9:])):
        wrong = f"{where}: lens model {camera.model} is not read; expected {', '.join(READ_MODELS)}"
        remedy = "(FULL_OPENCV with k4 to k6 of 0); undistort the pictures with COLMAP first"
        raise CaptureError("lens-unread", f"{wrong} {remedy}")
    fx, fy, cx, cy, *lens = p if camera.model in TWO_FOCAL else (p[0], *p)
    distortion = np.zeros(5)
    distortion[: len(lens[:5])] = lens[:5]
    if not (np.isfinite(p).all() and min(fx, fy) > 0):
        text = f"{where}: camera parameters are {list(p)}; expected focal lengths above 0"
        raise CaptureError("entry-wrong", text)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion, READ_MODELS[camera.model]


def _camera(camera: ModelCamera, image: ModelImage, header: Header, where: str) -> Camera:
    if (header.width, header.height) != (camera.width, camera.height):
        wrong = f"{header.path}: picture is {header.size}, {where} says {camera.width}x{camera.height}"
        raise CaptureError("picture-size-wrong", f"{wrong}; use the pictures that the model was made from")
    K, distortion, model = intrinsics(camera, where)
    return Camera(camera.width, camera.height, K, pose(image, where), distortion, model)


def _points(model: Model, order: list[int]) -> SparsePoints | None:
    """Good points, and which pictures show them."""
    place = {number: n for n, number in enumerate(order)}
    xyz, obs_point, obs_frame = [], [], []
    for point in model.points.values():
        seen = sorted({place[i] for i in point.images.tolist() if i in place})
        if len(seen) >= SHORTEST_TRACK and point.error_px < LARGEST_ERROR_PX and np.isfinite(point.xyz).all():
            obs_point += [len(xyz)] * len(seen)
            obs_frame += seen
            xyz.append(point.xyz)
    if not xyz:
        return None
    return SparsePoints(np.array(xyz), np.array(obs_point, np.int64), np.array(obs_frame, np.int64))


def model_camera(camera: Camera) -> ModelCamera:
    """The simplest of COLMAP's models that holds the lens."""
    K, (k1, k2, p1, p2, k3) = camera.K, camera.distortion.tolist()
    params = [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
    model = "PINHOLE"
    if camera.model == "OPENCV_FISHEYE":
        model, params = "OPENCV_FISHEYE", [*params, *camera.distortion[:4].tolist()]
    elif k3:
        model, params = "FULL_OPENCV", [*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    elif any((k1, k2, p1, p2)):
        model, params = "OPENCV", [*params, k1, k2, p1, p2]
    return ModelCamera(model, camera.width, camera.height, tuple(params))
