"""What goes wrong in the field, done to good material on purpose: spoilt pictures and mattes, wrong cameras, small box.

What is random takes its generator from the caller.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.camera import Camera
from devrf.capture.colour.srgb import linear_from_srgb, srgb_from_linear
from devrf.capture.scene import Scene
from devrf.capture.video.audio import INT16_MAX, read_sound
from devrf.capture.video.reader import VideoReader
from devrf.lab.simulate.render.sensor import ClipWriter

Picture = UInt8[np.ndarray, "height width 3"]
CRF = 17  # of a clip that is written again: as the simulator writes them
HOLE = 0.06  # radius of a matte's hole, of the side of a square as large as the subject
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


def relit(picture: Picture, stops: Float[np.ndarray, "3"]) -> Picture:
    """As an exposure longer by so many stops shows red, green and blue."""
    light = linear_from_srgb(picture / 255.0) * 2.0**stops
    return np.rint(255 * srgb_from_linear(light.clip(0, 1))).astype(np.uint8)


def pierced(
    alpha: UInt8[np.ndarray, "height width"], share: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width"]:
    """A matte with round holes at random places of its subject, until they cover this share of it."""
    holes = np.zeros_like(alpha)
    subject = alpha > 127
    rows, columns = np.nonzero(subject)
    radius = max(1, round(HOLE * float(np.sqrt(len(rows)))))
    while (holes[subject] > 0).mean() < share if len(rows) else False:
        n = rng.integers(len(rows))
        cv2.circle(holes, (int(columns[n]), int(rows[n])), radius, 255, -1)
    return np.where(holes > 0, np.uint8(0), alpha)


def write_again(
    source: Path,
    target: Path,
    stays: Callable[[int, int], bool] = lambda number, count: True,
    change: Callable[[Picture, float], Picture] = lambda picture, when: picture,
) -> None:
    """A clip with some of its pictures, each changed, at its own time; its sound as it was.

    Args:
        source, target: Files.
        stays: Whether a picture stays, given its number and how many there are.
        change: Given a picture and where in the clip it is, from 0 (first) to 1 (last).
    """
    with VideoReader(source) as reader:
        count = sum(1 for _ in reader)
    sound = read_sound(source)
    with VideoReader(source) as reader:
        size, rate = (reader.info.width, reader.info.height), sound.rate_hz if sound else None
        clip = ClipWriter(target, size, reader.info.fps or FPS, CRF, rate)
        if sound is not None:
            quiet = np.zeros(max(round(sound.start_s * sound.rate_hz), 0))
            clip.sound(np.rint(INT16_MAX * np.concatenate([quiet, sound.samples])).astype(np.int64))
        for n, frame in enumerate(reader):
            if stays(n, count):
                clip.picture(change(frame.rgb, n / max(count - 1, 1)), frame.time_s)
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
        scene, box_from_world=grown @ scene.box_from_world, near=scene.near / share, far=scene.far / share
    )
