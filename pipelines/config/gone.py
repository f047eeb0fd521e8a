"""Keys of scene.yaml that earlier versions had and this one has not.

A scene.yaml with one of them is refused like one with any other unknown key, but is told that the key is gone.
"""

GONE: dict[str, str] = {
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key",
    "calibration.static_poses.time_minutes": "structure from motion takes as long as it needs; remove the key, and "
    "limit the whole run with budget.time_minutes",
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW files "
    "with another program where they are needed",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
    "reconstruct.learn_clocks": "`tiny` and `fast` find a camera whose clock is wrong by themselves; remove the key",
}
"""Dotted key -> what does its work now, and what to do."""
