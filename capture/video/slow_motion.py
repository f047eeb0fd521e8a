"""Clips whose pictures do not come as fast as they were filmed: what the file says, and how long its sound is."""

from pathlib import Path

from devrf.capture.measure import Measure
from devrf.capture.system.errors import InputError
from devrf.capture.video.media import mean_fps, open_media, tag

FILMED_FPS = "com.android.capture.fps"  # tag of phones: pictures a second while filming
WHOLE_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 100.0, 120.0)  # pictures a second that cameras have
SAME_RATE = 1.2  # rates and lengths that differ by more are not the same
LEAST_APART_S = 1.0  # of lengths: sound that starts late or ends early by less says nothing ...
LEAST_BETWEEN_RATES_S = 0.3  # ... but where the two are as two usual rates
ENDS_S = 0.1  # what sound starts late and ends early by in files that are in order
LEAST_SOUND_S = 2.0  # of less it does not tell two rates apart
WHOLE = 0.02  # a factor this near to a whole number is one


def is_one(factor: float) -> bool:
    """Whether a factor between two rates, or two lengths, says nothing."""
    return 1 / SAME_RATE <= factor <= SAME_RATE


def filmed_factor(path: Path) -> float | None:
    """How many times slower a clip plays than it was filmed, where its tags say; None where they do not.

    Raises:
        InputError: If it is missing or not a video.
    """
    with open_media(path) as container:
        said, fps = tag(container, FILMED_FPS), mean_fps(container, path)
    try:
        return None if said is None or not fps else float(said) / fps
    except ValueError:
        return None


def check_filmed_rate(path: Path) -> None:
    """Refuse a clip that says that it plays slower or faster than it was filmed: none of its times is true.

    Raises:
        InputError: Naming the factor, and what makes the times true.
    """
    factor = filmed_factor(path)
    if factor is None or factor <= 0 or is_one(factor):
        return
    wrong = f"{path}: filmed {factor:.3g} times as fast as it plays ({FILMED_FPS}), so its times are not true"
    text = f"{wrong}; {_scaled(1 / factor)} makes them so, without sound; or give capture.timestamps"
    raise InputError("clip-slow-motion", text)


def length_faults(pictures_s: float, sound_s: float, fps: float | None = None) -> list[Measure]:
    """What to say of a clip whose pictures last as long as they do, and its sound; `fps`: as the file has it."""
    if min(pictures_s, sound_s) <= 0 or abs(pictures_s - sound_s) < LEAST_BETWEEN_RATES_S:
        return []
    factor = pictures_s / sound_s
    filmed = None
    if fps is not None and sound_s >= LEAST_SOUND_S:
        filmed = _usual_rate(fps * factor, WHOLE / 4 + ENDS_S / sound_s)
    far = abs(pictures_s - sound_s) >= LEAST_APART_S
    text = f"{pictures_s:.2f} s of pictures, {sound_s:.2f} s of sound: a factor of {factor:.3g}"
    if far and round(factor) >= 2 and abs(factor / round(factor) - 1) < WHOLE:
        why = "slow"
    elif filmed is not None and fps is not None and _usual_rate(fps, WHOLE) not in (None, filmed):
        why, text = "filmed", f"{text}, as of {filmed:.4g} pictures a second written as {fps:.4g}"
    elif not far or is_one(factor):
        return []
    else:
        why = "cut"
    return [Measure("clip-times", text, why=why, facts={"command": _scaled(1 / factor)})]


def _usual_rate(fps: float, tolerance: float) -> float | None:
    """The usual rate next to one; None where it is farther off than this share. 29.97 and 30 are one."""
    whole = min(WHOLE_RATES, key=lambda rate: abs(fps / rate - 1))
    return whole if abs(fps / whole - 1) <= tolerance else None


def _scaled(factor: float) -> str:
    """The command that makes all times of a clip so many times as long."""
    return f"`ffmpeg -itsscale {factor:.6g} -i IN.mp4 -map 0:v -c copy OUT.mp4`"
