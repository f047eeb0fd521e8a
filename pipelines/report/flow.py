"""The report's flow section: optical flow as colours beside the frames, and how far it is trusted."""

from pathlib import Path

import numpy as np

from devrf.capture.errors import DevrfError
from devrf.flow.store import CameraFlow, read_flows
from devrf.pipelines.report.html import absent, figure, number, section, table, text
from devrf.pipelines.report.pictures import (
    data_uri,
    flow_picture,
    flow_wheel,
    picture_uri,
    png_bytes,
    read_picture,
)
from devrf.pipelines.report.run import RunFolder

CHECKS = "flow/flow.json"
PICTURE_WIDTH = 420
MAX_CAMERAS = 6
FULL_SCALE_PERCENTILE = 99.0  # of valid lengths in the pictures shown; the rest is shown saturated
LEAD = (
    "Where each pixel was in the camera's previous frame. Hue is direction, strength is length, grey is "
    "where the flow is not trained on: it does not lead there and back, or the data set's own mask says so."
)


def flow_section(run: RunFolder) -> str:
    """Frames beside their flow, at the pair that moves most, and the clips' checks."""
    if not run.has("flow"):
        return section("flow", "Flow", LEAD, absent(run.why_absent("flow")))
    return section("flow", "Flow", LEAD, _checks_table(run) + _pictures(run))


def _checks_table(run: RunFolder) -> str:
    rows = []
    for name, checks in run.cameras(CHECKS).items():
        key = f"cameras.{name}"
        shares = [
            number(checks.get(what), "%", 1, file=CHECKS, key=f"{key}.{what}", scale=100.0)
            for what in ("supported", "valid", "moving", "moving_valid")
        ]
        pairs = number(checks.get("pairs"), "", 0, file=CHECKS, key=f"{key}.pairs")
        trip = number(checks.get("round_trip_px"), "px", 2, file=CHECKS, key=f"{key}.round_trip_px")
        rows.append([f"<strong>{text(name)}</strong>", pairs, *shares, trip])
    head = ("camera", "pairs", "with texture", "of it valid", "moving", "of it valid", "round trip")
    method = f"<p>Method: {text(str(run.object(CHECKS).get('method', 'unknown')))}.</p>"
    return method + table(head, rows, source=CHECKS, numeric=range(1, 7))


def _pictures(run: RunFolder) -> str:
    try:
        flows = list(read_flows(run.folder("flow")).values())[:MAX_CAMERAS]
    except (DevrfError, OSError) as error:
        return absent(f"No flow pictures: {error}")
    files = {(f.camera_name, f.index): f.path for f in run.scene.dynamic} if run.scene is not None else {}
    shown = [(flow, _liveliest(flow)) for flow in flows if len(flow.index)]
    if not shown:
        return ""
    lengths = np.concatenate([_lengths(flow, n)[flow.valid[n]] for flow, n in shown])
    scale = float(np.percentile(lengths, FULL_SCALE_PERCENTILE)) if len(lengths) else 0.0
    scale = max(scale, 0.5)  # half a pixel is noise: a clip at rest must not look lively
    blocks = [_pair(flow, n, files.get((flow.camera, int(flow.index[n]))), scale) for flow, n in shown]
    wheel = data_uri(png_bytes(flow_wheel(96)), "image/png")
    key = (
        f'<div class="key-row"><img class="wheel" src="{wheel}" alt="Colour wheel">'
        f"<span>Rim: {scale:.1f} px between frames, or more. "
        "Shown: for each camera the pair of frames that moves most.</span></div>"
    )
    return f'<h3>Pictures</h3>{key}<div class="pics wide">{"".join(blocks)}</div>'


def _pair(flow: CameraFlow, n: int, path: Path | None, scale: float) -> str:
    picture = flow_picture(flow.flow[n].astype(np.float32), flow.valid[n], scale)
    index = int(flow.index[n])
    caption = f"flow to the frame before, valid on {100 * flow.valid[n].mean():.0f} % of this picture"
    parts = figure(picture_uri(picture, PICTURE_WIDTH), caption, f"flow of {flow.camera}, frame {index}")
    frame = read_picture(path) if path is not None else None
    if frame is not None:
        name = f"{flow.camera}, frame {index}"
        parts = figure(picture_uri(frame, PICTURE_WIDTH), text(name), name) + parts
    return f'<div class="pair">{parts}</div>'


def _liveliest(flow: CameraFlow) -> int:
    """The entry with the most valid motion."""
    return int(np.argmax([(_lengths(flow, n) * flow.valid[n]).sum() for n in range(len(flow.index))]))


def _lengths(flow: CameraFlow, n: int) -> np.ndarray:
    return np.linalg.norm(flow.flow[n].astype(np.float32), axis=-1)
