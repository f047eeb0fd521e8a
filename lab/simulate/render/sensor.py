"""The simulated sensor and its files: noise, pictures of a board alone, clips.

The sensor adds noise that grows with the signal, and stores sRGB; `renderer.py` says what light reaches it.
"""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.capture.camera import Camera
from devrf.capture.video.video_writer import X264
from devrf.lab.simulate.render.mitsuba import linear_to_srgb, srgb_to_linear
from devrf.lab.simulate.render.renderer import ideal_coordinates

BOARD_SUBPIXELS = 4  # the same for pictures of the board alone, whose edges are sharper
MID_GREY = 0.18  # linear
SHOT_SHARE = 0.7  # of the noise's variance at mid grey grows with the signal
BOARD_PIXELS_PER_SQUARE = 112  # three quarters, a marker, are 84 = 7 cells of 12
BOARD_MARGIN_SQUARES = 0.4  # white rim around the squares
VIDEO_TIME_BASE = Fraction(1, 90_000)
SOUND_BLOCK = 1024  # samples in an AAC frame


def expose(
    radiance: Float[np.ndarray, "h w 3"], gain: float, noise: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """The sensor: exposure, noise, sRGB in 8 bits.

    Args:
        radiance: Linear.
        gain: Exposure, relative and linear.
        noise: Standard deviation at mid grey, of the stored value, relative to full scale.
    """
    signal = radiance * gain
    slope = 1.055 / 2.4 * MID_GREY ** (1 / 2.4 - 1)  # of sRGB at mid grey
    sigma = noise / slope
    variance = sigma**2 * (1 - SHOT_SHARE + SHOT_SHARE * signal.clip(0) / MID_GREY)
    noisy = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, dtype=np.float32)
    return (255 * linear_to_srgb(noisy)).round().astype(np.uint8)


def board_picture(squares: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """A ChArUco board (OpenCV's layout since 4.6, DICT_5X5_100) with a white rim around it."""
    board = charuco_board(squares, 1.0)
    n = BOARD_PIXELS_PER_SQUARE
    picture = board.generateImage((squares[0] * n, squares[1] * n), marginSize=0, borderBits=1)
    rim = round(BOARD_MARGIN_SQUARES * n)
    picture = cv2.copyMakeBorder(picture, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
    ink = np.where(picture > 127, 225, 22).astype(np.uint8)  # paper and toner are not ideal
    return np.repeat(ink[..., None], 3, axis=2)


def charuco_board(squares: tuple[int, int], square_m: float) -> cv2.aruco.CharucoBoard:
    """OpenCV's board: the origin at its top left corner, x right, y down."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    return cv2.aruco.CharucoBoard(squares, square_m, 0.75 * square_m, dictionary)


def board_corners(
    squares: tuple[int, int], square_m: float, world_from_board: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 3"]:
    """World corners of the board's picture, rim included: top left, top right, bottom right, bottom left."""
    rim = round(BOARD_MARGIN_SQUARES * BOARD_PIXELS_PER_SQUARE) / BOARD_PIXELS_PER_SQUARE
    x0, y0, x1, y1 = -rim, -rim, squares[0] + rim, squares[1] + rim
    corners = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0.0]]) * square_m
    return corners @ world_from_board[:3, :3].T + world_from_board[:3, 3]


