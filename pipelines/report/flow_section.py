"""Optical flow for the report: as colours beside the frames, at the pair of each camera that moves most."""

from typing import Any

import numpy as np
from jaxtyping import Float32

from devrf.capture.system.errors import DevrfError
from devrf.flow.store import CameraFlow, read_flows
from devrf.pipelines.report.data_uris import file_uri, flow_picture, picture_uri
from devrf.pipelines.report.run_reader import RunFolder

PICTURE_WIDTH = 420
MAX_CAMERAS = 6
FULL_SCALE_PERCENTILE = 99.0  # of valid lengths in the pictures shown; the rest is shown saturated
LEAST_SCALE_PX = 0.5  # less is noise: a clip at rest must not look lively


def flow(run: RunFolder) -> dict[str, Any]:
    """Frames beside their flow, and the scale of its colours."""
    if not run.has("flow"):
        return {}
    try:
        flows = list(read_flows(run.folder("flow")).values())[:MAX_CAMERAS]
    except (DevrfError, OSError) as error:
        return {"why_none": str(error)}
    shown = [(of, _liveliest(of)) for of in flows if len(of.index)]
    lengths = np.concatenate([_lengths(of, n)[of.valid[n]] for of, n in shown] or [np.zeros(0)])
    scale = float(np.percentile(lengths, FULL_SCALE_PERCENTILE)) if len(lengths) else 0.0
    scale = max(scale, LEAST_SCALE_PX)
    files = {(f.camera_name, f.index): f.path for f in run.scene.dynamic} if run.scene is not None else {}
    pairs = []
    for of, n in shown:
        index, valid = int(of.index[n]), 100 * of.valid[n].mean()
        frame = files.get((of.camera, index))
        uri = picture_uri(flow_picture(of.flow[n].astype(np.float32), of.valid[n], scale), PICTURE_WIDTH)
        pictures = [] if frame is None else [(file_uri(frame, PICTURE_WIDTH), f"frame {index}")]
        said = f"flow to the frame before, valid on {valid:.0f} % of this picture"
        pairs.append((of.camera, [*pictures, (uri, said)]))
    return {"scale": scale, "pairs": pairs}


def _liveliest(of: CameraFlow) -> int:
    """The entry with the most valid motion."""
    return int(np.argmax([(_lengths(of, n) * of.valid[n]).sum() for n in range(len(of.index))]))


def _lengths(of: CameraFlow, n: int) -> Float32[np.ndarray, "h w"]:
    return np.linalg.norm(of.flow[n].astype(np.float32), axis=-1)
