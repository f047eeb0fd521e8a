"""Time in the viewer: it stands, runs, runs slower, there and back."""

import pytest

from devrf.pipelines.viewer.playback import Playback


def test_it_stands_until_it_goes_and_begins_again_at_the_end() -> None:
    clip = Playback(4.0)
    clip.jump(0.5)
    assert clip.place(100.0) == 0.5 and not clip.runs
    clip.go(100.0)
    assert clip.place(101.0) == pytest.approx(0.75)
    assert clip.place(103.0) == pytest.approx(0.25)  # around
    clip.stop(101.0)
    assert not clip.runs and clip.place(500.0) == pytest.approx(0.75)


def test_there_and_back() -> None:
    clip = Playback(2.0, ping_pong=True)
    clip.go(0.0)
    places = [clip.place(t) for t in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)]
    assert places == pytest.approx([0, 0.5, 1, 0.5, 0, 0.5])


def test_a_clip_that_stands_at_its_end_begins_anew() -> None:
    clip = Playback(2.0)
    clip.jump(1.0)
    assert clip.place(7.0) == 1.0
    clip.go(7.0)
    assert clip.place(8.0) == pytest.approx(0.5)


def test_another_speed_holds_from_now_on() -> None:
    clip = Playback(10.0)
    clip.go(0.0)
    clip.retime(2.0, 0.5, False)
    assert clip.place(2.0) == pytest.approx(0.2)
    assert clip.place(4.0) == pytest.approx(0.3)
    clip.stop(4.0)
    clip.retime(9.0, 2.0, True)
    assert not clip.runs and clip.place(20.0) == pytest.approx(0.3)
