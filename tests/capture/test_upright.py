"""Turns and mirrors that files ask for."""

import itertools
import struct

import numpy as np
import pytest

from devrf.capture.orientation import Upright, by_display_matrix, by_exif

PICTURE = np.arange(6, dtype=np.uint8).reshape(2, 3)
EXIF = {  # EXIF 2.3, tag 0x0112: which side of the scene row 0 and column 0 are
    1: PICTURE,
    2: PICTURE[:, ::-1],
    3: PICTURE[::-1, ::-1],
    4: PICTURE[::-1],
    5: PICTURE.T,
    6: np.rot90(PICTURE, -1),
    7: PICTURE[::-1, ::-1].T,
    8: np.rot90(PICTURE),
}


def by_matrix(picture: np.ndarray, a: int, b: int, c: int, d: int) -> np.ndarray:
    """Each pixel put where (a p + c q, b p + d q) says, counted from the middle of the picture."""
    height, width = picture.shape
    out = np.zeros((height, width) if a else (width, height), picture.dtype)
    for q, p in itertools.product(range(height), range(width)):
        x, y = 2 * p - (width - 1), 2 * q - (height - 1)
        column, row = a * x + c * y, b * x + d * y
        out[(row + out.shape[0] - 1) // 2, (column + out.shape[1] - 1) // 2] = picture[q, p]
    return out


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=2)))
@pytest.mark.parametrize("swapped", [False, True])
def test_display_matrix(signs, swapped):
    a, b, c, d = (0, signs[0], signs[1], 0) if swapped else (signs[0], 0, 0, signs[1])
    data = struct.pack("=9i", *(v << 16 for v in (a, b, 0, c, d, 0, 0, 0)), 1 << 30)
    upright = by_display_matrix(data)
    np.testing.assert_array_equal(upright.apply(PICTURE), by_matrix(PICTURE, a, b, c, d))
    assert upright.mirrored == (a * d - b * c < 0)
    assert upright.size(3, 2) == ((2, 3) if swapped else (3, 2))


@pytest.mark.parametrize("orientation", EXIF)
def test_exif_orientation(orientation):
    np.testing.assert_array_equal(by_exif(orientation).apply(PICTURE), EXIF[orientation])


def test_what_is_no_orientation_changes_nothing():
    assert by_exif(9) == Upright() and Upright().nothing and not Upright().words


@pytest.mark.parametrize("orientation", EXIF)
def test_what_lies_in_a_picture_is_turned_as_its_pixels_are(orientation: int) -> None:
    upright = by_exif(orientation)
    turned = upright.apply(PICTURE)
    assert upright.orientation == orientation
    np.testing.assert_array_equal(upright.inverse.apply(turned), PICTURE)
    for row, column in itertools.product(range(2), range(3)):
        x, y = upright.points(np.array([column + 0.5, row + 0.5]), 3, 2)
        assert turned[int(y), int(x)] == PICTURE[row, column]
    for after in map(by_exif, EXIF):
        np.testing.assert_array_equal(upright.then(after).apply(PICTURE), after.apply(turned))
