"""What files say of when they were recorded: a coarse cue that can settle what sound leaves ambiguous.

A timecode counts frames and is good to a frame where the cameras were jammed together; the creation time of
a container counts seconds. Cameras' clocks are set by hand: to the wrong zone, or minutes off. So neither is
more than a guess by itself, and both are checked against what was measured.
"""

from collections.abc import Mapping

from devrf.calibration.clocks.equations import Equation
from devrf.capture.video.recorded import Recorded

CREATION_STD_S = 1.0  # whole seconds, and some cameras write the end of the second
TIMECODE_STD_FRAMES = 0.6  # whole frames of free-running cameras
ZONE_S = 1800.0  # zones differ by whole half hours
ZONE_SLACK_S = 60.0  # what clocks set by hand differ beside that
FAR_OFF_S = 5.0  # two clocks that agree better than this with what was measured are plausible
DAY_S = 86_400.0
GUESS_QUALITY = 0.5  # after guesses by sound and motion, which saw the clips themselves


def stated_delay(first: Recorded, second: Recorded) -> tuple[float, float, str] | None:
    """Delay between two clips by their files: seconds, standard deviation, and what says so; None without."""
    a, b = first, second
    if a.timecode_s is not None and b.timecode_s is not None:
        delay_s = (b.timecode_s - a.timecode_s + DAY_S / 2) % DAY_S - DAY_S / 2  # midnight may lie between
        step_s = max(1 / (r.timecode_fps or 30.0) for r in (a, b))
        return delay_s, TIMECODE_STD_FRAMES * step_s, "timecode"
    if a.created_s is not None and b.created_s is not None:
        return b.created_s - a.created_s, CREATION_STD_S, "creation time"
    return None


def doubts(
    recorded: Mapping[str, Recorded], measured: Mapping[tuple[str, str], float], longest_s: float
) -> list[str]:
    """What is wrong with what the files say, one sentence for each camera, compared with the first one.

    Args:
        recorded: Camera -> what its file says; the first camera is the reference.
        measured: (first, other) -> delay that a better cue found.
        longest_s: Length of the longest clip.
    """
    notes = []
    names = list(recorded)
    for name in names[1:]:
        stated = stated_delay(recorded[names[0]], recorded[name])
        if stated is None:
            continue
        delay_s, std_s, what = stated
        found_s = measured.get((names[0], name))
        error_s = delay_s - (found_s or 0.0)
        slack_s = FAR_OFF_S if found_s is not None else longest_s + FAR_OFF_S
        zones = round(error_s / ZONE_S)
        if abs(error_s) <= max(slack_s, 4 * std_s):
            continue
        if zones and abs(error_s - zones * ZONE_S) <= max(slack_s, ZONE_SLACK_S):
            notes.append(
                f"camera {name}: its {what} is {zones * ZONE_S / 3600:+.1f} h off (clock set to another zone or day); "
                "ignored"
            )
        elif found_s is not None:
            notes.append(f"camera {name}: its {what} is {error_s:+.1f} s off what was measured; ignored")
        else:
            notes.append(
                f"camera {name}: by its {what} it began {delay_s:+.1f} s after {names[0]}, the clips would not overlap"
            )
    return notes


def timecode_guesses(recorded: Mapping[str, Recorded], longest_s: float) -> list[Equation]:
    """Clocks by timecode alone, for cameras that nothing else reaches and that could overlap with the first."""
    names = list(recorded)
    out = []
    for name in names[1:]:
        stated = stated_delay(recorded[names[0]], recorded[name])
        if stated is not None and stated[2] == "timecode" and abs(stated[0]) < longest_s:
            delay_s, std_s, _ = stated
            out.append(
                Equation(names[0], name, delay_s, 0.0, std_s, "timestamps", GUESS_QUALITY, False, True)
            )
    return out
