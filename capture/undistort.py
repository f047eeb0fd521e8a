"""Pictures and flow as one common pinhole camera would have seen them: square pixels, principal point at the middle.

Formats with a single focal length need it. Either the whole of every picture is kept, and what it does not
cover is transparent; or every picture is cut to what all of them cover.
"""

from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from devrf.capture.camera import Camera, distort, undistort
from devrf.capture.errors import CaptureError

BORDER_POINTS = 65  # along each side of a picture; its undistorted outline is smooth
LARGEST_STRETCH = 1.5  # of a picture's half width or height by undistorting; beyond it is cut
LARGEST_AREA = 2.0  # of the common picture, over the largest of the pictures
SAME_PX = 1e-4  # intrinsics that differ by less are the same
WHOLE_PIXEL = 0.999  # share of a bilinear look-up that must be valid


def common_pinhole(cameras: Sequence[Camera], whole: bool) -> Camera:
    """A pinhole camera (at the origin) for pictures of several cameras.

    Args:
        cameras: The cameras; equal ones may come back.
        whole: Keep the whole of every picture, instead of only what all of them cover.
    Raises:
        CaptureError: The pictures have no part in common around the principal point.
    """
    distinct = {_lens(c): c for c in cameras}.values()
    outlines = [_outline(c) for c in distinct]
    if whole:
        linear = [_linear_reach(c) for c in distinct]
        reach = np.max(
            [
                np.minimum(np.abs(o).max(axis=(0, 1)), LARGEST_STRETCH * r)
                for o, r in zip(outlines, linear, strict=True)
            ],
            axis=0,
        )
    else:
        reach = np.min([_inscribed(o) for o in outlines], axis=0)
        if any(c.model == "OPENCV_FISHEYE" for c in distinct):
            reach = np.minimum(reach, LARGEST_STRETCH * np.min([_linear_reach(c) for c in distinct], axis=0))
    if not reach.min() > 0:
        wrong = "the principal point lies outside a picture, so the pictures have no common middle"
        remedy = "export to nerfstudio or colmap, which keep each camera as it is"
        raise CaptureError("principal-point-outside", f"{wrong}; {remedy}")
    focal = max(float(c.K[i, i]) for c in distinct for i in (0, 1))
    area = max(c.width * c.height for c in distinct)
    focal *= min(1.0, float(np.sqrt(LARGEST_AREA * area / (4 * focal * focal * reach[0] * reach[1]))))
    size = 2 * focal * reach
    width, height = (np.ceil(size - SAME_PX) if whole else np.floor(size + SAME_PX)).astype(int).tolist()
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(max(width, 1), max(height, 1), K, np.eye(4)[:3])


def same_picture(camera: Camera, pinhole: Camera) -> bool:
    """Whether a camera's pictures are already those of the pinhole camera."""
    return (
        (camera.width, camera.height) == (pinhole.width, pinhole.height)
        and camera.model == pinhole.model
        and not np.any(camera.distortion)
        and bool(np.abs(camera.K - pinhole.K).max() < SAME_PX)
    )


