"""The delay between two recordings of one sound, to a few microseconds.

Generalised cross-correlation with phase transform (Knapp & Carter, IEEE TASSP 1976): the cross-spectrum is
divided by its magnitude, so every frequency of the band votes with its phase alone and an echo cannot
smear the peak. The envelope of the correlation is searched, not the correlation itself, because
microphones that turn phases (or swap the polarity) leave the envelope's peak where it is.

A delay here is `file time in the first clip - file time in the second` of one and the same sound.
"""

from dataclasses import dataclass
from math import gcd

import numpy as np
from jaxtyping import Complex, Float
from scipy.fft import next_fast_len
from scipy.ndimage import uniform_filter1d
from scipy.signal import find_peaks, resample_poly

from devrf.capture.video.audio import Sound

BAND_HZ = (300.0, 8000.0)  # below: wind, handling, hum; above: low-rate AAC leaves nothing
BAND_EDGE = 0.2  # relative width of the band's cosine edges; hard edges ring
WORK_RATE_HZ = 24_000  # three times the band's end: a parabola through three samples is good to 2 us
COARSE_RATE_HZ = 8_000
COARSE_BAND_HZ = (300.0, 3400.0)
WHITENING_FLOOR = 1e-3  # of the mean magnitude; bins with nothing in them get no vote
GATE_S = 0.01  # loudness is averaged over this; a clap and its first echoes
GATE_FACTOR = 8.0  # times the median loudness: halfway between turned down and left alone
PEAK_WIDTH_S = 4e-3  # echoes from a floor or a table arrive this soon and do not make a delay doubtful
MIN_OVERLAP_S = 0.3  # shorter common spans hold no sound to speak of
WHOLE_S = 30.0  # clips up to this are correlated whole; longer ones drift, and are cut into windows
WINDOW_S = 10.0
SEARCH_S = 0.1  # around the coarse delay: 100 ppm over 15 minutes
COARSE_SEGMENTS = 8
COARSE_SEGMENT_S = 8.0
ACCEPT_RATIO = 2.0  # facts of simulated rooms: right delays have >= 2.3, wrong ones <= 1.4
MAX_RATIO = 100.0
STD_FLOOR_S = 1e-4  # microphone's response, block edges; what echoes leave after whitening
RIVAL = 0.6  # of the peak: a steady beat of n claps repeats at (n - 1) / n; a peak that is believed has none
LISTED_RIVALS = 6
BEAT_S = 0.15  # shorter periods are tones, in which the phase transform finds its way
EVEN_SPREAD = 0.05  # of the distance between rivals
CURVE_S = 0.5  # half width of the curve that is kept to be looked at
CURVE_POINTS = 801


@dataclass(frozen=True)
class Correlation:
    """A correlation's peak and its neighbourhood.

    Attributes:
        delay_s: File time in the first clip minus file time in the second.
        ratio: Height of the peak over the highest other one.
        plain_delay_s: The same by plain correlation, which an echo can pull away.
        rivals_s: Delays of other peaks of plain correlation nearly as high as its best, nearest first.
        lags_s, values: The curve around the peak [n], values relative to the peak.
    """

    delay_s: float
    ratio: float
    plain_delay_s: float
    rivals_s: tuple[float, ...]
    lags_s: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]

    @property
    def beat_s(self) -> float | None:
        """Period of a steady beat: rivals at even distances. Which beat is which cannot be told, and the phase
        transform of a line spectrum can be sure of a wrong one."""
        apart = np.abs(np.array(self.rivals_s) - self.plain_delay_s)
        if len(apart) < 2:
            return None
        turns = apart / apart.min()
        even = np.abs(turns - np.round(turns)).max() <= EVEN_SPREAD * turns.max()
        return float(apart.min()) if even else None


@dataclass(frozen=True)
class SharedMoment:
    """One and the same moment in two clips: file times, and the standard deviation of their difference."""

    first_s: float
    second_s: float
    std_s: float


@dataclass(frozen=True)
class SoundDelay:
    """How two clips lie to each other by their sound: the peak that decides, and moments they share."""

    correlation: Correlation
    moments: tuple[SharedMoment, ...]

    @property
    def accepted(self) -> bool:
        """Whether the peak stands out enough to be believed, and is not one of many of a beat."""
        return (
            self.correlation.ratio >= ACCEPT_RATIO and bool(self.moments) and self.correlation.beat_s is None
        )


