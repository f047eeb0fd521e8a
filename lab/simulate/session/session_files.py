"""What lies beside a simulated session's clips: what is true, and how to run it."""

from dataclasses import replace
from typing import Any

import numpy as np

from devrf.capture.camera import Camera
from devrf.lab.simulate.scenes.catalogue import Mesh, MovingObject
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.session.camera_rig import (
    BOARD_SQUARE_M,
    BOARD_SQUARES,
    CLAPPER,
    FixedCamera,
    board_pose,
)

TRACKED_POINTS = 60  # surface points whose way is written to the truth
TRACK_FPS = 16.0
MARKER_M = round(0.75 * BOARD_SQUARE_M, 6)
BACKGROUND_HZ = 0.6  # at a motion_speed of 1
SWAY_HZ = 0.3


def ground_truth(
    sweep: list[Camera],
    fixed: list[FixedCamera],
    claps_s: np.ndarray,
    thing: MovingObject,
    options: SessionOptions,
    made_by: dict[str, Any],
) -> dict[str, Any]:
    """What ground_truth.json holds: see `simulate_session` and docs/formats.md."""
    chosen = np.linspace(0, len(thing.rest.vertices) - 1, TRACKED_POINTS).round().astype(int)
    last_s = max(camera.true_time(float(camera.file_times_s[-1])) for camera in fixed)
    times_s = np.arange(0.0, last_s, 1 / TRACK_FPS)
    tracks = [object_at(thing, float(t), options).vertices[chosen] for t in times_s]
    truth: dict[str, Any] = {
        "width": fixed[0].camera.width,
        "height": fixed[0].camera.height,
        "fps": options.fps,
        **_lens_truth(fixed[0].camera),
        "static": [camera.world_from_cam.tolist() for camera in sweep],
        "cams": {
            c.name: {
                "pose": c.camera.world_from_cam.tolist(),
                "offset_s": c.offset_s,
                "drift_ppm": c.drift_ppm,
                **_lens_truth(c.camera),
                "gain": c.gain,
                "clapper_distance_m": round(clapper_distance_m(c), 6),
                "file_times_s": c.file_times_s.round(7).tolist(),
            }
            for c in fixed
        },
        "board": None,
        "sweep": {"fps": options.sweep_fps, **_lens_truth(sweep[0])},
        "claps": {"position_m": CLAPPER.tolist(), "times_s": claps_s.round(7).tolist()},
        "object": {
            "rest_until_s": options.rest_s,
            "times_s": times_s.tolist(),
            "points_m": np.round(tracks, 5).tolist(),
        },
        "made_by": made_by,
    }
    if options.board:
        truth["board"] = {
            "world_from_board": board_pose().tolist(),
            "squares": list(BOARD_SQUARES),
            "square_m": BOARD_SQUARE_M,
            "marker_m": MARKER_M,
            "dictionary": "DICT_5X5_100",
        }
    return truth


def _lens_truth(camera: Camera) -> dict[str, Any]:
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    return {"K": K.tolist(), "k1": float(camera.distortion[0])}


def _rest(fixed: list[FixedCamera], options: SessionOptions) -> str:
    """Whether the first moment that all cameras record is still at rest."""
    from_s = max(camera.offset_s for camera in fixed)
    return "start" if from_s <= options.rest_s or options.motion_scale == 0 else "none"


def scene_yaml(scene: str, fixed: list[FixedCamera], options: SessionOptions) -> str:
    """A configuration that runs the session beside it."""
    names = [c.name for c in fixed]
    clips = ", ".join(f"{n}: {n}.mp4" for n in names[:-1])
    lines = [
        "# A simulated session; ground_truth.json beside this file holds what is true.",
        f"name: {scene}",
        f"output: runs/{scene}",
        "preset: tiny                       # sized for two cores without a GPU",
        "capture:",
        "  static: static.mp4               # the sweep of the scene at rest",
        f"  cameras: {{{clips}}}",
        f"  test_cameras: {{{names[-1]}: {names[-1]}.mp4}}    # never trained on",
        f"  rest: {_rest(fixed, options):<29}# when the moving clips show the scene as in the sweep",
    ]
    if options.board:
        columns, rows = BOARD_SQUARES
        boards = ", ".join(f"{n}: charuco_{n}.mp4" for n in ["static", *names])
        lines += [
            "  board:",
            "    type: charuco",
            f"    squares: [{columns}, {rows}]",
            f"    square_m: {BOARD_SQUARE_M}",
            f"    marker_m: {MARKER_M}",
            "    dictionary: DICT_5X5_100",
            f"    clips: {{{boards}}}",
        ]
    lines.append("evaluate: {truth: ground_truth.json}")
    return "\n".join(lines) + "\n"


def object_at(thing: MovingObject, time_s: float, options: SessionOptions, share: float = 1.0) -> Mesh:
    """The object at a time on cam0's clock, or this share of the way there."""
    since_s = options.motion_speed * (time_s - options.rest_s)
    rest = thing.rest.vertices
    return replace(thing.rest, vertices=rest + share * (thing.vertices_at(since_s) - rest))


def swaying(mesh: Mesh, time_s: float, sway_m: float) -> Mesh:
    """The object as it sways about what it stands on: by height, to and fro, and half as far sideways."""
    if not sway_m:
        return mesh
    z = mesh.vertices[:, 2]
    height = (z - z.min()) / max(np.ptp(z), 1e-6)
    w = 2 * np.pi * SWAY_HZ * time_s
    way = sway_m * np.array([np.sin(w), 0.5 * np.sin(1.7 * w + 1.0), 0.0])
    return replace(mesh, vertices=mesh.vertices + height[:, None] * way)


def background_at(behind: list[Mesh], time_s: float, options: SessionOptions) -> list[Mesh]:
    """The boxes behind the object: towards the middle and back, at rest when the object is."""
    since_s = options.motion_speed * max(time_s - options.rest_s, 0.0)
    way_m = options.background_motion_m * (1 - np.cos(2 * np.pi * BACKGROUND_HZ * since_s)) / 2
    return [
        replace(mesh, vertices=mesh.vertices - [0.0, np.sign(mesh.vertices[:, 1].mean()) * way_m, 0.0])
        for mesh in behind
    ]


def lamp_shift_m(time_s: float, options: SessionOptions) -> float:
    """Way of the lamp: evenly over what the object moves."""
    moving_s = max(options.duration_s - options.rest_s, 1e-6)
    return options.lamp_travel_m * float(np.clip((time_s - options.rest_s) / moving_s, 0, 1))


def clapper_distance_m(camera: FixedCamera) -> float:
    """From the clapping hands to the camera's microphone."""
    return float(np.linalg.norm(camera.camera.centre - CLAPPER))
