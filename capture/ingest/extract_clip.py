"""From one raw clip to frames on disk, in a single pass that holds a few pictures at most.

Along the way each frame is measured (`clip_watch.py`): sharpness, brightness, how much differs from the frame before
(the motion energy by which silent cameras are put on one clock), how bright each band of rows is (flashes of light).
Pictures are written beside the decoding (`picture_writer.py`); what is measured needs luma only.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.capture.colour.light_course import LightCourse
from devrf.capture.frames import (
    SHARPNESS_SIDE_PX,
    CameraFrames,
    FrameRecord,
    Role,
    sharpness,
    timing,
    window_of,
)
from devrf.capture.ingest.clip_faults import bit_rate_fault, repeats_fault
from devrf.capture.ingest.clip_watch import ClipWatch, Unused
from devrf.capture.ingest.empty_ends import empty_note
from devrf.capture.ingest.picture_writer import SUFFIX, PictureWriter
from devrf.capture.ingest.signals import Courses
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.video.packets import scan_packets
from devrf.capture.video.reader import VideoFrame, VideoInfo, VideoReader
from devrf.capture.video.timestamps import FrameTimes, table_factor, table_faults


@dataclass(frozen=True)
class Keep:
    """Which frames of a clip are kept.

    Attributes:
        most: At most this many, spread over the clip; None: all.
        choose: The sharpest of each window, or every n-th (so that cameras keep common moments).
        range_s: Only frames whose time lies in (from, to); None: all.
        only_range: Measure nothing outside `range_s` either: the reader jumps to its start and stops at its end.
    """

    most: int | None = None
    choose: Literal["sharpest", "every"] = "sharpest"
    range_s: tuple[float, float] | None = None
    only_range: bool = False


@dataclass(frozen=True)
class Extract:
    """A clip's frames and its courses over time.

    Attributes:
        frames: The frames.
        courses: Motion and brightness.
        light: The light of a fixed camera's clip; None for others.
    """

    frames: CameraFrames
    courses: Courses
    light: LightCourse | None


def extract_clip(
    path: Path,
    out: Path,
    name: str,
    role: Role,
    source: str,
    keep: Keep,
    times: FrameTimes | None = None,
    progress: Progress = no_progress,
    workers: int | None = None,
) -> Extract:
    """Decode a video and write the frames to keep as `out/frames/<name>/<index>.jpg`.

    Args:
        path: The clip.
        out: The ingest folder.
        name: Its name among the cameras.
        role: What it shows.
        source: How the file is called in `ingest.json`.
        keep: Which frames to keep.
        times: True times of its frames; frames that are not in it are not used. None: file times.
        progress: Told how far it is.
        workers: Pictures decoded at once, and as many written; None: one per core.
    Raises:
        InputError: If the file cannot be opened as a video.
        CaptureError: If no frame can be used.
    """
    (out / "frames" / name).mkdir(parents=True, exist_ok=True)
    packets = scan_packets(path)
    count = max(1, packets.count)
    true_time = None if times is None else dict(zip(times.index.tolist(), times.time_s.tolist(), strict=True))
    # A table of true times says nothing of file times, so only by decoding is its range found.
    span = keep.range_s if keep.only_range and true_time is None else None
    seen = ClipWatch(role)
    file_s: dict[int, float] = {}
    records: dict[int, FrameRecord] = {}
    unused = Unused()
    best: tuple[int, FrameRecord, VideoFrame] | None = None  # of the current window

    with (
        VideoReader(path, None if span is None else span[0], workers) as reader,
        PictureWriter(workers) as writer,
    ):

        def write_best() -> None:
            if best is not None:
                _, record, frame = best
                file = f"frames/{name}/{record.index:06d}{SUFFIX}"
                writer.put(out / file, frame)
                records[record.index] = replace(record, used=True, file=file)

        for frame in reader:
            if span is not None and frame.time_s > span[1]:
                break
            file_s[frame.index] = frame.time_s
            time_s = frame.time_s if true_time is None else true_time.get(frame.index)
            progress(min(1.0, frame.index / count), f"{name}: {frame.index + 1} of {count} frames")
            if unused.picture(frame, time_s, reader.info):
                records[frame.index] = FrameRecord(frame.index, time_s, 0.0, False, None)
                continue
            grey = frame.stored_grey(SHARPNESS_SIDE_PX)
            record = FrameRecord(frame.index, time_s, sharpness(grey), False, None)
            records[frame.index] = record
            if unused.time(frame.index, time_s) or time_s is None:
                continue
            seen.add(frame, time_s, grey)
            if keep.range_s is not None and not keep.range_s[0] <= time_s <= keep.range_s[1]:
                continue
            window = frame.index if keep.most is None else window_of(frame.index, count, keep.most)
            if best is None or window != best[0]:
                write_best()
                best = (window, record, frame)
            elif keep.choose == "sharpest" and record.sharpness > best[1].sharpness:
                best = (window, record, frame)
        write_best()
    empty = seen.empty()
    repeated = seen.repeats.frames(empty)
    for index in (*repeated, *empty):
        file = records[index].file
        if file is not None:
            (out / file).unlink()
            records[index] = replace(records[index], used=False, file=None)
    timed = np.array(seen.courses.times_s)
    if not any(record.used for record in records.values()):
        raise _nothing_used(path, keep, timed, reader.info)
    info, told = reader.info, timing(np.unique([*timed, *unused.times_s]))
    notes = [*info.notes, *told.notes, *unused.notes(len(records)), *empty_note(*seen.courses.empty())]
    if true_time is not None and max(true_time) >= count:
        notes.append(f"the table of times names frame {max(true_time)}, the clip has {count}")
    faults = [*unused.faults(), *seen.faults(info), *bit_rate_fault(info, packets.count, packets.size_bytes)]
    if times is not None:
        faults += table_faults(table_factor(times, file_s))
    if repeated:
        faults.append(repeats_fault(repeated, len(records)))
    frames = CameraFrames(
        role=role,
        source=source,
        width=info.width,
        height=info.height,
        fps_mean=told.fps_mean,
        variable_rate=told.variable_rate,
        has_audio=False,
        exif_focal_px=None,
        rotation_deg=info.upright.degrees,
        mirrored=info.upright.mirrored,
        frames=tuple(records[index] for index in sorted(records)),
        level=float(np.median(seen.courses.levels)),
        missing_frames=told.missing_frames,
        ended_early=reader.ended_early,
        announced_frames=info.announced_frames,
        pixel_aspect=info.pixel_aspect,
        notes=tuple(notes),
        faults=tuple(faults),
    )
    light = None if seen.light is None else seen.light.course().without(empty)
    return Extract(frames, seen.courses.courses(), light)


def _nothing_used(path: Path, keep: Keep, time_s: Float[np.ndarray, " n"], info: VideoInfo) -> CaptureError:
    if keep.range_s is None:
        if len(time_s):
            return CaptureError("video-unreadable", f"{path}: no frame can be used; record the clip again")
        wrong = f"{path}: none of its frames has a time; correct capture.timestamps"
        return CaptureError("times-missing", wrong)
    from_s, to_s = keep.range_s
    if len(time_s):
        there = f"it goes from {time_s[0]:.2f} to {time_s[-1]:.2f} s"
    else:
        there = "its length is unknown" if info.duration_s is None else f"it is {info.duration_s:.2f} s long"
    text = f"{path}: no frame between {from_s:.2f} and {to_s:.2f} s ({there}); change capture.range_s"
    return CaptureError("range-empty", text)
