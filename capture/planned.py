"""What `ingest` will make of a clip or a folder of photos, told without decoding all of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from devrf.capture.audio import Sound
from devrf.capture.frames import CameraFrames, FrameRecord, Role, timing
from devrf.capture.ingest import MAX_SWEEP_FRAMES
from devrf.capture.survey import Look


def planned_frames(
    look: Look, role: Role, source: str, sound: Sound | None = None, sharpness: Sequence[float] = ()
) -> CameraFrames:
    """Frames and times of one camera as `ingest` would write them, without pictures.

    Args:
        look: The clip or folder, looked into.
        role, source: As in `CameraFrames`.
        sound: Of the clip; None where it has none that can be heard.
        sharpness: Of pictures spread evenly; each stands for those around it.
    """
    seen = timing(look.times_s)
    used = np.ones(look.count, dtype=bool)
    if role == "sweep":
        used = np.isin(np.arange(look.count), sweep_pictures(look))
    times = look.times_s.tolist() or [None] * look.count
    values = [
        sharpness[n * len(sharpness) // look.count] if sharpness else math.nan for n in range(look.count)
    ]
    frames = CameraFrames(
        role=role,
        source=source,
        width=look.width,
        height=look.height,
        fps_mean=seen.fps_mean,
        variable_rate=seen.variable_rate,
        has_audio=sound is not None,
        exif_focal_px=None,
        rotation_deg=0,
        frames=tuple(
            FrameRecord(n, time_s, value, bool(used[n]), None)
            for n, (time_s, value) in enumerate(zip(times, values, strict=True))
        ),
        level=look.level,
        missing_frames=seen.missing_frames,
        notes=(*look.notes, *seen.notes),
    )
    return frames if sound is None else replace(frames, audio_start_s=sound.start_s)


def sweep_pictures(look: Look) -> Int[np.ndarray, " n"]:
    """About which pictures of a sweep are used [n]: one of each window of a clip, every photo."""
    if not look.is_clip or look.count <= MAX_SWEEP_FRAMES:
        return np.arange(look.count)
    return ((np.arange(MAX_SWEEP_FRAMES) + 0.5) * look.count / MAX_SWEEP_FRAMES).astype(np.int64)
