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

from devrf.capture.photos.resize import shrink
from devrf.capture.system.errors import FlowError
from devrf.flow.estimator import FlowEstimator

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
    at = np.empty_like(flow)
    at[..., 0] = (np.arange(width, dtype=np.float32) + flow[..., 0]) * (2 / max(width - 1, 1)) - 1
    at[..., 1] = (np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]) * (2 / max(height - 1, 1)) - 1
    grid = torch.from_numpy(at)[None]
    source = torch.from_numpy(np.ascontiguousarray(image.reshape(height, width, -1).transpose(2, 0, 1)))[None]
    out = F.grid_sample(source, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return out[0].permute(1, 2, 0).reshape(image.shape).numpy()


def both_ways(
    estimator: FlowEstimator,
    image0: UInt8[np.ndarray, "height width 3"],
    image1: UInt8[np.ndarray, "height width 3"],
) -> tuple[
    Float32[np.ndarray, "height width 2"],
    Float32[np.ndarray, "height width"],
    Bool[np.ndarray, "height width"],
]:
    """Flow from image0 to image1 with its validity, by the flow back: flow, miss of the round trip, valid.

    Raises:
        FlowError: The estimator, which may be somebody's own, gives something else than flow.
    """
    flow, back = estimator.estimate(image0, image1), estimator.estimate(image1, image0)
    expected = (*image0.shape[:-1], 2)
    for found in (flow, back):
        shape, kind = getattr(found, "shape", ()), getattr(found, "dtype", type(found).__name__)
        if not isinstance(found, np.ndarray) or kind != np.float32 or shape != expected:
            wrong = f"flow.method {estimator.name}: estimate gave {kind} of shape {list(shape)}"
            what = f"a numpy array of float32 of shape {list(expected)}"
            raise FlowError("estimator-result-wrong", f"{wrong}, expected {what}")
    return flow, *round_trip(flow, back)


def round_trip(
    flow: Float32[np.ndarray, "height width 2"], back: Float32[np.ndarray, "height width 2"]
) -> tuple[Float32[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """How far following `flow` and then `back` ends from where it began, pixels, and where the flow is valid.

    Valid is where |f + b'| < 0.5 (|f| + |b'|) + 0.5 px and x + f lies inside the picture.

    Args:
        flow: f, from this picture to the other [height, width, 2], pixels.
        back: b, from the other picture to this one; b' is b fetched where f leads.
    """
    height, width = flow.shape[:2]
    returned = warp(back, flow)
    missed = _length(flow + returned)
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    return missed, inside & (missed < RELATIVE * (_length(flow) + _length(returned)) + ABSOLUTE_PX)


def _length(vectors: Float32[np.ndarray, "height width 2"]) -> Float32[np.ndarray, "height width"]:
    return np.hypot(vectors[..., 0], vectors[..., 1])


def luma(image: UInt8[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width"]:
    """Grey levels, 0 to 255."""
    return image.astype(np.float32) @ np.array(LUMA, np.float32)


def supported(image: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Where the picture has anything to follow: its grey levels vary within a window of 11 pixels.

    On a plain backdrop a flow method spreads what it found at the subject, consistently and wrongly.
    """
    grey = luma(image)
    mean, square = (uniform_filter(x, SUPPORT_WINDOW, mode="mirror") for x in (grey, grey * grey))
    return square - mean * mean > SUPPORT_LEVELS**2


def resize_flow(
    flow: Float32[np.ndarray, "height width 2"],
    weight: Float32[np.ndarray, "height width"],
    width: int,
    height: int,
) -> tuple[Float32[np.ndarray, "out_height out_width 2"], Float32[np.ndarray, "out_height out_width"]]:
    """Reduce a flow to another picture size; vectors are scaled by the ratio of each side on its own.

    Each new pixel is the weighted mean of the vectors it covers, so that wrong vectors (of weight 0) do not bleed
    into right ones, and has the mean weight of the right ones; where no weight is, it is the mean of all.
    """
    size = (width, height)
    ratio = np.array([width / flow.shape[1], height / flow.shape[0]], dtype=np.float32)
    if (flow.shape[1], flow.shape[0]) == size:
        return flow.copy(), weight.copy()
    share = _resized((weight > 0).astype(np.float32), width, height)
    weights = _resized(weight, width, height)
    total = _resized(flow * weight[..., None], width, height)
    plain = _resized(flow, width, height)
    mean = np.where(weights[..., None] > 0, total / np.maximum(weights, 1e-6)[..., None], plain)
    mean_weight = np.where(share >= RESIZED_VALID_SHARE, weights / np.maximum(share, 1e-6), np.float32(0))
    return mean * ratio, mean_weight.astype(np.float32)


def _resized(
    x: Float32[np.ndarray, "height width *c"], width: int, height: int
) -> Float32[np.ndarray, "out_height out_width *c"]:
    """Smaller by area, larger by bilinear interpolation."""
    if height <= x.shape[0] and width <= x.shape[1]:
        return shrink(x, width, height)
    volume = torch.from_numpy(np.ascontiguousarray(x.reshape(*x.shape[:2], -1).transpose(2, 0, 1)))[None]
    out = F.interpolate(volume, (height, width), mode="bilinear", align_corners=False)
    return out[0].permute(1, 2, 0).reshape(height, width, *x.shape[2:]).numpy()


def endpoint_error(
    flow: Float[np.ndarray, "*batch 2"], truth: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch"]:
    """Distance [...] between estimated and true vectors, pixels."""
    return np.linalg.norm(flow - truth, axis=-1)
