"""Places, clocks and sound of a simulated session."""

import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.scenes.catalogue import CENTRE, ROOM_HALF_M
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.session.camera_rig import (
    BOARD_SQUARE_M,
    BOARD_SQUARES,
    board_pose,
    fixed_cameras,
    sweep_cameras,
)
from devrf.lab.simulate.session.simulate_session import clapper_distance_m
from devrf.lab.simulate.session.sound import (
    SAMPLE_RATE_HZ,
    SPEED_OF_SOUND_M_S,
    Microphone,
    clap_times,
    make_burst,
    record,
)

OPTIONS = SessionOptions()


def test_look_at_puts_the_target_in_the_middle_and_up_upward() -> None:
    pose = look_at(np.array([1.5, -0.4, 1.3]), CENTRE)
    at = pose[:, :3] @ CENTRE + pose[:, 3]
    np.testing.assert_allclose(at[:2], 0, atol=1e-12)
    assert at[2] > 0
    above = pose[:, :3] @ (CENTRE + [0, 0, 0.1]) + pose[:, 3]
    assert above[1] < 0 and abs(above[0]) < 1e-12  # y is down in the picture


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_fixed_cameras_spread_around_the_object_at_nearly_equal_distance(seed: int) -> None:
    fixed = fixed_cameras(np.random.default_rng(seed), 4, (480, 360), OPTIONS)
    assert [c.name for c in fixed] == ["cam0", "cam1", "cam2", "cam3", "witness"]
    distances = [clapper_distance_m(c) for c in fixed]
    assert np.ptp(distances) / SPEED_OF_SOUND_M_S < 0.5e-3
    angles = [np.degrees(np.arctan2(*(c.camera.centre - CENTRE)[[1, 0]])) for c in fixed]
    assert 100 <= angles[3] - angles[0] <= 150 and angles[1] < angles[4] < angles[2]
    for c in fixed:
        assert np.abs(c.camera.centre[:2]).max() < ROOM_HALF_M - 0.15
        u, v = c.camera.project(CENTRE)
        assert 190 < u < 290 and 140 < v < 220
    assert len({c.gain for c in fixed}) == 5 and all(abs(c.gain - 1) <= 0.06 for c in fixed)
    assert len({c.camera.K[0, 0] for c in fixed}) == 5


def test_sweep_goes_all_around_at_two_heights_and_sees_the_board() -> None:
    sweep = sweep_cameras(np.random.default_rng(0), (480, 360), OPTIONS)
    assert len(sweep) == OPTIONS.sweep_frames >= 64
    centres = np.array([c.centre for c in sweep])
    angles = np.sort(np.arctan2(centres[:60, 1], centres[:60, 0]))
    assert np.degrees(np.diff(angles)).max() < 16
    assert (centres[:, 2] < 1.05).sum() >= 25 and (centres[:, 2] > 1.5).sum() >= 25
    pose = board_pose()
    half = np.array([*BOARD_SQUARES, 0]) * BOARD_SQUARE_M / 2
    middle = pose[:3, :3] @ half + pose[:3, 3]
    pixels = np.array([c.project(middle) for c in sweep])
    ways = np.array([(middle - c.centre) / np.linalg.norm(middle - c.centre) for c in sweep])
    facing = ways @ pose[:3, 2] > 0.5
    inside = (pixels > 0).all(axis=1) & (pixels < np.array([480, 360])).all(axis=1) & facing
    assert inside.sum() >= 15


def test_the_high_ring_looks_where_it_is_told() -> None:
    options = OPTIONS.model_copy(update={"sweep_aim_m": 1.3})
    usual, level = (sweep_cameras(np.random.default_rng(0), (640, 360), o) for o in (OPTIONS, options))

    def height_in_the_middle(camera: Camera) -> float:
        ahead = camera.cam_from_world[2, :3]
        return float(
            camera.centre[2] + ahead[2] * np.linalg.norm(camera.centre[:2]) / np.linalg.norm(ahead[:2])
        )

    for before, after in zip(usual, level, strict=True):
        if before.centre[2] > 1.5:
            assert height_in_the_middle(before) == pytest.approx(0.95, abs=0.1)
            assert height_in_the_middle(after) == pytest.approx(1.3, abs=0.1)
        else:
            np.testing.assert_array_equal(before.cam_from_world, after.cam_from_world)