def sound_delay(
    first: Sound, second: Sound, around_s: float | None = None, search_s: float = np.inf
) -> SoundDelay | None:
    """Delay between two recordings; None where they are too short to be compared.

    Clips of up to half a minute give one moment. Longer ones are located by their loudest passages and
    then compared window by window, so that the drift of their clocks shows.

    Args:
        first, second: The recordings.
        around_s, search_s: Only delays within `search_s` of `around_s` are looked at; None: all.
    """
    shorter = min(first.end_s - first.start_s, second.end_s - second.start_s)
    if shorter < 2 * MIN_OVERLAP_S:
        return None
    longer = max(first.end_s - first.start_s, second.end_s - second.start_s)
    a, b = _at_rate(first, WORK_RATE_HZ), _at_rate(second, WORK_RATE_HZ)
    if longer <= WHOLE_S:
        if around_s is not None and not _overlap_there(a, b, around_s):
            return None
        whole = gcc_phat(a, b, around_s=around_s, search_s=search_s)
        return SoundDelay(whole, (_moment(a, b, whole),))
    coarse = _coarse(_at_rate(first, COARSE_RATE_HZ), _at_rate(second, COARSE_RATE_HZ), around_s, search_s)
    if coarse is None:
        return None
    moments = []
    for from_s, to_s in _shared_windows(a, b, coarse.delay_s):
        x, y = _cut(a, from_s, to_s), _cut(b, from_s - coarse.delay_s, to_s - coarse.delay_s)
        fine = gcc_phat(x, y, around_s=coarse.delay_s, search_s=SEARCH_S)
        if fine.ratio >= ACCEPT_RATIO:
            moments.append(_moment(x, y, fine))
    return SoundDelay(coarse, tuple(moments))


def gcc_phat(
    first: Sound,
    second: Sound,
    band_hz: tuple[float, float] = BAND_HZ,
    around_s: float | None = None,
    search_s: float = np.inf,
) -> Correlation:
    """Generalised cross-correlation with phase transform (Knapp & Carter 1976).

    Args:
        first, second: Recordings with the same sample rate.
        band_hz: Frequencies that vote.
        around_s, search_s: Only delays within `search_s` of `around_s` are looked at; None: all.
    Returns:
        Delay with a sub-sample peak, and how far it stands out.
    Raises:
        ValueError: If the sample rates differ or no delay leaves enough overlap.
    """
    if first.rate_hz != second.rate_hz:
        raise ValueError(f"sample rates differ: {first.rate_hz} and {second.rate_hz} Hz; resample first")
    rate = first.rate_hz
    na, nb = len(first.samples), len(second.samples)
    n = fast_size(na + nb)
    a, b = _gated(first.samples, rate), _gated(second.samples, rate)
    spectrum = np.fft.rfft(a, n) * np.conj(np.fft.rfft(b, n))
    band = _band(n, rate, band_hz)
    lags = np.arange(-(nb - 1), na)  # samples; lag k: first[i + k] meets second[i]
    values = _by_lag(_envelope(_whiten(spectrum, band), n), na, nb)
    plain = _by_lag(_envelope(band * spectrum, n), na, nb)
    overlap = np.minimum(na, nb + lags) - np.maximum(0, lags)
    allowed = overlap >= MIN_OVERLAP_S * rate
    shift_s = first.start_s - second.start_s
    if around_s is not None:
        allowed &= np.abs(lags / rate + shift_s - around_s) <= search_s
    if not allowed.any():
        text = f"no delay leaves {MIN_OVERLAP_S} s of overlap between clips of {na} and {nb} samples"
        raise ValueError(text)
    peak = int(np.argmax(np.where(allowed, values, -np.inf)))
    near = np.abs(lags - lags[peak]) <= PEAK_WIDTH_S * rate
    others = values[allowed & ~near]
    second_peak = float(others.max()) if len(others) else 0.0
    height = float(values[peak])
    ratio = min(MAX_RATIO, height / second_peak) if second_peak > 0 else (MAX_RATIO if height > 0 else 0.0)
    plain = np.where(allowed, plain, 0.0)
    delay_s = float((lags[peak] + top_of_parabola(values, peak)) / rate + shift_s)
    lags_s = lags / rate + shift_s
    return Correlation(
        delay_s,
        ratio,
        float(lags_s[np.argmax(plain)]),
        _rivals(lags_s, plain),
        *_curve(lags_s, values, delay_s),
    )


