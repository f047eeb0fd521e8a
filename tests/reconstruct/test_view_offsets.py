"""The clock of a camera that nothing was trained on, by where a model shows what moves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.reconstruct.conftest import TRAVEL, Ball, ball_clips
from tests.reconstruct.test_movers import whole

from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.flow.dis import DisFlow
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.training.test_clocks import view_offset

TIMES = 9
WAY = 2 * TRAVEL  # more than a pixel from one picture to the next
GAP_S = 1 / (TIMES - 1)


@pytest.fixture(scope="module")
def clips(ball: Ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """All of the way takes a second."""
    return replace(ball_clips(ball, tmp_path_factory.mktemp("clips"), TIMES, WAY), t0_s=0.0, t1_s=1.0)


def late(scene: Scene, name: str, offset: float) -> Scene:
    """What a camera shows was taken so much later than its clock says, in all of the time."""

    def said(frame: PosedFrame) -> PosedFrame | None:
        if frame.camera_name != name or frame.time is None:
            return frame
        time = frame.time - offset
        return replace(frame, time=time, time_s=time, split="test") if 0 <= time <= 1 else None

    return replace(scene, dynamic=tuple(f for f in map(said, scene.dynamic) if f is not None))


@pytest.mark.parametrize("pictures", [-1.5, 0.6])
def test_a_late_camera_is_found(clips: Scene, rest: RestModel, pictures: float) -> None:
    scene = late(clips, "cam1", pictures * GAP_S)
    found = view_offset(scene, whole(rest, WAY), "cam1", DisFlow())
    assert found.offset_s == pytest.approx(pictures * GAP_S, abs=0.15 * GAP_S) and not found.why


def test_a_clock_that_is_right_stays(clips: Scene, rest: RestModel) -> None:
    found = view_offset(clips, whole(rest, WAY), "cam1", DisFlow())
    assert found.offset_s is None and "not clear" in found.why


def test_where_nothing_moves_or_little_is_filmed_nothing_is_said(clips: Scene, rest: RestModel) -> None:
    scene = late(clips, "cam1", 1.5 * GAP_S)
    found = view_offset(scene, whole(rest, np.zeros(3)), "cam1", DisFlow())
    assert found.offset_s is None and "on its way" in found.why
    few = replace(scene, dynamic=scene.dynamic[:2])
    found = view_offset(few, whole(rest, WAY), few.dynamic[0].camera_name, DisFlow())
    assert found.offset_s is None and "at least 4" in found.why


def test_only_pictures_in_even_places_are_asked(
    clips: Scene, rest: RestModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []

    def load(frame: PosedFrame, *at: Any) -> np.ndarray:
        read.append(frame.index)
        return load_image(frame, *at)

    monkeypatch.setattr("devrf.reconstruct.training.test_clocks.load_image", load)
    shuffled = replace(clips, dynamic=clips.dynamic[::-1])
    view_offset(shuffled, whole(rest, np.zeros(3)), "cam1", DisFlow())
    assert read == list(range(0, TIMES, 2))
