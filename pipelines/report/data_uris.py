"""Pictures for the report: small, as data URIs, and flow as colour. uint8 RGB [H, W, 3]."""

import base64
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.system.errors import CaptureError

JPEG_QUALITY = 82


def picture_uri(image: UInt8[np.ndarray, "h w 3"], max_width: int) -> str:
    """A JPEG data URI of the picture, made smaller (never larger) to `max_width`."""
    ok, data = cv2.imencode(
        ".jpg", shrink(image, max_width)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not ok:
        raise ValueError(f"picture of shape {image.shape} cannot be encoded as JPEG")
    return data_uri(data.tobytes(), "image/jpeg")


def file_uri(path: Path, max_width: int) -> str:
    """The same of a file; empty where it cannot be read."""
    image = read_picture(path)
    return "" if image is None else picture_uri(image, max_width)


def shrink(image: UInt8[np.ndarray, "h w *channels"], max_width: int) -> UInt8[np.ndarray, "h2 w2 *channels"]:
    """The picture at most `max_width` wide, resized by area."""
    height, width = image.shape[:2]
    if width <= max_width:
        return np.ascontiguousarray(image)
    size = (max_width, max(1, round(height * max_width / width)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def data_uri(data: bytes, mime: str) -> str:
    """Bytes as a data URI."""
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def read_picture(path: Path) -> UInt8[np.ndarray, "h w 3"] | None:
    """A picture file as RGB, transparent parts on white; None where it cannot be read."""
    try:
        image = read_pixels(path)
    except CaptureError:
        return None
    if image.shape[2] == 4:
        alpha = image[..., 3:] / 255.0
        image = (image[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    return image


def flow_picture(
    flow: Float[np.ndarray, "h w 2"], valid: Bool[np.ndarray, "h w"], full_scale_px: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Flow as colour: hue is the direction, saturation the length up to `full_scale_px`; invalid is grey."""
    x, y = np.nan_to_num(flow[..., 0].astype(np.float32)), np.nan_to_num(flow[..., 1].astype(np.float32))
    length, angle = np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 360
    hsv = np.stack([angle, np.clip(length / full_scale_px, 0, 1), np.ones_like(length)], axis=-1)
    rgb = cv2.cvtColor(hsv.astype(np.float32), cv2.COLOR_HSV2RGB)
    picture = (rgb * 255).round().astype(np.uint8)
    picture[~valid] = 120
    return picture
