"""Flow on disk: one compact npz file per camera, readable without pickle.

`<camera>.npz` holds `camera` (text), `index` int32 [N], `flow` float16 [N, H, W, 2] and `valid` packed to
bits [N, H, ceil(W / 8)]. Half precision keeps vectors up to 64 px to 1/32 px or better. Entry n is the
backward flow of frame index[n] to the previous used frame of the same camera, in pixels of the
training-size picture; the first frame has no entry.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float16, Int

from devrf.capture.errors import FlowError


@dataclass(frozen=True)
class CameraFlow:
    """Backward flow of one camera's frames, all to the previous used frame.

    Attributes:
        camera: Name of the camera.
        index: Frame index of each entry [N], rising.
        flow: Vectors [N, height, width, 2]: u right, v down, pixels of the stored size.
        valid: Where the flow can be trusted [N, height, width].
    """

    camera: str
    index: Int[np.ndarray, " N"]
    flow: Float16[np.ndarray, "N height width 2"]
    valid: Bool[np.ndarray, "N height width"]


def write_flow(folder: Path, flow: CameraFlow) -> Path:
    """Write `<folder>/<camera>.npz`; vectors that are not valid are stored as zero (they compress away)."""
    path = folder / f"{flow.camera}.npz"
    np.savez_compressed(
        path,
        camera=np.array(flow.camera),
        index=flow.index.astype(np.int32),
        flow=np.where(flow.valid[..., None], flow.flow, np.float16(0)),
        valid=np.packbits(flow.valid, axis=-1),
    )
    return path


def read_flows(folder: Path) -> dict[str, CameraFlow]:
    """All cameras' flow in `folder`, by camera name.

    Raises:
        FlowError: A file that is damaged or is not one of ours.
    """
    flows = {}
    for path in sorted(folder.glob("*.npz")):
        try:
            with np.load(path, allow_pickle=False) as data:
                vectors = data["flow"]
                valid = np.unpackbits(data["valid"], axis=-1, count=vectors.shape[2]).astype(bool)
                flow = CameraFlow(str(data["camera"]), data["index"], vectors, valid)
        except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise FlowError(
                f"{path}: damaged or not a flow file ({error}); run again with --force flow"
            ) from error
        flows[flow.camera] = flow
    return flows
