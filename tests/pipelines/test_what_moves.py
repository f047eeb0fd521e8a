"""What moves in stretches of a clip."""

import numpy as np

from devrf.calibration.intrinsics import guess
from devrf.pipelines.stages.scene.filmed_clips import FilmedClip

CAMERA = guess(120, 90).at(np.eye(3, 4))


def clip(std_s: float = 0.0) -> FilmedClip:
    """A bright square that goes a tenth of the picture from picture to picture, ten a second."""
    scene = np.random.default_rng(0).integers(80, 120, (90, 120)).astype(np.uint8)
    pictures = [scene.copy() for _ in range(11)]
    for n, picture in enumerate(pictures):
        picture[30:50, 10 * n : 10 * n + 20] = 230
    return FilmedClip(CAMERA, pictures, 0.1 * np.arange(11), std_s)


def columns(clip: FilmedClip, *span_s: float) -> tuple[int, int]:
    """First and last column in which something moves."""
    mask = clip.mask(*span_s)
    assert mask is not None
    moved = np.flatnonzero(mask.mask.any(0))
    return int(moved[0]), int(moved[-1])


def test_a_stretch_shows_where_things_are_meanwhile() -> None:
    first, last = columns(clip(), 0.35, 0.65)
    assert first >= 15 and last <= 95  # pictures 3 to 7, from column 30 to 90
    assert columns(clip()) == columns(clip(), -np.inf, np.inf)
    assert columns(clip())[1] - columns(clip())[0] > 90


def test_a_clock_that_is_unsure_makes_stretches_longer() -> None:
    sure, unsure = columns(clip(), 0.4, 0.6), columns(clip(0.2), 0.4, 0.6)
    assert unsure[0] < sure[0] and unsure[1] > sure[1]


def test_a_camera_that_films_at_another_time_says_nothing() -> None:
    assert clip().mask(5.0, 6.0) is None
    assert FilmedClip(CAMERA, clip().pictures[:2], np.zeros(2), 0.0).mask() is None