class Undistorter:
    """From the pictures of one camera to those of a pinhole camera at the same place."""

    def __init__(self, camera: Camera, pinhole: Camera) -> None:
        self.camera, self.pinhole = camera, pinhole
        self.same = same_picture(camera, pinhole)
        rows, columns = np.mgrid[: pinhole.height, : pinhole.width]
        self._pixels = np.stack([columns, rows], axis=-1) + 0.5
        ideal = (self._pixels - pinhole.K[:2, 2]) @ np.linalg.inv(pinhole.K[:2, :2]).T
        source = distort(ideal, camera.distortion, camera.model) @ camera.K[:2, :2].T + camera.K[:2, 2]
        radius = np.linalg.norm(_outline(camera), axis=-1).max()
        seen = np.linalg.norm(ideal, axis=-1) <= 1.001 * radius  # beyond, the lens model folds back
        seen &= ((source > 0) & (source < [camera.width, camera.height])).all(axis=-1)
        self._source, self.seen = source, seen

    def picture(self, rgba: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "height width 4"]:
        """A picture resampled; colours are weighted by alpha; transparent where the camera did not look."""
        if self.same:
            return rgba
        x, y = (self._source - 0.5).astype(np.float32).transpose(2, 0, 1)
        alpha = rgba[..., 3:].astype(np.float32) / 255
        weighted = np.concatenate([rgba[..., :3] * alpha, 255 * alpha], axis=-1)
        moved = cv2.remap(weighted, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0, 255)
        share = np.where(self.seen[..., None], moved[..., 3:] / 255, 0.0)
        colours = np.where(share > 0, moved[..., :3] / np.maximum(share, 1e-6), 0.0)
        out = np.concatenate([colours, 255 * share], axis=-1)
        return out.round().clip(0, 255).astype(np.uint8)

    def flow(
        self, flow: Float32[np.ndarray, "h w 2"], valid: Bool[np.ndarray, "h w"]
    ) -> tuple[Float32[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]:
        """Flow of the camera's clip, of any size, as flow between the pinhole camera's pictures.

        A pixel p of the pinhole camera shows what the camera has at D(p); followed there by f, it ends at
        U(D(p) + f(D(p))), where U undoes D.
        """
        camera = self.camera
        ratio = np.array([flow.shape[1] / camera.width, flow.shape[0] / camera.height])
        x, y = (self._source * ratio - 0.5).astype(np.float32).transpose(2, 0, 1)
        found = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) / ratio
        share = cv2.remap(valid.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        good = (share > WHOLE_PIXEL) & self.seen
        end = self._source + found
        x, y = (end - 0.5).astype(np.float32).transpose(2, 0, 1)
        ended = cv2.remap(self._undone, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        outside = good & ~((end > 0.5) & (end < [camera.width - 0.5, camera.height - 0.5])).all(axis=-1)
        ended[outside] = self._undo(end[outside])
        return np.where(good[..., None], ended - self._pixels, 0.0).astype(np.float32), good

    @cached_property
    def _undone(self) -> Float32[np.ndarray, "height width 2"]:
        """U at every pixel of the camera: where the pinhole camera has it. Smooth, so that it may be interpolated."""
        rows, columns = np.mgrid[: self.camera.height, : self.camera.width]
        return self._undo(np.stack([columns, rows], axis=-1) + 0.5).astype(np.float32)

    def _undo(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        camera, pinhole = self.camera, self.pinhole
        x = (pixels - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
        ideal = undistort(x, camera.distortion, camera.model)
        return ideal @ pinhole.K[:2, :2].T + pinhole.K[:2, 2]


def _outline(camera: Camera) -> Float[np.ndarray, "4 side 2"]:
    """The picture's left, right, top and bottom edge in ideal coordinates."""
    share = np.linspace(0, 1, BORDER_POINTS)
    x, y = share * camera.width, share * camera.height
    left, top = np.zeros(BORDER_POINTS), np.zeros(BORDER_POINTS)
    edges = [(left, y), (left + camera.width, y), (x, top), (x, top + camera.height)]
    pixels = np.stack([np.stack(edge, axis=-1) for edge in edges])
    x = (pixels - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    return undistort(x, camera.distortion, camera.model)


def _inscribed(outline: Float[np.ndarray, "4 side 2"]) -> Float[np.ndarray, "2"]:
    """Half sides of a centred rectangle that lies inside an outline."""
    left, right, top, bottom = outline
    return np.array([min(-left[:, 0].max(), right[:, 0].min()), min(-top[:, 1].max(), bottom[:, 1].min())])


def _linear_reach(camera: Camera) -> Float[np.ndarray, "2"]:
    """Half sides of the picture in ideal coordinates, had the lens no distortion."""
    centre, size = camera.K[:2, 2], np.array([camera.width, camera.height])
    return np.maximum(centre, size - centre) / np.diag(camera.K)[:2]


def _lens(camera: Camera) -> tuple:
    K, distortion = camera.K.round(6).tobytes(), camera.distortion.round(9).tobytes()
    return (camera.width, camera.height, camera.model, K, distortion)
