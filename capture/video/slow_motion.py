"""Clips whose pictures do not come as fast as they were filmed: what the file says, and how long its sound is."""

from pathlib import Path

from devrf.capture.measure import Measure
from devrf.capture.system.errors import InputError
from devrf.capture.video.media import mean_fps, open_media, tag

FILMED_FPS = "com.android.capture.fps"  # tag of phones: pictures a second while filming
SAME_RATE = 1.2  # rates and lengths that differ by more are not the same
LEAST_APART_S = 1.0  # of lengths: sound that starts late or ends early by less says nothing
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


def length_faults(pictures_s: float, sound_s: float) -> list[Measure]:
    """What to say of a clip whose pictures last as long as they do, and its sound."""
    if min(pictures_s, sound_s) <= 0 or abs(pictures_s - sound_s) < LEAST_APART_S:
        return []
    factor = pictures_s / sound_s
    if is_one(factor):
        return []
    slow = round(factor) >= 2 and abs(factor / round(factor) - 1) < WHOLE
    found = f"{pictures_s:.2f} s of pictures, {sound_s:.2f} s of sound"
    facts = {"command": _scaled(1 / factor)}
    return [
        Measure(
            "clip-times", f"{found}: a factor of {factor:.3g}", why="slow" if slow else "cut", facts=facts
        )
    ]


def _scaled(factor: float) -> str:
    """The command that makes all times of a clip so many times as long."""
    return f"`ffmpeg -itsscale {factor:.6g} -i IN.mp4 -map 0:v -c copy OUT.mp4`"
