"""Tests check types and shapes of what they call (tests/type_checks.py): wrong ones are found."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from devrf.capture.colour.light_course import clipped_share
from devrf.capture.scene import SparsePoints
from devrf.capture.view_axes import look_at


def test_types_are_checked() -> None:
    with pytest.raises(TypeCheckError):
        look_at(np.zeros(3), np.ones(3), roll_deg="none")  # pyright: ignore[reportArgumentType]


def test_shapes_are_checked() -> None:
    with pytest.raises(TypeCheckError):
        look_at(np.zeros(3), np.ones(4))
    with pytest.raises(TypeCheckError):
        clipped_share(np.zeros((4, 4), np.uint8))


def test_an_axis_has_one_length_in_a_call() -> None:
    SparsePoints(np.zeros((2, 3)), np.zeros(5, int), np.zeros(5, int))
    with pytest.raises(TypeCheckError):
        SparsePoints(np.zeros((2, 3)), np.zeros(5, int), np.zeros(4, int))
