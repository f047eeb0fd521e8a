"""Light fall-off from a white sheet."""

import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.vignetting import GRID, flat_field
from devrf.capture.errors import CalibrationError, CaptureError
from devrf.capture.pictures import write_picture
from devrf.capture.srgb import srgb_from_linear
from devrf.capture.video_writer import write_video
from devrf.capture.white import mean_white


def fall_off(height: int, width: int) -> np.ndarray:
    """The natural fall-off (cosine to the fourth) of a lens of 70 degrees over the diagonal, at pixel centres."""
    y, x = np.mgrid[:height, :width]
    r2 = (x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2
    return (1 + np.tan(np.radians(35)) ** 2 * r2 / (height**2 + width**2) * 4) ** -2


def sheet(height: int = 270, width: int = 480, tilt: float = 0.3, level: float = 0.5) -> np.ndarray:
    """A sheet lit from one side, seen through the lens, linear light; brighter by `tilt` stops at the right."""
    lit = np.exp2(tilt * ((np.arange(width) + 0.5) / width - 0.5))
    return (level * fall_off(height, width) * lit)[:, :, None] * np.array([1.0, 0.95, 0.9])


def stored(linear: np.ndarray, seed: int) -> np.ndarray:
    """As a camera stores it, with noise of two levels."""
    noise = 2 * np.random.default_rng(seed).standard_normal(linear.shape)
    return np.clip(255 * srgb_from_linear(linear) + noise, 0, 255).round().astype(np.uint8)


# 56 pixels a cell with noise of two levels (2.2 % of the light at this level) and 2304 cells for six unknowns:
# 2.2 % / sqrt(56 * 3 * 2304 / 6) < 0.01 %. The polynomial of three terms follows cosine to the fourth within 0.2 %;
# rounding is even noise; the compression of a clip may cost another 0.3 %.
PICTURE_ERROR, CLIP_ERROR = 0.003, 0.006


@pytest.mark.parametrize(("height", "width"), [(270, 480), (480, 360)])
def test_fall_off_is_recovered(tmp_path, height, width):
    for n in range(2):
        write_picture(tmp_path / f"{n}.png", stored(sheet(height, width), n))
    flat = flat_field(mean_white(tmp_path))
    y, x = np.mgrid[: GRID[0], : GRID[1]]
    r2 = ((x + 0.5) / GRID[1] * width - width / 2) ** 2 + ((y + 0.5) / GRID[0] * height - height / 2) ** 2
    truth = (1 + np.tan(np.radians(35)) ** 2 * r2 / (height**2 + width**2) * 4) ** -2
    assert flat.shape == GRID and flat.max() == 1 and 0 < flat.min() < 0.55
    np.testing.assert_allclose(flat, truth / truth.max(), rtol=PICTURE_ERROR)
    np.testing.assert_allclose(flat_field(mean_white(tmp_path / "0.png")), flat, rtol=PICTURE_ERROR)


def test_clip(tmp_path):
    path = tmp_path / "white.mp4"
    write_video(path, (stored(sheet(), n) for n in range(8)), 25.0)
    flat = flat_field(mean_white(path))
    write_picture(tmp_path / "white.png", stored(sheet(), 0))
    np.testing.assert_allclose(flat, flat_field(mean_white(tmp_path / "white.png")), rtol=CLIP_ERROR)


def test_dirt_counts_little(tmp_path):
    dirty = sheet()
    dirty[100:130, 200:240] *= 0.5
    write_picture(tmp_path / "white.png", stored(dirty, 0))
    write_picture(tmp_path / "clean.png", stored(sheet(), 0))
    flat, clean = (flat_field(mean_white(tmp_path / name)) for name in ("white.png", "clean.png"))
    # The spot covers 1 % of the cells; Huber's weight turns each from 1 stop into 1.345 scales, 0.02 stops.
    np.testing.assert_allclose(flat, clean, rtol=0.005)


def test_what_is_no_sheet_is_refused(tmp_path):
    room = sheet()
    room[150:, 240:] *= 0.3
    write_picture(tmp_path / "room.png", stored(room, 0))
    with refused("white-sheet-uneven", " %", kind=CalibrationError):
        flat_field(mean_white(tmp_path / "room.png"))
    write_picture(tmp_path / "bright.png", stored(np.minimum(sheet(level=2.0), 1), 0))
    with refused("white-sheet-clipped", "bright.png", " %", kind=CaptureError):
        mean_white(tmp_path / "bright.png")
    write_picture(tmp_path / "dark.png", stored(sheet(level=0.01), 0))
    with refused("white-sheet-dark", "dark.png", " %", kind=CaptureError):
        mean_white(tmp_path / "dark.png")
