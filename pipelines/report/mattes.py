"""The report's mattes: a few pictures of each camera, what is not the subject dimmed."""

from collections import defaultdict

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.errors import CaptureError
from devrf.capture.scene import PosedFrame, Scene, read_matte
from devrf.pipelines.report.html import figure, text
from devrf.pipelines.report.pictures import picture_uri, read_picture
from devrf.pipelines.report.run import evenly

WIDTH, PER_CAMERA, MAX_CAMERAS = 200, 3, 12
DIMMED = 0.25  # of its brightness, under a tint that no picture has all over
TINT = np.array([0, 90, 60], np.float32)


def mattes(scene: Scene | None) -> str:
    """A strip per camera that has mattes; empty without any."""
    by_camera: dict[str, list[PosedFrame]] = defaultdict(list)
    for frame in () if scene is None else scene.frames:
        if frame.matte is not None:
            by_camera[frame.camera_name].append(frame)
    reels = []
    for name, frames in list(by_camera.items())[:MAX_CAMERAS]:
        figures = []
        for frame in evenly(frames, PER_CAMERA):
            picture = _dimmed(frame)
            if picture is not None:
                caption = f"frame {frame.index}"
                figures.append(
                    figure(picture_uri(picture, WIDTH), text(caption), f"{name}, matte, {caption}")
                )
        reels.append(
            f'<div class="reel"><h3>{text(name)}</h3><div class="strip">{"".join(figures)}</div></div>'
        )
    if not reels:
        return ""
    return (
        f"<details><summary>Mattes: what is not the subject is dimmed</summary>"
        f'<div class="reels">{"".join(reels)}</div></details>'
    )


def _dimmed(frame: PosedFrame) -> UInt8[np.ndarray, "h w 3"] | None:
    """The picture, small, with its matte; None where either cannot be read."""
    picture = read_picture(frame.path)
    if picture is None or frame.matte is None:
        return None
    try:
        matte = read_matte(frame.matte, picture.shape[:2])
    except CaptureError:
        return None
    size = (WIDTH, max(1, round(picture.shape[0] * WIDTH / picture.shape[1])))
    small, opacity = (
        cv2.resize(p, size, interpolation=cv2.INTER_AREA).astype(np.float32) for p in (picture, matte)
    )
    shown = opacity[..., None] / 255
    return (shown * small + (1 - shown) * (DIMMED * small + TINT)).round().clip(0, 255).astype(np.uint8)