def _by_lag(circular: Float[np.ndarray, " n"], na: int, nb: int) -> Float[np.ndarray, " lags"]:
    """A circular correlation in the order of its lags, from -(nb - 1) to na - 1."""
    return np.concatenate([circular[len(circular) - nb + 1 :], circular[:na]])


def _rivals(lags_s: Float[np.ndarray, " n"], plain: Float[np.ndarray, " n"]) -> tuple[float, ...]:
    """Other high peaks of plain correlation, one within `BEAT_S`, the nearest to the highest first.

    The phase transform is no help here: between the lines of a beat's spectrum it listens to noise.
    """
    apart = max(1, int(BEAT_S / (lags_s[1] - lags_s[0])))
    top = int(np.argmax(plain))
    least = RIVAL * float(plain[top]) + np.finfo(np.float32).tiny
    places = [int(i) for i in find_peaks(plain, height=least, distance=apart)[0] if abs(i - top) >= apart]
    nearest = sorted(places, key=lambda i: abs(i - top))[:LISTED_RIVALS]
    return tuple(float(lags_s[i]) for i in nearest)


def fast_size(n: int) -> int:
    """Smallest length from `n` on whose Fourier transform is fast."""
    return int(next_fast_len(n, real=True))  # pyright: ignore[reportArgumentType]