def test_seeds_give_other_clocks_and_places() -> None:
    a, b = (fixed_cameras(np.random.default_rng(seed), 4, (64, 48), OPTIONS) for seed in (0, 1))
    for one, other in zip(a[1:], b[1:], strict=True):
        assert one.offset_s != other.offset_s and one.drift_ppm != other.drift_ppm
        assert np.linalg.norm(one.camera.centre - other.camera.centre) > 1e-3


def test_number_of_cameras_and_no_drift() -> None:
    calm = SessionOptions(offset_range_s=0, drift_range_ppm=0, gain_range=0)
    for count in (1, 3):
        fixed = fixed_cameras(np.random.default_rng(0), count, (64, 48), calm)
        assert len(fixed) == count + 1 and fixed[-1].name == "witness"
        assert all((c.offset_s, c.drift_ppm, c.gain) == (0, 0, 1) for c in fixed)
        gaps = [np.linalg.norm(c.camera.centre - fixed[-1].camera.centre) for c in fixed[:-1]]
        assert min(gaps) > 0.1  # the witness is not one of the others


def test_recorded_burst_is_the_burst_on_the_cameras_clock() -> None:
    """A slow clock and a distance shift and stretch the burst exactly as the formula says."""
    burst = make_burst(np.random.default_rng(0))
    times_s = np.array([0.5, 9.5])
    here = Microphone(0.0, 0.0, 0.0, 1.0)
    there = Microphone(3.43, -0.0123456, 200.0, 0.5)

    def hear(microphone: Microphone) -> np.ndarray:
        return record(np.random.default_rng(1), burst, times_s, microphone, 10.0, (0.0, 0.0)).astype(float)

    a, b = hear(here), hear(there)
    for time_s in times_s:
        file_s = (time_s + 0.01 + 0.0123456) / (1 + 200e-6)
        i, j = round(time_s * SAMPLE_RATE_HZ), round(file_s * SAMPLE_RATE_HZ)
        x, y = np.fft.rfft(a[i - 500 : i + 3596]), np.fft.rfft(b[j - 500 : j + 3596])
        hertz = np.fft.rfftfreq(4096, 1 / SAMPLE_RATE_HZ)
        band = (hertz > 600) & (hertz < 1800)
        phase = np.unwrap(np.angle(y * x.conj())[band])
        delay_s = -np.polyfit(2 * np.pi * hertz[band], phase, 1)[0] + (j - i) / SAMPLE_RATE_HZ
        assert delay_s == pytest.approx(file_s - time_s, abs=3e-6)
    assert np.abs(b).max() == pytest.approx(0.5 * np.abs(a).max(), rel=0.1)


def test_claps_are_irregular_and_inside() -> None:
    times_s = clap_times(np.random.default_rng(0), 5, 0.2, 2.4)
    gaps = np.diff(times_s)
    assert len(times_s) == 5 and times_s[0] > 0.2 and times_s[-1] < 2.4
    assert gaps.min() > 0.15 and np.ptp(gaps) > 0.03
    assert len(clap_times(np.random.default_rng(0), 0, 0.0, 1.0)) == 0


def test_noise_and_reverb_have_the_asked_level() -> None:
    burst = make_burst(np.random.default_rng(0))
    silence = record(
        np.random.default_rng(0), burst, np.zeros(0), Microphone(1.0, 0.0, 0.0, 1.0), 2.0, (0.02, 0.0)
    )
    assert silence.std() / 32767 / 0.6 == pytest.approx(0.02 * np.sqrt(0.5), rel=0.1)
    clap = record(
        np.random.default_rng(0), burst, np.array([0.1]), Microphone(0.0, 0.0, 0.0, 1.0), 1.0, (0.0, 0.3)
    ).astype(float)
    tail = clap[round(0.2 * SAMPLE_RATE_HZ) : round(0.3 * SAMPLE_RATE_HZ)]
    assert 0 < np.abs(tail).max() < 0.3 * np.abs(clap).max()
