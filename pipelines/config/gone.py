"""Keys of scene.yaml, and options of commands, that earlier versions had and this one has not.

They are refused like any other unknown key or option, but are told to be gone, and what does their work now.
"""

NO_PATH = "this path is no longer filmed; name a camera_path.json instead, as nerfstudio's viewer writes it"
NO_RAMP = "films show all of the clip, or one time; name a camera_path.json whose pictures have a render_time instead"

GONE: dict[str, str] = {
    "--format webp": "animated pictures are no longer written; write mp4 or png, and make one of that with ffmpeg",
    "--layers confidence": "films show colour and depth only; the report shows how sure pictures are",
    "--layers flow": "films show colour and depth only; leave it out",
    "--path between": NO_PATH,
    "--path dolly": NO_PATH,
    "--path vertigo": NO_PATH,
    "calibration.static_poses.check_seed": "poses are no longer mapped with another seed; remove the key, and see "
    "`mapper: both` for a comparison",
    "capture.raw.keep_linear": "pictures in linear light are no longer kept; remove the key, and develop the RAW files "
    "with another program where they are needed",
    "flow.preset": "DIS has one setting, the most accurate one (medium); remove the key",
    "reconstruct.learn_clocks": "`tiny` and `fast` find a camera whose clock is wrong by themselves; remove the key",
    "render --beside": "the report shows true pictures beside rendered ones; leave it out",
    "render --from": NO_RAMP,
    "render --ping-pong": "write --format png instead, and play the pictures there and back",
    "render --slow": NO_RAMP,
    "render --speed": "give the length of the film instead, with --seconds",
    "render --to": NO_RAMP,
}
"""Dotted key, or an option with its command or its value -> what does its work now, and what to do."""