def _at_rate(sound: Sound, rate_hz: int) -> Sound:
    if sound.rate_hz == rate_hz:
        return sound
    factor = gcd(sound.rate_hz, rate_hz)
    samples = resample_poly(sound.samples, rate_hz // factor, sound.rate_hz // factor)
    return Sound(samples.astype(np.float32), rate_hz, sound.start_s)


def _gated(samples: Float[np.ndarray, " n"], rate_hz: int) -> Float[np.ndarray, " n"]:
    """Turn down what is not louder than usual, so that the pauses' noise does not vote with the claps.

    Steady sound is as loud as usual everywhere and keeps its relative levels.
    """
    difference = np.diff(samples, prepend=samples[:1])  # without hum and wind
    loudness = uniform_filter1d(np.square(difference), max(1, int(GATE_S * rate_hz)), mode="nearest")
    usual = float(np.median(loudness)) + np.finfo(np.float32).tiny
    return samples * (loudness / (loudness + GATE_FACTOR * usual))


def _band(n: int, rate_hz: int, band_hz: tuple[float, float]) -> Float[np.ndarray, " bins"]:
    """Weight of each frequency [n // 2 + 1]: 1 in the band, cosine edges outside of it."""
    f = np.fft.rfftfreq(n, 1 / rate_hz)
    low, high = band_hz
    rise = np.clip((f / low - (1 - BAND_EDGE)) / BAND_EDGE, 0, 1)
    fall = np.clip(((1 + BAND_EDGE) - f / high) / BAND_EDGE, 0, 1)
    return 0.25 * (1 - np.cos(np.pi * rise)) * (1 - np.cos(np.pi * fall))


def _whiten(
    spectrum: Complex[np.ndarray, " bins"], weight: Float[np.ndarray, " bins"]
) -> Complex[np.ndarray, " bins"]:
    magnitude = np.abs(spectrum)
    floor = WHITENING_FLOOR * float((weight * magnitude).sum() / weight.sum())
    return weight * spectrum / (magnitude + floor + np.finfo(np.float32).tiny)


def _envelope(spectrum: Complex[np.ndarray, " bins"], n: int) -> Float[np.ndarray, " n"]:
    """Magnitude of the analytic signal of a correlation given by its one-sided spectrum."""
    full = np.zeros(n, spectrum.dtype)
    full[: len(spectrum)] = spectrum
    return np.abs(np.fft.ifft(full))


def top_of_parabola(values: Float[np.ndarray, " n"], peak: int, reach: int = 1, most: float = 0.5) -> float:
    """Top of the parabola through a peak and the points `reach` to either side, in samples from the peak.

    It is at most `most` times the reach away; 0 where a point is missing, or the peak is none.
    """
    if not reach <= peak < len(values) - reach:
        return 0.0
    left, mid, right = (float(values[peak + k]) for k in (-reach, 0, reach))
    bend = left - 2 * mid + right
    return float(np.clip(0.5 * (left - right) / bend, -most, most)) * reach if bend < 0 else 0.0


def _curve(
    lags_s: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], centre_s: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The curve around its peak, thinned by maxima so that no spike is lost; values relative to the peak."""
    grid = np.linspace(centre_s - CURVE_S, centre_s + CURVE_S, CURVE_POINTS + 1)
    edges = np.searchsorted(lags_s, grid)
    kept = [(i, j) for i, j in zip(edges[:-1], edges[1:], strict=True) if j > i]
    top = max(float(values.max(initial=0.0)), np.finfo(np.float32).tiny)
    thin = np.array([values[i:j].max() for i, j in kept]) / top
    return np.array([lags_s[i:j].mean() for i, j in kept]), thin


def _overlap_there(a: Sound, b: Sound, delay_s: float) -> bool:
    """Whether both record long enough at the same time if this is their delay."""
    return min(a.end_s, b.end_s + delay_s) - max(a.start_s, b.start_s + delay_s) > MIN_OVERLAP_S


def _coarse(first: Sound, second: Sound, around_s: float | None, search_s: float) -> Correlation | None:
    """Delay of long clips to a few milliseconds: the second's loudest passages are sought in the first."""
    n = int(COARSE_SEGMENT_S * second.rate_hz)
    starts = np.arange(0, max(1, len(second.samples) - n + 1), n)
    loudness = [np.ptp(_tenths(second.samples[s : s + n])) for s in starts]
    chosen = np.argsort(loudness)[::-1][:COARSE_SEGMENTS]
    found = []
    for k in chosen:
        start_s = second.start_s + int(starts[k]) / second.rate_hz
        segment = Sound(second.samples[starts[k] : starts[k] + n], second.rate_hz, start_s)
        if around_s is None or _overlap_there(first, segment, around_s):
            found.append(gcc_phat(first, segment, COARSE_BAND_HZ, around_s, search_s))
    return max(found, key=lambda c: c.ratio, default=None)


def _tenths(samples: Float[np.ndarray, " n"]) -> Float[np.ndarray, " blocks"]:
    """Root mean square in blocks of a tenth of the length: their spread tells a passage with events."""
    blocks = np.array_split(samples.astype(np.float64), 10)
    return np.array([np.sqrt(np.mean(b * b)) if len(b) else 0.0 for b in blocks])


def _shared_windows(first: Sound, second: Sound, delay_s: float) -> list[tuple[float, float]]:
    """Spans of the first clip's file time, `WINDOW_S` long, in which both clips record."""
    from_s = max(first.start_s, second.start_s + delay_s)
    to_s = min(first.end_s, second.end_s + delay_s)
    count = max(1, int((to_s - from_s) / WINDOW_S))
    edges = np.linspace(from_s, to_s, count + 1)
    return [(float(i), float(j)) for i, j in zip(edges[:-1], edges[1:], strict=True)]


def _cut(sound: Sound, from_s: float, to_s: float) -> Sound:
    i = int(np.clip(round((from_s - sound.start_s) * sound.rate_hz), 0, len(sound.samples)))
    j = int(np.clip(round((to_s - sound.start_s) * sound.rate_hz), i, len(sound.samples)))
    return Sound(sound.samples[i:j], sound.rate_hz, sound.start_s + i / sound.rate_hz)


def _moment(first: Sound, second: Sound, found: Correlation) -> SharedMoment:
    """The common moment a delay stands for: where the sound both share has its energy."""
    from_s = max(first.start_s, second.start_s + found.delay_s)
    to_s = min(first.end_s, second.end_s + found.delay_s)
    part = _cut(first, from_s, to_s).samples.astype(np.float64)
    energy = np.square(np.diff(part, prepend=part[:1]))  # the difference stands for the band: no hum
    at_s = from_s + float((energy * np.arange(len(part))).sum() / max(energy.sum(), 1e-30)) / first.rate_hz
    spread_s = 1 / (2 * np.pi * np.mean(BAND_HZ) * max(found.ratio, 1.0))
    return SharedMoment(at_s, at_s - found.delay_s, float(np.hypot(STD_FLOOR_S, spread_s)))
