"""When fixed cameras show the scene as the sweep does: by points among what moves, else by what stands still."""

import numpy as np
import pytest
from tests.calibration import coloured_room as room

from devrf.calibration.colour.sweep_points import SweepPoints
from devrf.calibration.extent.rest_moment import (
    FEWEST,
    MOMENTS,
    RestSeen,
    middle_of,
    moments_of,
    rest_moment,
    rest_seen,
    rest_votes,
)
from devrf.calibration.rigs.clean_picture import REST_FRAMES, rest_frames

TIMES = np.linspace(0, 1, MOMENTS)
ALWAYS = (0.0, 1.0)  # all cameras film
COLUMNS = slice(140, 340)  # of the picture, in which something moves


@pytest.fixture(scope="module")
def swept():
    """A sweep of the room, its pictures by name, and what a fixed camera shows at rest."""
    model = room.sweep()
    pictures = {
        name: room.show(camera, seed=n).rgb
        for n, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True))
    }
    return model, pictures, room.show(room.camera(0.7, -1.2), seed=99)


def seen_at(
    swept, moved_px: list[int | None], still: tuple[bool, bool] = (False, False), gain: float = 1.0
) -> RestSeen:
    """What a camera tells in whose pictures the middle has moved by so many pixels; None: no picture.

    Its linear light is `gain` times the room's.
    """
    model, pictures, view = swept
    if gain != 1:
        view = room.show(view.camera, gain * room.EQUAL, seed=99)
    moves = np.zeros(view.rgb.shape[:2], bool)
    moves[:, COLUMNS] = True

    def picture(shift: int | None) -> np.ndarray | None:
        if shift is None:
            return None
        moved = view.rgb.copy()
        moved[:, COLUMNS] = np.roll(view.rgb, shift, axis=0)[:, COLUMNS]
        return moved

    found = [picture(shift) for shift in moved_px]
    sweep = SweepPoints(model, 1.0, pictures.__getitem__)
    return rest_seen(view.camera, found, moves[::2, ::2], still, sweep)


@pytest.mark.parametrize(
    ("moved_px", "moment", "time"),
    [
        ([0, 20, 40, 50, 60, 70, 80], "start", 0.0),
        ([80, 70, 60, 50, 40, 20, 0], "end", 1.0),
        ([60, 40, 0, 40, 60, 80, 90], "middle", 2 / 6),
        ([0, 30, 60, 90, 60, 30, 0], "start", 0.0),
        ([9, 20, 40, 50, 60, 70, 80], "none", None),
        ([None, 20, 40, 50, 60, 70, 0], "end", 1.0),  # it began to film later
    ],
)
def test_points_tell_when_the_scene_is_at_rest(swept, moved_px, moment, time) -> None:
    seen = seen_at(swept, moved_px)
    assert seen.told_by_points and len(seen.seen) == MOMENTS
    found, at = rest_moment(TIMES, rest_votes([seen]), ALWAYS)
    assert found == moment and at == (None if time is None else pytest.approx(time))


def test_a_darker_camera_sees_the_start_too(swept) -> None:
    seen = seen_at(swept, [0, 20, 40, 50, 60, 70, 80], gain=0.6)
    assert seen.told_by_points
    assert rest_moment(TIMES, rest_votes([seen]), ALWAYS) == ("start", 0.0)


def test_what_stands_still_need_not_be_the_rest(swept) -> None:
    """Someone has put the thing elsewhere before the clip: nothing moves at its start, but it is not the rest."""
    seen = seen_at(swept, [40, 40, 40, 30, 20, 10, 10], still=(True, True))
    assert rest_moment(TIMES, rest_votes([seen]), ALWAYS) == ("none", None)


def test_without_points_what_stands_still_decides() -> None:
    plain = [
        RestSeen(FEWEST - 1.0, (0,) * MOMENTS, still)
        for still in ((False, True), (False, True), (True, True))
    ]
    assert not any(camera.told_by_points for camera in plain)
    assert rest_moment(TIMES, rest_votes(plain), ALWAYS) == ("end", 1.0)
    assert rest_moment(TIMES, rest_votes([RestSeen(0.0, (0,) * MOMENTS, (False, False))]), ALWAYS) == (
        "none",
        None,
    )


def test_what_stands_still_when_a_late_camera_begins_counts_there() -> None:
    late = RestSeen(0.0, (None, 0, 0, 0, 0, 0, 0), (True, False))
    np.testing.assert_array_equal(late.moments, [np.nan, 1, 0, 0, 0, 0, 0])


def test_a_camera_that_films_at_none_of_the_moments_tells_nothing(swept) -> None:
    seen = seen_at(swept, [None] * MOMENTS)
    assert seen.expected == 0 and np.isnan(seen.moments).all()


def test_cameras_told_by_points_count_before_others() -> None:
    told = RestSeen(100.0, (3, 2, 2, 2, 2, 2, 95), (False, False))
    plain = [RestSeen(0.0, (0,) * MOMENTS, (True, False))] * 3
    assert rest_moment(TIMES, rest_votes([told, *plain]), ALWAYS) == ("end", 1.0)


def test_a_middle_is_never_the_start_or_the_end() -> None:
    votes = np.array([1.0, 0, 0.25, 0.5, 0, 0, 1])
    assert middle_of(TIMES, votes) == pytest.approx(3 / 6)
    assert 0 < middle_of(TIMES, np.zeros(MOMENTS)) < 1
    assert middle_of(TIMES[:2], np.ones(2)) == 0.5  # nobody films between


@pytest.mark.parametrize(
    ("shared", "until", "moment", "time"),
    [
        ((0.05, 1.0), 0.3, "start", 0.05),  # the last camera begins to film while the scene is still at rest
        ((0.25, 1.0), 0.2, "start", 1 / 6),  # it begins later: as many cameras as possible
        ((0.05, 1.0), 0.01, "start", 0.0),
        ((0.0, 0.9), -0.3, "end", 0.9),
        ((0.8, 0.2), 0.3, "start", 0.2),  # never do all of them film
    ],
)
def test_of_a_rest_that_lasts_the_moment_that_all_cameras_film(shared, until, moment, time) -> None:
    times = moments_of(shared)
    votes = ((times <= until) if until > 0 else (times >= 1 + until)).astype(float)
    assert rest_moment(times, votes, shared) == (moment, pytest.approx(time))


def test_pictures_of_the_rest() -> None:
    assert [list(rest_frames(moment, 9)) for moment in ("start", "middle", "end")] == [
        [0, 1, 2], [3, 4, 5], [6, 7, 8],
    ]  # fmt: skip
    assert list(rest_frames("end", 1)) == [0] and len(rest_frames("start", 100)) == REST_FRAMES
