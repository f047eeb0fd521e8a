"""Keys of scene.yaml and options of commands that earlier versions had and this one has not.

A scene.yaml or a command with one of them is refused like one with any other that is unknown, but is told that it is
gone.
"""

from collections.abc import Sequence

GONE: dict[str, str] = {
    "cache": "finished stages are kept in their run folder alone; remove the section, and give settings that are to be "
    "compared an output each",
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key, and see "
    "`mapper: both` for a comparison",
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW files "
    "with another program where they are needed",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
    "reconstruct.learn_clocks": "`tiny` and `fast` find a camera whose clock is wrong by themselves; remove the key",
}
"""Dotted key -> what does its work now, and what to do."""

GONE_OPTIONS: dict[str, str] = {
    "batch --store": "machines work on a disk that all of them share or mount under the same path; mount the "
    "store there",
}
"""Command and option -> the same."""


def gone_option(words: Sequence[str]) -> str | None:
    """What is said of a command line that uses an option which is gone; None where it uses none."""
    for word in words[1:]:
        option = word.partition("=")[0]
        if (gone := GONE_OPTIONS.get(f"{words[0]} {option}")) is not None:
            return f"{option}: is no longer an option: {gone}"
    return None
