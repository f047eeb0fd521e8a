"""Keys of scene.yaml, options of commands, and values of both, that earlier versions had and this one has not.

They are refused like any other that is unknown, but it is told that they are gone, and what does their work now.
"""

NO_CHART = "cameras are brought to one look by surface points that they share; remove the key"
NO_PROGRAM = (
    "programs are no longer run; run yours on the pictures, and name its folder of mattes (`mattes: FOLDER`)"
)
NO_GRIDS = "voxel grids are no longer written; read `model.safetensors` of the run instead"
NO_LAYOUT = "this layout is no longer written; export to nerfstudio or colmap"
NO_RIG = "this calibration is no longer written; export to rig-opencv, rig-colmap or rig-caliscope"
NO_PATH = "this path is no longer filmed; name a camera_path.json instead, as nerfstudio's viewer writes it"
NO_RAMP = "films show all of the clip, or one time; name a camera_path.json whose pictures have a render_time instead"

GONE: dict[str, str] = {
    "--format blender": NO_LAYOUT,
    "--format devrf": NO_LAYOUT,
    "--format llff": NO_LAYOUT,
    "--format mesh": "meshes of single times are no longer written; export to glb with --times 1.5s and the like",
    "--format npz": NO_GRIDS,
    "--format rig-anipose": NO_RIG,
    "--format rig-easymocap": NO_RIG,
    "--format rig-kalibr": NO_RIG,
    "--format rig-pose2sim": NO_RIG,
    "--format webp": "animated pictures are no longer written; write mp4 or png, and make one of that with ffmpeg",
    "--format zarr": NO_GRIDS,
    "--layers confidence": "films show colour and depth only; the report shows how sure pictures are",
    "--layers flow": "films show colour and depth only; leave it out",
    "--path between": NO_PATH,
    "--path dolly": NO_PATH,
    "--path vertigo": NO_PATH,
    "batch --store": "machines work on a disk that all of them share or mount under the same path; mount the store "
    "there",
    "cache": "finished stages are kept in their run folder alone; remove the section, and give settings that are to "
    "be compared an output each",
    "calibration.colour.chart": NO_CHART,
    "calibration.colour.method: chart": NO_CHART,
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key",
    "calibration.static_poses.time_minutes": "structure from motion takes as long as it needs; remove the key, and "
    "limit the whole run with budget.time_minutes",
    "capture.mattes.command": NO_PROGRAM,
    "capture.mattes.method: background": "mattes by a clean plate are no longer made; make them with another program, "
    "and name their folder (`mattes: FOLDER`)",
    "capture.mattes.method: command": NO_PROGRAM,
    "capture.mattes.timeout_s": NO_PROGRAM,
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW "
    "files with another program where they are needed",
    "capture.white": "light that falls off to the corners is no longer evened out; remove the key, and where it "
    "matters even the pictures out with another program",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
    "reconstruct.fine_tuning_iterations": "the preset says whether the scene at rest follows moving pictures, "
    "too, and it does so where that gains; remove the key",
    "reconstruct.learn_clocks": "`tiny` and `fast` find a camera whose clock is wrong by themselves; remove the key",
    "reconstruct.learning_rate": "a training that runs away takes smaller steps by itself; remove the key",
    "render --beside": "the report shows true pictures beside rendered ones; leave it out",
    "render --from": NO_RAMP,
    "render --ping-pong": "write --format png instead, and play the pictures there and back",
    "render --slow": NO_RAMP,
    "render --speed": "give the length of the film instead, with --seconds",
    "render --to": NO_RAMP,
}
"""Dotted key, `command --option`, `--option value` or `dotted key: value` -> what does its work now, what to do."""
