"""Backward flow that data sets bring: `NNN_bwd.npz` with `flow` [H, W, 2] and `mask` [H, W].

`flow` leads from the picture to the one before it of the same camera, in pixels: x right, then y down; `mask`
says where it can be trusted. The file belongs to a picture of the same size; what differs is refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from devrf.capture.scene import PosedFrame
from devrf.capture.system.arrays import ArrayError, npz_shapes, read_npz
from devrf.capture.system.errors import CaptureError

Flow = tuple[Float32[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]


def flow_name(number: int) -> str:
    """Name of the flow file of entry `number`."""
    return f"{number:03d}_bwd.npz"


def read_flow_file(path: Path) -> Flow:
    """Vectors and where they can be trusted.

    Raises:
        CaptureError: The file is damaged or is not a flow file.
    """
    try:
        data = read_npz(path, ("flow", "mask"))
    except ArrayError as error:
        raise _damaged(error.code, error) from None
    flow, mask = data["flow"].astype(np.float32), np.asarray(data["mask"] > 0)
    if flow.shape != (*mask.shape, 2):
        wrong = f"{path}: flow has shape {list(flow.shape)}, mask {list(mask.shape)}"
        raise _damaged("flow-size-wrong", wrong)
    finite = np.asarray(np.isfinite(flow).all(axis=-1))
    return np.where(finite[..., None], flow, np.float32(0)), mask & finite


def with_flow_files(
    frames: Sequence[PosedFrame], file_of: Callable[[int], Path], size: tuple[int, int] | None = None
) -> tuple[PosedFrame, ...]:
    """Frames with their flow files, looked for and their sizes compared before anything is computed.

    Args:
        frames: Training frames, in the order that numbers the files.
        file_of: The file of the n-th frame. The first frame of each camera needs none.
        size: (width, height) of the flow where it is not that of the pictures.
    Raises:
        CaptureError: A file is missing while others are there, is damaged, or has another size.
    """
    first: dict[str, float] = {}
    for frame in frames:
        first[frame.camera_name] = min(frame.time or 0.0, first.get(frame.camera_name, np.inf))
    out = []
    for number, frame in enumerate(frames):
        path = file_of(number)
        if (frame.time or 0.0) <= first[frame.camera_name]:
            out.append(frame)
            continue
        if not path.is_file():
            wrong = f"{path}: flow of {frame.path.name} not found, while the folder is there"
            remedy = "copy it again, or remove the whole folder so that flow is computed"
            raise CaptureError("file-missing", f"{wrong}; {remedy}")
        width, height = size or (frame.camera.width, frame.camera.height)
        try:
            found = tuple(npz_shapes(path, ("flow", "mask")))
        except ArrayError as error:
            raise _damaged(error.code, error) from None
        if found != ((height, width, 2), (height, width)):
            of = f"its picture {frame.path.name}" if size is None else "the pictures beside its folder"
            wrong = f"{path}: flow has shape {list(found[0])} and mask {list(found[1])}"
            expected = f"expected [{height}, {width}, 2] and [{height}, {width}], the size of {of}"
            remedy = "compute the flow on the pictures of the data set"
            raise CaptureError("flow-size-wrong", f"{wrong}; {expected}; {remedy}")
        out.append(replace(frame, flow=path.resolve()))
    return tuple(out)


def _damaged(code: str, what: object) -> CaptureError:
    return CaptureError(code, f"{what}; expected an npz with flow and mask; copy it again")
