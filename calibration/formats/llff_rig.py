"""Poses of LLFF (`poses_bounds.npy`) of fixed cameras, a row a clip: Neural 3D Video and sets like it.

Rows name no cameras. They are in the order of the names of the clips beside the file, where there are as many.
"""

from pathlib import Path

import numpy as np

from devrf.calibration.formats.found import FoundCalibration, FoundCamera
from devrf.capture.formats.llff import POSES, read_rows
from devrf.capture.formats.parts.opengl import cam_from_opengl
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.system.file_names import CLIP_SUFFIXES

FORMAT = "LLFF poses"


def is_llff(path: Path) -> bool:
    """Whether a file is LLFF's, by its name and what it holds."""
    return path.name == POSES and path.is_file()


def read_llff_rig(path: Path) -> FoundCalibration:
    """A camera of each row: square pixels, principal point in the middle, no distortion.

    Raises:
        InputError: Another table, or a row that is no camera.
    """
    try:
        rows = read_rows(path, 17)
    except CaptureError as error:
        raise InputError(error.code, str(error)) from None
    clips = sorted(
        p.stem for p in path.parent.iterdir() if p.suffix.lower() in CLIP_SUFFIXES and p.name[0] != "."
    )
    # with two numbers, by which nobody is matched to a clip
    names = clips if len(clips) == len(rows) else [f"row {n + 1} of {len(rows)}" for n in range(len(rows))]
    cameras = {}
    for n, row in enumerate(rows):
        matrix, where = row[:15].reshape(3, 5), f"{path}: row {n}"
        height, width, focal = matrix[:, 4].tolist()
        if not (min(height, width, focal) > 0 and np.isfinite(matrix).all()):
            text = f"{where}: height, width, focal are {[height, width, focal]}; expected numbers above 0"
            raise InputError("entry-wrong", text)
        opengl = np.column_stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2:4]])
        try:
            pose = cam_from_opengl(opengl, where)
        except CaptureError as error:
            raise InputError(error.code, str(error)) from None
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras[names[n]] = FoundCamera(K, np.zeros(5), "OPENCV", (round(width), round(height)), pose)
    note = "rows are taken in the order of the clips' names, lenses as without distortion"
    return FoundCalibration(FORMAT, cameras, "arbitrary", (note,))
