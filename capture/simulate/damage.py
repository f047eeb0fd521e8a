"""What goes wrong in the field, done to good material on purpose: blurred or fewer pictures, wrong cameras, small box.

Nothing here is random but `turned`, which takes its generator from the caller.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.simulate.sensor import ClipWriter
from devrf.capture.srgb import linear_from_srgb, srgb_from_linear
from devrf.capture.video import VideoReader

Picture = UInt8[np.ndarray, "height width 3"]
CRF = 17  # of a clip that is written again: as the simulator writes them
FPS = 30.0  # said by the new file where the old one says nothing; its pictures' times are exact all the same


def blurred(picture: Picture, share: float) -> Picture:
    """As a camera sees that moves sideways by a share of the picture's width during the exposure (in linear light)."""
    across = share * picture.shape[1]
    whole = 2 * int(np.ceil((across - 1) / 2)) + 1  # an odd number of pixels, the outermost counting in part
    weights = np.ones(whole)
    if whole > 1:
        weights[[0, -1]] = (across - (whole - 2)) / 2
    light = linear_from_srgb(picture / 255.0)
    light = cv2.filter2D(light, -1, weights[None] / weights.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.rint(255 * srgb_from_linear(light)).astype(np.uint8)


def write_again(
    source: Path, target: Path, every: int = 1, change: Callable[[Picture], Picture] = lambda picture: picture
) -> None:
    """A clip with every n-th of its pictures, each changed, at its own time; without sound."""
    with VideoReader(source) as reader:
        size = (reader.info.width, reader.info.height)
        clip = ClipWriter(target, size, reader.info.fps or FPS, CRF)
        for n, frame in enumerate(reader):
            if n % every == 0:
                clip.picture(change(frame.rgb), frame.time_s)
        clip.close()


def turned(camera: Camera, angle_deg: float, rng: np.random.Generator) -> Camera:
    """A camera turned about its own centre, around a random axis."""
    axis = rng.normal(size=3)
    turn, _ = cv2.Rodrigues(np.radians(angle_deg) * axis / np.linalg.norm(axis))
    return replace(camera, cam_from_world=turn @ camera.cam_from_world)


def zoomed(camera: Camera, factor: float) -> Camera:
    """A camera whose focal lengths are multiplied by a factor."""
    K = camera.K.copy()
    K[0, 0] *= factor
    K[1, 1] *= factor
    return replace(camera, K=K)


def with_smaller_box(scene: Scene, share: float) -> Scene:
    """The scene in a box with the same middle, its sides this share of what they were."""
    grown = np.diag([1 / share, 1 / share, 1 / share, 1.0])
    return replace(
        scene,
        box_from_world=grown @ scene.box_from_world,
        near=scene.near / share,
        far=scene.far / share,
    )
