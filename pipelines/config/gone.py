"""Keys of scene.yaml that there were once, each with what to do instead of giving it."""

GONE: dict[str, str] = {
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key, and see "
    "`mapper: both` for a comparison",
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW files "
    "with another program where they are needed",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
}
"""Dotted key -> what is said where a file still has it."""
