"""Claps as every camera's microphone hears them, on the camera's own clock.

A clap is a broadband burst with a sharp start; the room answers with echoes that differ from place to place.
Sound travels at 343 m/s, so a camera hears a clap `distance / 343` seconds after it happened.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SAMPLE_RATE_HZ = 48_000
SPEED_OF_SOUND_M_S = 343.0
OVERSAMPLING = 8  # of the stored burst, so that it can be read at any time between samples
ATTACK_S, DECAY_S, BURST_S = 0.0004, 0.008, 0.08
LOWEST_HZ, HIGHEST_HZ = 400.0, 9000.0
NOISE, REVERB = 0.01, 0.25  # of the background and of the first echo, relative to a clap's peak
ECHOES, ECHO_DECAY_S = 40, 0.09
PEAK = 0.6  # of full scale, of a clap at gain 1


@dataclass(frozen=True)
class Microphone:
    """Where a camera listens, and its clock: true time = offset_s + (1 + 1e-6 drift_ppm) file time."""

    distance_m: float
    offset_s: float
    drift_ppm: float
    gain: float


def clap_times(rng: np.random.Generator, count: int, from_s: float, to_s: float) -> Float[np.ndarray, " n"]:
    """Irregular times [count] of claps between `from_s` and `to_s`, ascending, never close together."""
    if count == 0:
        return np.zeros(0)
    gaps = rng.uniform(1.0, 2.5, count + 1)
    gaps[0] = gaps[-1] = 0.5
    return from_s + (to_s - from_s) * np.cumsum(gaps)[:-1] / gaps.sum()


def record(
    rng: np.random.Generator,
    burst: Float[np.ndarray, " b"],
    times_s: Float[np.ndarray, " n"],
    microphone: Microphone,
    duration_s: float,
    room: tuple[float, float] = (NOISE, REVERB),
) -> Int[np.ndarray, " samples"]:
    """What a microphone records, 16 bit [samples], the first sample at file time 0.

    Args:
        rng: For the echoes and the noise of this microphone.
        burst: One clap, from `make_burst`.
        times_s: When hands clap, on cam0's clock.
        microphone: Place and clock.
        duration_s: Length on the camera's own clock.
        room: Standard deviation of the background, and loudness of the first echo, relative to a clap's peak.
    """
    (noise, reverb), count = room, round(duration_s * SAMPLE_RATE_HZ)
    rate = (1 + 1e-6 * microphone.drift_ppm) / SAMPLE_RATE_HZ
    true_times = microphone.offset_s + rate * np.arange(count)
    travel_s = microphone.distance_m / SPEED_OF_SOUND_M_S
    delays = np.sort(rng.uniform(0.004, 2.5 * ECHO_DECAY_S, ECHOES))
    loudness = (
        reverb * rng.choice([-1, 1], ECHOES) * rng.uniform(0.3, 1, ECHOES) * np.exp(-delays / ECHO_DECAY_S)
    )
    heard = np.zeros(count)
    for clap_s in times_s:
        for delay, level in zip([0.0, *delays], [1.0, *loudness], strict=True):
            _add_burst(heard, true_times, burst, float(clap_s + travel_s + delay), float(level))
    background = np.cumsum(rng.standard_normal(count + 64))  # brown noise without its slow wandering
    background = background[64:] - (background[64:] + background[:-64]) / 2
    background = 0.5 * background / background.std() + 0.5 * rng.standard_normal(count)
    signal = PEAK * microphone.gain * (heard + noise * background)
    return np.clip((32767 * signal).round(), -32768, 32767).astype(np.int16)


def make_burst(rng: np.random.Generator) -> Float[np.ndarray, " b"]:
    """One clap with peak 1, sampled at `OVERSAMPLING` times the rate: decaying noise in a clap's band."""
    count = round(BURST_S * SAMPLE_RATE_HZ * OVERSAMPLING)
    t = np.arange(count) / (SAMPLE_RATE_HZ * OVERSAMPLING)
    spectrum = np.fft.rfft(rng.standard_normal(count))
    hertz = np.fft.rfftfreq(count, t[1])
    inside = np.clip((hertz - LOWEST_HZ) / 300, 0, 1) * np.clip((HIGHEST_HZ - hertz) / 2000, 0, 1)
    tone = np.fft.irfft(spectrum * inside, count) * np.minimum(t / ATTACK_S, 1) * np.exp(-t / DECAY_S)
    return tone / np.abs(tone).max()


def _add_burst(
    heard: np.ndarray, true_times: np.ndarray, burst: np.ndarray, start_s: float, level: float
) -> None:
    first, last = np.searchsorted(true_times, [start_s, start_s + BURST_S])
    position = (true_times[first:last] - start_s) * SAMPLE_RATE_HZ * OVERSAMPLING
    heard[first:last] += level * np.interp(position, np.arange(len(burst)), burst, right=0.0)
