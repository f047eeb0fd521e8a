"""Steady light: gains that bring every frame of a fixed camera's clip to the clip's usual light; light that flickers.

Lamps on mains of 50 or 60 Hz flicker 100 or 120 times a second. A camera of f frames a second sees that at the alias
|100 - k f| Hz; a rolling shutter shows it as bands that wander, because rows are exposed one after the other. A gain
for a whole frame removes what all rows share, so bands stay: only another shutter time removes those.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from devrf.capture.colour.light_course import LightCourse

EXPOSURE_STOPS = 0.043  # 3 % of the light: below it no one sees a step, and surfaces of a scene differ more
COLOUR_STOPS = 0.029  # 2 % between two channels
FLICKER_DEPTH = 0.01  # brightest against darkest, share of the light
NOISE_TIMES = 5.0  # a change is believed from this many times the noise of one frame
LAMPS_HZ = (100.0, 120.0)
MAINS_TOLERANCE = 0.002  # mains and camera clocks are this far off at most, share: 0.2 Hz of 100
FEWEST_WAVES = 3.0  # in the clip; less cannot be told from a drift
FEWEST_FRAMES = 12  # a sinusoid with its offset and drift has five unknowns
# Of the variance of the course (after its drift) by the sinusoid: cameras hunting do not repeat.
EXPLAINED = 0.5
FEWEST_KNOWN = 0.5  # of the frames: else the subject fills the picture and nothing can be told
SMOOTH_FRAMES = 9  # a change lasts longer; a flash or a passer-by does not
SETTLED = 0.1  # a change goes on while it is between this share and one minus this share of its step


@dataclass(frozen=True)
class Flicker:
    """Light that repeats at the alias of a lamp.

    Attributes:
        seen_hz: How often a second it is seen to repeat.
        depth: Brightest against darkest on one row, share of the light.
    """

    seen_hz: float
    depth: float


@dataclass(frozen=True)
class Change:
    """Light that changes from one time to another.

    Attributes:
        stops: By how much, log2; of R/G or B/G where colours change.
        from_s, to_s: When it happens, seconds.
    """

    stops: float
    from_s: float
    to_s: float


@dataclass(frozen=True)
class LightFound:
    """What changes in the light of a clip.

    Attributes:
        flicker: A lamp, or None.
        exposure: The largest change of exposure, or None where it is below `EXPOSURE_STOPS` or within the noise.
        colour: The largest change of R/G or B/G, or None where both are below `COLOUR_STOPS` or within the noise.
        left: The largest change that gains do not make up for, log2: the median over what stands still, which a
            curve that is not sRGB, a lamp that moves or clipping on the way makes differ from place to place.
    """

    flicker: Flicker | None
    exposure: Change | None
    colour: Change | None
    left: float = 0.0

    @property
    def steady(self) -> bool:
        """Whether nothing is to be corrected."""
        return self.flicker is None and self.exposure is None and self.colour is None


def judge_light(course: LightCourse) -> LightFound:
    """What changes in the light of a clip; nothing where it is known in too few frames."""
    known = np.isfinite(course.stops.sum(axis=-1))
    share = float(known.mean()) if len(course.index) else 0.0
    if known.sum() < FEWEST_FRAMES or share < FEWEST_KNOWN:
        return LightFound(None, None, None)
    time_s = course.time_s[known]
    stops, bands = course.stops[known], course.bands[known]
    found = _find_flicker(time_s, bands)
    flicker = None
    if found is not None:
        flicker, waves = found
        stops = stops - waves @ np.linalg.lstsq(waves, stops - stops.mean(axis=0), rcond=None)[0]
    colours = [_change(time_s, stops[:, c] - stops[:, 1], COLOUR_STOPS) for c in (0, 2)]
    return LightFound(
        flicker,
        _change(time_s, stops.mean(axis=-1), EXPOSURE_STOPS),
        max((c for c in colours if c is not None), key=lambda change: abs(change.stops), default=None),
        float(median_filter(course.left[known], SMOOTH_FRAMES, mode="nearest").max()),
    )


def steady_gains(course: LightCourse) -> Float[np.ndarray, "n 3"] | None:
    """Gains in linear light that bring each frame to the clip's median light.

    Args:
        course: Of one clip.
    Returns:
        For the frames of `course.index`: gains of R, G, B [n, 3]; None where the light is steady or not known. The
        three are equal unless colours change. Frames in which the light is not known lie between their neighbours.
    """
    judged = judge_light(course)
    if judged.steady:
        return None
    known = np.isfinite(course.stops.sum(axis=-1))
    stops = course.stops[known]
    if judged.colour is None:
        stops = stops.mean(axis=-1, keepdims=True).repeat(3, axis=-1)
    filled = np.stack([np.interp(course.time_s, course.time_s[known], s) for s in stops.T], axis=-1)
    return np.exp2(np.median(filled, axis=0) - filled)


def _find_flicker(
    time_s: Float[np.ndarray, " n"], bands: Float[np.ndarray, "n bands"]
) -> tuple[Flicker, Float[np.ndarray, "n 2"]] | None:
    """The lamp whose alias explains the course of most bands best, with its two waves (cosine, sine)."""
    bands = bands[:, np.isfinite(bands).all(axis=0)]
    span_s = time_s[-1] - time_s[0]
    if not bands.shape[1] or not span_s > 0:
        return None
    fps = 1 / float(np.median(np.diff(time_s)))
    t = (time_s - time_s[0]) / span_s
    drift = np.stack([np.ones_like(t), t, t**2], axis=-1)
    rest = bands - drift @ np.linalg.lstsq(drift, bands, rcond=None)[0]
    spread = np.maximum((rest**2).sum(axis=0), 1e-12)

    def explained(seen_hz: float) -> float:
        """Share of the variance of the middle band (a periodogram, Schuster 1898)."""
        sums = np.exp(-2j * np.pi * seen_hz * (time_s - time_s[0])) @ rest
        return float(np.median(2 * np.abs(sums) ** 2 / (len(time_s) * spread)))

    trials: list[float] = []
    line_hz = 1 / span_s  # the width of a spectral line
    for lamp_hz in LAMPS_HZ:
        alias_hz = abs(lamp_hz - fps * round(lamp_hz / fps))
        reach_hz = MAINS_TOLERANCE * lamp_hz
        lowest_hz = max(alias_hz - reach_hz, FEWEST_WAVES * line_hz)
        if 4 * (alias_hz + reach_hz - lowest_hz) / line_hz > len(time_s):
            return None  # more lines than pictures: the clip is all gaps
        trials += np.arange(lowest_hz, alias_hz + reach_hz, line_hz / 4).tolist()
    if not trials:
        return None
    coarse_hz = max(trials, key=explained)
    # leaves less than 4 % of the wave at the clip's ends
    fine = coarse_hz + np.linspace(-0.25, 0.25, 21) * line_hz
    seen_hz = max((float(f) for f in fine), key=explained)
    phase = 2 * np.pi * seen_hz * (time_s - time_s[0])
    waves = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
    weights = np.linalg.lstsq(waves, rest, rcond=None)[0]
    # By the mean square, because at half the frame rate sine and cosine are one wave and their weights mean nothing.
    depth = float(np.exp2(2 * np.sqrt(2 * np.median(((waves @ weights) ** 2).mean(axis=0)))) - 1)
    if explained(seen_hz) < EXPLAINED or depth < FLICKER_DEPTH:
        return None
    return Flicker(seen_hz, depth), waves


def _change(time_s: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], least: float) -> Change | None:
    """The step from the lowest to the highest of smoothed values, if it is more than `least` and the noise."""
    noise = 1.4826 * float(np.median(np.abs(np.diff(values, n=2)))) / np.sqrt(6)  # of a second difference
    smooth = median_filter(values, SMOOTH_FRAMES, mode="nearest")
    low, high = int(smooth.argmin()), int(smooth.argmax())
    step = float(smooth[high] - smooth[low])
    if step <= max(least, NOISE_TIMES * noise):
        return None
    first, last = sorted((low, high))
    between = (smooth[first : last + 1] - smooth[first]) / (smooth[last] - smooth[first])
    begin = first + int(np.flatnonzero(between <= SETTLED)[-1])
    end = first + int(np.flatnonzero(between >= 1 - SETTLED)[0])
    return Change(step if low < high else -step, float(time_s[begin]), float(time_s[max(begin, end)]))
