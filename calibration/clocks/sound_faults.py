"""What is the matter with sound that is to be compared: beats, echoes, wind, steps; one sentence each."""

from collections.abc import Sequence

import numpy as np

from devrf.calibration.clocks.sound import BAND_HZ, Correlation, Moment
from devrf.capture.audio import Sound

ECHO_S = 5e-3  # plain correlation farther than this from the phase transform's: an echo pulls it
WIND_SHARE = 0.97  # of the energy below the band that is used: wind or handling
WIND_SECONDS = 30.0  # of the sound that are looked at
STEP_S = 8e-3  # a quarter of a frame at 30 fps: less is not worth cutting a clip
STEP_SIGMAS = 6.0
STEP_WINDOWS = 2  # on each side of a step


def beat(found: Correlation) -> str | None:
    """Peaks nearly as high as the best at even distances: which one is right cannot be told."""
    return None if found.beat_s is None else f"beat every {found.beat_s:.2f} s: ambiguous"


def echo(found: Correlation) -> str | None:
    """An echo that plain correlation would fall for; what is used does not."""
    apart_s = found.plain_delay_s - found.delay_s
    return f"echo (plain correlation {1e3 * apart_s:+.0f} ms off)" if abs(apart_s) > ECHO_S else None


def wind(sound: Sound) -> str | None:
    """Sound that is nearly all below what is used."""
    part = sound.samples[: int(WIND_SECONDS * sound.rate_hz)].astype(np.float64)
    power = np.square(np.abs(np.fft.rfft(part - part.mean())))
    low = np.fft.rfftfreq(len(part), 1 / sound.rate_hz) < BAND_HZ[0]
    share = float(power[low].sum() / max(power.sum(), 1e-30))
    if share < WIND_SHARE:
        return None
    return (
        f"wind or handling noise ({100 * share:.0f} % below {BAND_HZ[0]:.0f} Hz); only what is above is used"
    )


def step(moments: Sequence[Moment]) -> tuple[float, float] | None:
    """Where the delay between two long clips jumps, and by how much: (file time in the first, seconds).

    A camera that lost pictures or sound goes on with a delay that differs from there on; a drift does not
    jump. The best split into two lines of one slope is compared with one line.
    """
    if len(moments) < 2 * STEP_WINDOWS + 1:
        return None
    at = np.array([m.first_s for m in moments])
    delay = np.array([m.first_s - m.second_s for m in moments])
    sigma = np.array([m.std_s for m in moments])
    best = (0.0, 0.0, 0.0)
    for k in range(STEP_WINDOWS, len(moments) - STEP_WINDOWS + 1):
        after = (np.arange(len(moments)) >= k).astype(float)
        A = np.column_stack([np.ones_like(at), at - at.mean(), after]) / sigma[:, None]
        x, *_ = np.linalg.lstsq(A, delay / sigma, rcond=None)
        left = np.linalg.norm(delay / sigma - A @ x)
        straight = A[:, :2]
        y, *_ = np.linalg.lstsq(straight, delay / sigma, rcond=None)
        gain = float(np.linalg.norm(delay / sigma - straight @ y) ** 2 - left**2)
        if gain > best[0]:
            best = (gain, float((at[k - 1] + at[k]) / 2), float(x[2]))
    gain, at_s, jump_s = best
    return (at_s, jump_s) if gain > STEP_SIGMAS**2 and abs(jump_s) > STEP_S else None
