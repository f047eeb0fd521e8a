"""From one raw clip or folder of photos to frames on disk, in a single pass that holds two pictures at most.

Along the way each frame is measured: sharpness, brightness, how much differs from the frame before (the motion
energy by which silent cameras are put on one clock), and how bright each band of rows is (flashes of light).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.errors import CaptureError
from devrf.capture.exif import Exif
from devrf.capture.frames import (
    LISTED,
    CameraFrames,
    FrameRecord,
    Role,
    grey_small,
    sharpest_per_window,
    sharpness,
    timing,
    window_of,
)
from devrf.capture.pictures import copy_upright, list_pictures, probe_picture, read_picture, write_picture
from devrf.capture.progress import Progress, no_progress
from devrf.capture.raw import Development, develop, is_raw
from devrf.capture.session import FrameTimes
from devrf.capture.video import VideoReader, count_packets

MOTION_SIDE_PX = 160  # averages sensor noise away; a moving hand still covers several pixels
ROW_BANDS = 24  # a flash is placed to a twenty-fourth of the readout, about a millisecond
FEWEST_OF_A_SIZE = 5  # photos of a sweep; fewer leave their focal length to chance
DUPLICATE_LEVEL = 0.1  # mean absolute difference, levels of 255: below it two frames are the same picture
BRIGHTNESS_DRIFT = 0.06  # of a fixed camera's pixels, sRGB (about 13 % of the light): automatic exposure
JPEG_QUALITY = 95  # board clips: corners are found within 0.02 px of the PNG's


@dataclass(frozen=True)
class Keep:
    """Which frames of a clip are kept.

    Attributes:
        most: At most this many, spread over the clip; None: all.
        choose: The sharpest of each window, or every n-th (so that cameras keep common moments).
        range_s: Only frames whose time lies in (from, to); None: all.
        suffix: Kind of file.
    """

    most: int | None = None
    choose: Literal["sharpest", "every"] = "sharpest"
    range_s: tuple[float, float] | None = None
    suffix: Literal[".png", ".jpg"] = ".png"


@dataclass(frozen=True)
class Extract:
    """A clip's frames and its courses over time.

    Attributes:
        frames: The frames.
        motion: Motion energy: time between two frames, mean absolute difference [n, 2].
        brightness: Time of a frame, mean level of each band of rows in the sensor's order [n, 1 + bands].
    """

    frames: CameraFrames
    motion: Float[np.ndarray, "n 2"]
    brightness: Float[np.ndarray, "m bands"]


def extract_clip(
    path: Path,
    out: Path,
    name: str,
    role: Role,
    source: str,
    keep: Keep,
    times: FrameTimes | None = None,
    progress: Progress = no_progress,
) -> Extract:
    """Decode a video and write the frames to keep as `out/frames/<name>/<index>.<suffix>`.

    Args:
        path: The clip.
        out: The ingest folder.
        name: Its name among the cameras.
        role: What it shows.
        source: How the file is called in `ingest.json`.
        keep: Which frames to keep.
        times: True times of its frames; frames that are not in it are not used. None: file times.
    Raises:
        InputError: If the file cannot be opened as a video.
        CaptureError: If no frame can be used.
    """
    folder = out / "frames" / name
    folder.mkdir(parents=True, exist_ok=True)
    count = max(1, count_packets(path))
    true_time = None if times is None else dict(zip(times.index.tolist(), times.time_s.tolist(), strict=True))
    records: list[FrameRecord] = []
    levels: list[float] = []
    changes: list[float] = []  # median over the pixels, so a subject that covers less than half has no say
    motion: list[tuple[float, float]] = []
    brightness: list[np.ndarray] = []
    duplicates: list[int] = []
    backwards: list[int] = []
    untimed = 0
    best: tuple[int, FrameRecord, UInt8[np.ndarray, "h w 3"]] | None = None  # of the current window
    first_small, last_grey, last_small, last_s = None, None, None, None

    def write_best() -> None:
        if best is not None:
            _, record, rgb = best
            file = f"frames/{name}/{record.index:06d}{keep.suffix}"
            write_picture(out / file, rgb, JPEG_QUALITY)
            records[record.index] = replace(record, used=True, file=file)

    with VideoReader(path) as reader:
        for frame in reader:
            time_s = frame.time_s if true_time is None else true_time.get(frame.index)
            grey = grey_small(frame.rgb)
            small = grey_small(grey[:, :, None].repeat(3, axis=2), MOTION_SIDE_PX)
            levels.append(float(np.median(small)))
            first_small = small if first_small is None else first_small
            changes.append(float(np.median(small.astype(np.int16) - first_small)))
            record = FrameRecord(frame.index, time_s, sharpness(grey), False, None)
            records.append(record)
            progress(min(1.0, frame.index / count), f"{name}: {frame.index + 1} of {count} frames")
            if time_s is None:
                untimed += 1
                continue
            if last_s is not None and time_s <= last_s:
                backwards.append(frame.index)
                continue
            if last_small is not None and last_grey is not None and last_s is not None:
                if float(cv2.absdiff(grey, last_grey).mean()) < DUPLICATE_LEVEL:
                    duplicates.append(frame.index)
                motion.append(((time_s + last_s) / 2, float(cv2.absdiff(small, last_small).mean())))
            brightness.append(np.concatenate([[time_s], _row_bands(grey, reader.info.rotation_deg)]))
            last_grey, last_small, last_s = grey, small, time_s
            if keep.range_s is not None and not keep.range_s[0] <= time_s <= keep.range_s[1]:
                continue
            window = frame.index if keep.most is None else window_of(frame.index, count, keep.most)
            if best is None or window != best[0]:
                write_best()
                best = (window, record, frame.rgb)
            elif keep.choose == "sharpest" and record.sharpness > best[1].sharpness:
                best = (window, record, frame.rgb)
        write_best()
    timed = np.array(
        [r.time_s for i, r in enumerate(records) if r.time_s is not None and i not in set(backwards)]
    )
    if not any(record.used for record in records):
        raise CaptureError(_nothing_used(path, keep, timed))
    info, seen = reader.info, timing(timed)
    notes = [*info.notes, *seen.notes]
    if reader.ended_early:
        notes.append(f"{reader.ended_early}; what is there is used")
    if duplicates:
        notes.append(f"{len(duplicates)} frames repeat the one before: {_places(duplicates)}")
    if backwards:
        notes.append(f"{len(backwards)} timestamps do not increase, frames {_places(backwards)}; not used")
    if untimed:
        notes.append(f"{untimed} of {len(records)} frames have no row in the table of times; not used")
    if true_time is not None and max(true_time) >= len(records):
        notes.append(f"the table of times names frame {max(true_time)}, the clip has {len(records)}")
    drift = (max(changes) - min(changes)) / max(1.0, float(np.median(levels)))
    if role in ("camera", "test") and drift > BRIGHTNESS_DRIFT:
        notes.append(f"brightness changes by {100 * drift:.0f} % (automatic exposure?); lock the exposure")
    frames = CameraFrames(
        role=role,
        source=source,
        width=info.width,
        height=info.height,
        fps_mean=seen.fps_mean,
        variable_rate=seen.variable_rate,
        has_audio=False,
        exif_focal_px=None,
        rotation_deg=info.rotation_deg,
        frames=tuple(records),
        level=float(np.median(levels)),
        missing_frames=seen.missing_frames,
        ended_early=reader.ended_early,
        notes=tuple(notes),
    )
    return Extract(frames, np.array(motion).reshape(-1, 2), np.array(brightness).reshape(-1, 1 + ROW_BANDS))


def extract_folder(
    path: Path,
    out: Path,
    name: str,
    role: Role,
    source: str,
    most: int | None = None,
    progress: Progress = no_progress,
) -> CameraFrames:
    """Put a folder of photos upright into `out/frames/<name>`; see `extract_clip` for the arguments.

    Photos of another size than most of them are not used, because one set of intrinsics must fit all; in a
    sweep, a size of which there are enough photos to fix its intrinsics is a camera of its own.

    Raises:
        InputError: If the folder or a photo cannot be read.
        CaptureError: If a photo's content is damaged.
    """
    folder = out / "frames" / name
    folder.mkdir(parents=True, exist_ok=True)
    pictures = list_pictures(path)
    balance = develop(pictures[0]).white_balance if is_raw(pictures[0]) else None
    files: list[str] = []
    sizes: list[tuple[int, int]] = []
    sharp: list[float] = []
    levels: list[float] = []
    exifs: list[Exif | None] = []
    turned, clipped = 0, 0
    for i, picture in enumerate(pictures):
        progress(i / len(pictures), f"{name}: {i + 1} of {len(pictures)} photos")
        if is_raw(picture):
            photo: Development = develop(picture, balance)
            file = f"{i:06d}.png"
            write_picture(folder / file, photo.rgb)
            clipped += photo.clipped > 0.01
            exifs.append(None)
        else:
            info = probe_picture(picture)
            file = copy_upright(info, folder, f"{i:06d}")
            turned += info.turned
            exifs.append(info.exif)
        rgb = read_picture(folder / file)
        grey = grey_small(rgb)
        files.append(f"frames/{name}/{file}")
        sizes.append((rgb.shape[1], rgb.shape[0]))
        sharp.append(sharpness(grey))
        levels.append(float(np.median(grey)))
    counts = {size: sizes.count(size) for size in dict.fromkeys(sizes)}
    size = max(counts, key=lambda s: counts[s])
    taken = {s for s, n in counts.items() if s == size or (role == "sweep" and n >= FEWEST_OF_A_SIZE)}
    alike = [i for i, s in enumerate(sizes) if s in taken]
    chosen = {alike[k] for k in sharpest_per_window([sharp[i] for i in alike], most or len(alike))}
    records = []
    for i, file in enumerate(files):
        used = i in chosen
        if not used:
            (out / file).unlink()
        records.append(FrameRecord(i, None, sharp[i], used, file if used else None, exifs[i]))
    notes = []
    if turned:
        notes.append(f"{turned} photos turned as their EXIF tag says")
    if len(taken) > 1:
        notes.append(f"photos of several sizes, a camera each: {_sizes(counts, taken)}")
    if len(taken) < len(counts):
        other = _sizes(counts, set(counts) - taken)
        notes.append(
            f"mixed sizes: {_sizes(counts, taken)} are used, {other} are not; one camera in one mode is expected"
        )
    if clipped:
        notes.append(f"{clipped} RAW photos have more than 1 % white pixels; lower the exposure")
    focals = [exif.focal_px for exif in exifs if exif is not None and exif.focal_px is not None]
    return CameraFrames(
        role=role,
        source=source,
        width=size[0],
        height=size[1],
        fps_mean=None,
        variable_rate=False,
        has_audio=False,
        exif_focal_px=float(np.median(focals)) if focals else None,
        rotation_deg=0,
        frames=tuple(records),
        level=float(np.median(levels)),
        notes=tuple(notes),
    )


def _row_bands(grey: UInt8[np.ndarray, "h w"], rotation_deg: int) -> Float[np.ndarray, " bands"]:
    """Mean level of bands of rows as the sensor reads them: before the picture was turned upright."""
    stored = np.ascontiguousarray(np.rot90(grey, -(rotation_deg // 90)).astype(np.float32))
    return cv2.resize(stored, (1, ROW_BANDS), interpolation=cv2.INTER_AREA)[:, 0].astype(np.float64)


def _sizes(counts: dict[tuple[int, int], int], which: set[tuple[int, int]]) -> str:
    return ", ".join(f"{n} of {w}x{h}" for (w, h), n in counts.items() if (w, h) in which)


def _nothing_used(path: Path, keep: Keep, time_s: Float[np.ndarray, " n"]) -> str:
    if not len(time_s):
        return f"{path}: none of its frames has a time; correct capture.timestamps"
    if keep.range_s is None:
        return f"{path}: no frame can be used; record the clip again"
    return (
        f"{path}: no frame between {keep.range_s[0]:.2f} and {keep.range_s[1]:.2f} s (it goes from "
        f"{time_s[0]:.2f} to {time_s[-1]:.2f} s); change capture.range_s"
    )


def _places(indices: list[int]) -> str:
    return ", ".join(map(str, indices[:LISTED])) + (" ..." if len(indices) > LISTED else "")