class BoardCamera:
    """Pictures of a board before a camera, exact to the ray: plane meets ray, area average of samples."""

    def __init__(
        self, camera: Camera, backdrop: Float[np.ndarray, "h w 3"], squares: tuple[int, int], square_m: float
    ) -> None:
        ideal = ideal_coordinates(camera, BOARD_SUBPIXELS)
        self._rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
        self._backdrop = np.repeat(np.repeat(backdrop, BOARD_SUBPIXELS, axis=0), BOARD_SUBPIXELS, axis=1)
        self._picture = srgb_to_linear(board_picture(squares))
        self._texel_m = square_m / BOARD_PIXELS_PER_SQUARE

    def __call__(self, cam_from_board: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "h w 3"]:
        """Linear radiance [H, W, 3] with the board held at this pose."""
        R, t = cam_from_board[:, :3], cam_from_board[:, 3]
        normal = R[:, 2]
        depth = (normal @ t) / (self._rays @ normal)
        points = (self._rays * depth[..., None] - t) @ R[:, :2]
        rim = round(BOARD_MARGIN_SQUARES * BOARD_PIXELS_PER_SQUARE)
        maps = (points / self._texel_m + rim - 0.5).astype(np.float32)
        maps[(depth <= 0) | ~np.isfinite(depth)] = -1e6
        light = 0.55 + 0.4 * abs(float(normal[2]))  # a tilted board is darker
        board = light * cv2.remap(
            self._picture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        h, w = self._picture.shape[:2]
        on_board = (maps > -0.5).all(-1) & (maps[..., 0] < w - 0.5) & (maps[..., 1] < h - 0.5)
        samples = np.where(on_board[..., None], board, self._backdrop)
        n = BOARD_SUBPIXELS
        return samples.reshape(samples.shape[0] // n, n, samples.shape[1] // n, n, 3).mean(
            axis=(1, 3), dtype=np.float32
        )


def board_poses(
    rng: np.random.Generator, camera: Camera, squares: tuple[int, int], square_m: float, count: int
) -> list[Float[np.ndarray, "3 4"]]:
    """cam_from_board of a board that is moved over the whole picture and tilted every way."""
    middle = np.array([*np.array(squares) * square_m / 2, 0])
    spots = [(x, y) for y in (0.22, 0.5, 0.78) for x in (0.2, 0.5, 0.8)]
    poses = []
    for i in range(count):
        u, v = np.array(spots[i % len(spots)]) + rng.uniform(-0.06, 0.06, 2)
        # of the picture's width
        share = rng.uniform(0.45, 0.62) if i < len(spots) else rng.uniform(0.6, 0.85)
        distance = camera.K[0, 0] * squares[0] * square_m / (share * camera.width)
        about = 2 * np.pi * (i * 0.381966 + rng.uniform(0, 0.1))  # tilt axes spread by the golden ratio
        tilt = np.radians(rng.uniform(15, 40))
        tilted, _ = cv2.Rodrigues(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        rolled, _ = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(rng.uniform(-12, 12))]))
        R = tilted @ rolled
        identity = replace(camera, cam_from_world=np.eye(3, 4))
        ray = identity.directions(np.array([u * camera.width, v * camera.height]))
        centre = distance * ray / ray[2]
        poses.append(np.column_stack([R, centre - R @ middle]))
    return poses


def encode_sound(container: Any, stream: Any, samples: Int[np.ndarray, " n"]) -> None:
    """Encode 16 bit mono into a stream of an open container; the first sample is at file time 0."""
    import av

    for start in range(0, len(samples), SOUND_BLOCK):
        block = samples[start : start + SOUND_BLOCK].astype(np.int16)[None]
        frame = av.AudioFrame.from_ndarray(block, format="s16", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = stream.rate, start, Fraction(1, stream.rate)
        container.mux(stream.encode(frame))


class ClipWriter:
    """Writes one mp4: H.264 (yuv420p, BT.601) with true presentation times, and AAC sound."""

    def __init__(
        self, path: Path, size: tuple[int, int], fps: float, crf: int, sample_rate: int | None = None
    ) -> None:
        import av

        self._av = av
        self._container = av.open(str(path), "w")
        rate = Fraction(fps).limit_denominator(1001)
        self._video: Any = self._container.add_stream("libx264", rate=rate)
        self._video.width, self._video.height = size
        self._video.pix_fmt = "yuv420p"
        self._video.options = {**X264, "crf": str(crf)}
        self._video.codec_context.time_base = VIDEO_TIME_BASE
        self._video.time_base = VIDEO_TIME_BASE
        self._video.codec_context.color_range = 1  # limited
        self._video.codec_context.colorspace = 6  # SMPTE 170M, the same matrix as BT.601
        self._sound: Any = None
        if sample_rate is not None:
            self._sound = self._container.add_stream("aac", rate=sample_rate, layout="mono")
            self._sound.bit_rate = 128_000

    def picture(self, picture: UInt8[np.ndarray, "h w 3"], file_time_s: float) -> None:
        """Add a picture that is shown from `file_time_s` on."""
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU601", dst_color_range="MPEG")
        frame.pts, frame.time_base = round(file_time_s / VIDEO_TIME_BASE), VIDEO_TIME_BASE
        self._container.mux(self._video.encode(frame))

    def sound(self, samples: Int[np.ndarray, " n"]) -> None:
        """Add all sound: 16 bit mono; the first sample is at file time 0."""
        encode_sound(self._container, self._sound, samples)

    def close(self) -> None:
        """Write what is still buffered."""
        for stream in (self._video, self._sound):
            if stream is not None:
                self._container.mux(stream.encode(None))
        self._container.close()
