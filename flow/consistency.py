"""Can a flow be trusted? Forward-backward consistency, warping, and size changes that keep vectors right.

Flow conventions: `devrf.flow.estimator`. A pixel is valid when following it to the other picture and back
returns close to it (DynamicNeRF's rule, which the DeVRF data follow), and the way leads inside the picture.
What is covered in the other picture has no counterpart there: it fails the rule, which makes `~valid` an
occlusion mask too.
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import uniform_filter

from devrf.capture.resize import shrink

RELATIVE = 0.5  # share of the two flows' lengths the round trip may miss by (DynamicNeRF, alpha_1)
ABSOLUTE_PX = 0.5  # plus this much (DynamicNeRF, alpha_2)
LUMA = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)
SUPPORT_WINDOW = 11  # pixels; a little more than one 8 x 8 patch
SUPPORT_LEVELS = 0.5  # grey levels of deviation; sensor noise alone is more, a plain backdrop has none
RESIZED_VALID_SHARE = 0.5  # a reduced pixel is valid when half of what it covers was


def warp(
    image: Float32[np.ndarray, "height width *channels"], flow: Float32[np.ndarray, "height width 2"]
) -> Float32[np.ndarray, "height width *channels"]:
    """Fetch `image` where `flow` leads: out(x) = image(x + flow(x)), bilinear; the border is repeated."""
    height, width = flow.shape[:2]
    at = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + flow
    span = np.array([max(width - 1, 1), max(height - 1, 1)])
    grid = torch.from_numpy((2 * at / span - 1).astype(np.float32))[None]
    source = torch.from_numpy(np.ascontiguousarray(image.reshape(height, width, -1).transpose(2, 0, 1)))[None]
    out = F.grid_sample(source, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return out[0].permute(1, 2, 0).reshape(image.shape).numpy()


def round_trip(
    flow: Float32[np.ndarray, "height width 2"], back: Float32[np.ndarray, "height width 2"]
) -> Float32[np.ndarray, "height width"]:
    """How far [height, width], pixels, following `flow` and then `back` ends from where it began."""
    return np.linalg.norm(flow + warp(back, flow), axis=-1)


def consistent(
    flow: Float32[np.ndarray, "height width 2"], back: Float32[np.ndarray, "height width 2"]
) -> Bool[np.ndarray, "height width"]:
    """Valid where |f + b'| < 0.5 (|f| + |b'|) + 0.5 px and x + f lies inside the picture.

    Args:
        flow: f, from this picture to the other [height, width, 2], pixels.
        back: b, from the other picture to this one; b' is b fetched where f leads.
    """
    height, width = flow.shape[:2]
    returned = warp(back, flow)
    missed = np.linalg.norm(flow + returned, axis=-1)
    lengths = np.linalg.norm(flow, axis=-1) + np.linalg.norm(returned, axis=-1)
    x = np.arange(width) + flow[..., 0]
    y = np.arange(height)[:, None] + flow[..., 1]
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    return inside & (missed < RELATIVE * lengths + ABSOLUTE_PX)


def supported(image: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Where the picture has anything to follow: its grey levels vary within a window of 11 pixels.

    On a plain backdrop a flow method spreads what it found at the subject, consistently and wrongly.
    """
    grey = image.astype(np.float32) @ np.array(LUMA, np.float32)
    mean, square = (uniform_filter(x, SUPPORT_WINDOW, mode="mirror") for x in (grey, grey * grey))
    return square - mean * mean > SUPPORT_LEVELS**2


def resize_flow(
    flow: Float32[np.ndarray, "height width 2"],
    valid: Bool[np.ndarray, "height width"],
    width: int,
    height: int,
) -> tuple[Float32[np.ndarray, "out_height out_width 2"], Bool[np.ndarray, "out_height out_width"]]:
    """Reduce a flow to another picture size; vectors are scaled by the ratio of each side on its own.

    Each new pixel is the mean of the valid vectors it covers, so that wrong vectors do not bleed into
    right ones; where none is valid it is the mean of all.
    """
    size = (width, height)
    ratio = np.array([width / flow.shape[1], height / flow.shape[0]], dtype=np.float32)
    if (flow.shape[1], flow.shape[0]) == size:
        return flow.copy(), valid.copy()
    weight = valid.astype(np.float32)
    share = _resized(weight, width, height)
    total = _resized(flow * weight[..., None], width, height)
    plain = _resized(flow, width, height)
    mean = np.where(share[..., None] > 0, total / np.maximum(share, 1e-6)[..., None], plain)
    return mean * ratio, share >= RESIZED_VALID_SHARE


def _resized(
    x: Float32[np.ndarray, "height width *c"], width: int, height: int
) -> Float32[np.ndarray, "out_height out_width *c"]:
    """Smaller by area, larger by bilinear interpolation."""
    if height <= x.shape[0] and width <= x.shape[1]:
        return shrink(x, width, height)
    volume = torch.from_numpy(np.ascontiguousarray(x.reshape(*x.shape[:2], -1).transpose(2, 0, 1)))[None]
    out = F.interpolate(volume, (height, width), mode="bilinear", align_corners=False)
    return out[0].permute(1, 2, 0).reshape(height, width, *x.shape[2:]).numpy()


def warp_residuals(
    previous: UInt8[np.ndarray, "height width 3"],
    current: UInt8[np.ndarray, "height width 3"],
    flow_bwd: Float32[np.ndarray, "height width 2"],
    where: Bool[np.ndarray, "height width"],
) -> tuple[float, float]:
    """Does the flow lead to the previous picture? Mean absolute differences, grey levels, over `where`.

    Returns:
        (warped, still): current against the previous picture warped by the flow, and against it as it is.
        A flow with its direction or its sign swapped makes the first larger than the second.
    """
    if not where.any():
        return 0.0, 0.0
    before, now = previous.astype(np.float32), current.astype(np.float32)
    warped = np.abs(now - warp(before, flow_bwd))[where].mean()
    return float(warped), float(np.abs(now - before)[where].mean())


def endpoint_error(
    flow: Float[np.ndarray, "*batch 2"], truth: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    """Distance [...] between estimated and true vectors, pixels."""
    return np.linalg.norm(flow - truth, axis=-1)
