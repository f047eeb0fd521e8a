"""Pictures at the ends of a clip that show nothing."""

import numpy as np
import pytest

from devrf.capture.ingest.empty_ends import empty_ends
from devrf.capture.ingest.extract_clip import Keep, extract_clip

FULL = [40.0, 41, 40, 39, 40, 41, 40, 40, 39, 40]


@pytest.mark.parametrize(
    ("contrast", "empty"),
    [
        (FULL, (0, 0)),
        ([0.0, 0.1, *FULL], (2, 0)),
        ([*FULL, 0.3], (0, 1)),
        ([0.0, 8, 16, 24, 32, *FULL], (5, 0)),  # fades in
        ([*FULL, 30.0, 20, 10, 0], (0, 4)),  # fades out
        ([28.0, 33, 37, *FULL], (0, 0)),  # exposure that settles shows the scene
        ([0.0, *([0.5] * 20)], (0, 0)),  # a lens cap is what all of the clip shows
        ([40.0, 0, 0, *FULL], (0, 0)),  # in the middle something happened
        ([], (0, 0)),
    ],
)
def test_empty_ends(contrast, empty):
    assert empty_ends(np.array(contrast)) == empty


@pytest.mark.parametrize("colour", [(0, 0, 0), (0, 135, 0), (128, 128, 128)])
def test_they_are_neither_used_nor_measured(make_clip, tmp_path, colour):
    shown = np.random.default_rng(0).integers(0, 255, (12, 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    pictures = [np.roll(shown, n, 1) for n in range(10)]
    nothing = np.full_like(shown, colour)
    path = make_clip("a.mp4", [nothing, nothing, *pictures, nothing])
    got = extract_clip(path, tmp_path, "a", "camera", "a.mp4", Keep())
    assert [f.index for f in got.frames.frames if not f.used] == [0, 1, 12]
    assert len(got.courses.brightness) == 10 and len(got.courses.motion) == 9
    assert got.light is not None and got.light.index.tolist() == list(range(2, 12))
    assert any("2 at the start and 1 at the end" in note for note in got.frames.notes)
