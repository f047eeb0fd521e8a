"""A rig as a COLMAP model without points, in and out: an image a camera.

Read: `cam0.png`, or pictures in a folder a camera (`cam0/000001.png`), which must agree about the pose: cameras are
fixed. The unit of a model is arbitrary. Written: images named `<camera>.png`; there are no pictures.
"""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from devrf.calibration.formats.found import FoundCalibration, FoundCamera
from devrf.capture.camera import Camera
from devrf.capture.formats.colmap.colmap_model import Model, ModelImage, read_model, write_model
from devrf.capture.formats.colmap.colmap_poses import pose, quat_wxyz
from devrf.capture.formats.colmap.colmap_rigs import common_rig, write_rigs
from devrf.capture.formats.colmap.colmap_scene import intrinsics, model_camera, model_folder, model_folders
from devrf.capture.formats.parts.files import with_slashes
from devrf.capture.system.errors import InputError

FORMAT = "COLMAP model"
# rad; of the rig's size: what a fixed camera's pictures may differ by
SAME_ROTATION, SAME_POSITION = 1e-3, 1e-3


def is_colmap(folder: Path) -> bool:
    """Whether a folder is, or has, a model."""
    return bool(model_folders(folder))


def read_colmap_rig(folder: Path) -> FoundCalibration:
    """Cameras of a model (the largest, where there are several), by the name of their image or their folder."""
    notes: list[str] = []
    place = model_folder(folder, notes)
    model = read_model(place)
    seen: dict[str, list[FoundCamera]] = {}
    for number, image in sorted(model.images.items()):
        where = f"{place}: image {number} ({image.name})"
        camera = model.cameras.get(image.camera_id)
        if camera is None:
            text = f"{where}: its camera {image.camera_id} is not in the model; export it again"
            raise InputError("camera-missing", text)
        K, lens, lens_model = intrinsics(camera, where)
        path = PurePosixPath(with_slashes(image.name))
        name = path.parts[-2] if len(path.parts) > 1 else path.stem
        size = (camera.width, camera.height)
        seen.setdefault(name, []).append(FoundCamera(K, lens, lens_model, size, pose(image, where)))
    if not seen:
        text = f"{place}: no image is registered; expected a model with an image of every camera"
        raise InputError("pictures-none", text)
    _check_fixed(place, seen)
    return FoundCalibration(
        FORMAT, {name: cameras[0] for name, cameras in seen.items()}, "arbitrary", tuple(notes)
    )


def write_colmap_rig(folder: Path, cameras: Mapping[str, Camera], metric: bool) -> None:
    """`sparse/0`, which every tool that reads COLMAP opens."""
    images = {}
    for n, (name, camera) in enumerate(cameras.items()):
        rotation = quat_wxyz(camera.cam_from_world[:, :3])
        images[n + 1] = ModelImage(f"{name}.png", n + 1, rotation, camera.cam_from_world[:, 3])
    models = {n + 1: model_camera(camera) for n, camera in enumerate(cameras.values())}
    model = Model(models, images, {})
    write_model(folder / "sparse" / "0", model)
    write_rigs(folder / "sparse" / "0", *common_rig(model, [list(images)]))


def _check_fixed(place: Path, seen: Mapping[str, list[FoundCamera]]) -> None:
    poses = {name: np.array([c.cam_from_world for c in cameras]) for name, cameras in seen.items()}
    centres = {name: -np.einsum("nji,nj->ni", T[:, :, :3], T[:, :, 3]) for name, T in poses.items()}
    everywhere = np.concatenate(list(centres.values()))
    extent = float(np.linalg.norm(np.ptp(everywhere, axis=0)))
    for name, T in poses.items():
        turn = float(np.abs(T[:, :, :3] - T[0, :, :3]).max())
        step = float(np.linalg.norm(centres[name] - centres[name][0], axis=1).max())
        if turn > SAME_ROTATION or step > SAME_POSITION * extent:
            wrong = f"{place}: the {len(T)} images of '{name}' stand at different places (up to {step:.3g} units apart)"
            remedy = "expected one pose of a fixed camera; keep one image of it in the model"
            raise InputError("camera-not-fixed", f"{wrong}; {remedy}")
