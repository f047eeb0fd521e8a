"""Keys of scene.yaml, options of commands, and values of both, that earlier versions had and this one has not.

They are refused like any other that is unknown, but it is told that they are gone.
"""

from collections.abc import Sequence

NO_CHART = "cameras are brought to one look by surface points that they share; remove the key"
NO_PROGRAM = (
    "programs are no longer run; run yours on the pictures, and name its folder of mattes (`mattes: FOLDER`)"
)
NO_GRIDS = "voxel grids are no longer written; read `model.safetensors` of the run instead"
NO_LAYOUT = "this layout is no longer written; export to nerfstudio or colmap"
NO_RIG = "this calibration is no longer written; export to rig-opencv, rig-colmap or rig-caliscope"

GONE: dict[str, str] = {
    "cache": "finished stages are kept in their run folder alone; remove the section, and give settings that are to be "
    "compared an output each",
    "calibration.colour.chart": NO_CHART,
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key, and see "
    "`mapper: both` for a comparison",
    "capture.mattes.command": NO_PROGRAM,
    "capture.mattes.timeout_s": NO_PROGRAM,
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW files "
    "with another program where they are needed",
    "capture.white": "light that falls off to the corners is no longer evened out; remove the key, and where it "
    "matters even the pictures out with another program",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
    "reconstruct.learn_clocks": "`tiny` and `fast` find a camera whose clock is wrong by themselves; remove the key",
}
"""Dotted key -> what does its work now, and what to do."""

GONE_OPTIONS: dict[str, str] = {
    "batch --store": "machines work on a disk that all of them share or mount under the same path; mount the "
    "store there",
}
"""Command and option -> the same."""

GONE_VALUES: dict[str, str] = {
    "--format blender": NO_LAYOUT,
    "--format devrf": NO_LAYOUT,
    "--format llff": NO_LAYOUT,
    "--format mesh": "meshes of single times are no longer written; export to glb with --times 1.5s and the like",
    "--format npz": NO_GRIDS,
    "--format rig-anipose": NO_RIG,
    "--format rig-easymocap": NO_RIG,
    "--format rig-kalibr": NO_RIG,
    "--format rig-pose2sim": NO_RIG,
    "--format zarr": NO_GRIDS,
    "calibration.colour.method: chart": NO_CHART,
    "capture.mattes.method: background": "mattes by a clean plate are no longer made; make them with another program, "
    "and name their folder (`mattes: FOLDER`)",
    "capture.mattes.method: command": NO_PROGRAM,
}
"""Option or dotted key, and value -> the same."""


def gone_option(words: Sequence[str]) -> str | None:
    """What is said of a command line that uses an option which is gone; None where it uses none."""
    for word in words[1:]:
        option = word.partition("=")[0]
        if (gone := GONE_OPTIONS.get(f"{words[0]} {option}")) is not None:
            return f"{option}: is no longer an option: {gone}"
    return None
