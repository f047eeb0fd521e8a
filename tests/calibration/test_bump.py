"""A fixed camera that was touched, before a moving subject."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.calibration.rigs.bump import find_bump

SIZE = (320, 240)


def clip(folder: Path, shift_px: float = 0.0, turn_deg: float = 0.0, texture: float = 60.0) -> list[Path]:
    """40 pictures of a textured wall with noise; something large walks by; from the 25th on the camera has moved."""
    rng = np.random.default_rng(0)
    coarse = rng.normal(0, 1, (60, 80)).astype(np.float32)
    wall = 120 + texture * cv2.resize(coarse, (400, 300), interpolation=cv2.INTER_CUBIC)
    files = []
    for n in range(40):
        turn = cv2.getRotationMatrix2D((200.0, 150.0), turn_deg if n >= 25 else 0.0, 1.0)
        turn[:, 2] += [-40 + (shift_px if n >= 25 else 0.0), -30]
        picture = cv2.warpAffine(wall, turn, SIZE, flags=cv2.INTER_CUBIC)
        x = 7 * n - 20
        picture[60:200, max(x, 0) : max(x + 70, 0)] = 30 + 8 * (np.arange(140) // 9 % 2)[:, None]
        picture = (1 + 0.1 * n / 40) * picture + rng.normal(0, 2, picture.shape)
        files.append(folder / f"{n:03d}.png")
        cv2.imwrite(str(files[-1]), np.clip(picture, 0, 255).astype(np.uint8))
    return files


TIMES = [n / 10 for n in range(40)]


def test_a_camera_that_stays_is_left_in_peace(tmp_path):
    """500 corners of 0.1 px give the picture's corners to about 0.02 px; the bound is 0.5."""
    found = find_bump(clip(tmp_path), TIMES)
    assert found is not None and found.moved_px < 0.1 and found.background > 100


@pytest.mark.parametrize(("shift_px", "turn_deg"), [(1.2, 0.0), (0.0, 0.3)])
def test_a_touched_camera_is_found_and_when(tmp_path, shift_px, turn_deg):
    """A turn by 0.3 degrees about the middle moves the corners, 200 px off, by 1.05 px. Every 1.6th picture is
    looked at: the step at 2.45 s is known to 0.2 s."""
    found = find_bump(clip(tmp_path, shift_px, turn_deg), TIMES)
    assert found is not None
    assert found.moved_px == pytest.approx(shift_px or 200 * np.radians(turn_deg), abs=0.15)
    assert found.at_s == pytest.approx(2.45, abs=0.2)


def test_without_background_it_does_not_guess(tmp_path):
    assert find_bump(clip(tmp_path, texture=0.0), TIMES) is None
    assert find_bump(clip(tmp_path)[:4], TIMES[:4]) is None
