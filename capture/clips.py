"""From one raw clip or folder of photos to frames on disk, in a single pass that holds a few pictures at most.

Along the way each frame is measured: sharpness, brightness, how much differs from the frame before (the motion
energy by which silent cameras are put on one clock), and how bright each band of rows is (flashes of light).
Pictures are written beside the decoding (`picture_writer.py`); what is measured needs luma only.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.clip_faults import (
    LOOK_EVERY_S,
    Levels,
    Repeats,
    Tripod,
    bit_rate_fault,
    places,
    repeats_fault,
)
from devrf.capture.errors import CaptureError
from devrf.capture.exif import Exif
from devrf.capture.frames import (
    SHARPNESS_SIDE_PX,
    CameraFrames,
    Fault,
    FrameRecord,
    Role,
    grey_small,
    sharpest_per_window,
    sharpness,
    shrunk,
    timing,
    window_of,
)
from devrf.capture.light import SMALL_SIDE_PX, LightCourse, LightMeter, clipped_share, highlight_faults
from devrf.capture.packets import scan_packets
from devrf.capture.picture_writer import SUFFIX, PictureWriter
from devrf.capture.pictures import copy_upright, list_pictures, numbering, probe_picture, read_picture
from devrf.capture.progress import Progress, no_progress
from devrf.capture.raw import is_raw
from devrf.capture.raw_set import RAW_DEFAULTS, RawOptions, develop_set
from devrf.capture.session import FrameTimes
from devrf.capture.video import VideoFrame, VideoInfo, VideoReader

MOTION_SIDE_PX = 160  # averages sensor noise away; a moving hand still covers several pixels
ROW_BANDS = 24  # a flash is placed to a twenty-fourth of the readout, about a millisecond
FEWEST_OF_A_SIZE = 5  # photos of a sweep; fewer leave their focal length to chance
FIXED: tuple[Role, ...] = ("camera", "test", "joint")  # roles of cameras on a tripod


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
        motion: Motion energy: time between two frames, mean absolute difference [n, 2].
        brightness: Time of a frame, mean level of each band of rows in the sensor's order [n, 1 + bands].
        light: The light of a fixed camera's clip; None for others.
    """

    frames: CameraFrames
    motion: Float[np.ndarray, "n 2"]
    brightness: Float[np.ndarray, "m bands"]
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
    seen = _Seen(role)
    records: dict[int, FrameRecord] = {}
    unused = _Unused()
    best: tuple[int, FrameRecord, VideoFrame] | None = None  # of the current window

    with VideoReader(path, None if span is None else span[0]) as reader, PictureWriter() as writer:

        def write_best() -> None:
            if best is not None:
                _, record, frame = best
                file = f"frames/{name}/{record.index:06d}{SUFFIX}"
                writer.put(out / file, frame)
                records[record.index] = replace(record, used=True, file=file)

        for frame in reader:
            if span is not None and frame.time_s > span[1]:
                break
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
    repeated = seen.repeats.frames()
    for index in repeated:
        file = records[index].file
        if file is not None:
            (out / file).unlink()
            records[index] = replace(records[index], used=False, file=None)
    timed = np.array(seen.times_s)
    if not any(record.used for record in records.values()):
        raise CaptureError(_nothing_used(path, keep, timed, reader.info))
    info, told = reader.info, timing(timed)
    notes = [*info.notes, *told.notes, *unused.notes(len(records))]
    if true_time is not None and max(true_time) >= count:
        notes.append(f"the table of times names frame {max(true_time)}, the clip has {count}")
    faults = [*unused.faults(), *seen.faults(), *bit_rate_fault(info, packets.count, packets.size_bytes)]
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
        rotation_deg=info.rotation_deg,
        frames=tuple(records[index] for index in sorted(records)),
        level=float(np.median(seen.levels)),
        missing_frames=told.missing_frames,
        ended_early=reader.ended_early,
        announced_frames=info.announced_frames,
        notes=tuple(notes),
        faults=tuple(faults),
    )
    return Extract(
        frames,
        np.array(seen.motion).reshape(-1, 2),
        np.array(seen.brightness).reshape(-1, 1 + ROW_BANDS),
        None if seen.light is None else seen.light.course(),
    )


class _Seen:
    """What the frames that have a time show, one after the other."""

    def __init__(self, role: Role) -> None:
        self.times_s: list[float] = []
        self.levels: list[float] = []
        self.motion: list[tuple[float, float]] = []
        self.brightness: list[np.ndarray] = []
        self.light = LightMeter() if role in ("camera", "test") else None
        self._role = role
        self._clipped: list[float] = []
        self.repeats = Repeats()
        self._range = Levels()
        self._tripod = Tripod() if role in FIXED else None
        self._last: tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h2 w2"]] | None = None
        self._look_at_s = -np.inf

    def add(self, frame: VideoFrame, time_s: float, grey: UInt8[np.ndarray, "h w"]) -> None:
        small = shrunk(grey, MOTION_SIDE_PX)
        self.levels.append(float(np.median(small)))
        if self._last is not None:
            last_grey, last_small = self._last
            self.repeats.add(frame.index, cv2.absdiff(grey, last_grey))
            difference = float(cv2.mean(cv2.absdiff(small, last_small))[0])
            self.motion.append(((time_s + self.times_s[-1]) / 2, difference))
        self.brightness.append(np.concatenate([[time_s], _row_bands(grey)]))
        if self.light is not None:
            self.light.add(frame.index, time_s, frame.stored_rgb(SMALL_SIDE_PX))
        self.times_s.append(time_s)
        self._last = (grey, small)
        if time_s >= self._look_at_s:
            self._look_at_s = time_s + LOOK_EVERY_S
            self._range.add(frame.picture)
            if self._role in ("sweep", "camera", "test"):  # a board is white paper
                self._clipped.append(clipped_share(frame.stored_rgb(SMALL_SIDE_PX)))
            if self._tripod is not None:
                self._tripod.add(frame, time_s)

    def faults(self) -> list[Fault]:
        found = [*self._range.faults(), *highlight_faults(self._clipped)]
        return [*found, *(self._tripod.faults() if self._tripod else ())]


class _Unused:
    """Frames that cannot be used: damaged, of another size, without a time, or not after the one before."""

    def __init__(self) -> None:
        self._damaged: list[tuple[int, float]] = []
        self._tainted = False  # damage stays in the pictures up to the next key picture
        self._resized: list[tuple[int, float, tuple[int, int]]] = []
        self._size = (0, 0)
        self._backwards: list[int] = []
        self._untimed = 0
        self._last_s = -np.inf

    def picture(self, frame: VideoFrame, time_s: float | None, info: VideoInfo) -> bool:
        """Whether this frame's picture cannot be used."""
        self._size = (info.width, info.height)
        place = (frame.index, frame.time_s if time_s is None else time_s)
        if frame.size != self._size:
            self._resized.append((*place, frame.size))
        elif frame.damaged or (self._tainted and not frame.picture.key_frame):
            self._tainted = True
            self._damaged.append(place)
        else:
            self._tainted = False
            return False
        return True

    def time(self, index: int, time_s: float | None) -> bool:
        """Whether this frame's time cannot be used."""
        if time_s is None:
            self._untimed += 1
        elif time_s <= self._last_s:
            self._backwards.append(index)
        else:
            self._last_s = time_s
            return False
        return True

    def notes(self, count: int) -> list[str]:
        notes = []
        if self._backwards:
            back = self._backwards
            notes.append(f"{len(back)} timestamps do not increase, frames {places(back)}; not used")
        if self._untimed:
            notes.append(f"{self._untimed} of {count} frames have no row in the table of times; not used")
        return notes

    def faults(self) -> list[Fault]:
        found = []
        if self._damaged:
            index, time_s = self._damaged[0]
            found.append(
                Fault(
                    "damaged frames",
                    f"{len(self._damaged)} frames are damaged, the first is {index} at {time_s:.2f} s; not used",
                    "Copy the clip from the camera again; use a faster or newer card.",
                )
            )
        if self._resized:
            index, time_s, (width, height) = self._resized[0]
            found.append(
                Fault(
                    "size of the pictures",
                    f"{len(self._resized)} frames from {index} at {time_s:.2f} s on are {width}x{height}, the first "
                    f"ones {self._size[0]}x{self._size[1]}; not used",
                    "Keep one camera in one mode for a whole clip; cut the clip where its size changes.",
                )
            )
        return found


def extract_folder(
    path: Path,
    out: Path,
    name: str,
    role: Role,
    source: str,
    most: int | None = None,
    raw: RawOptions = RAW_DEFAULTS,
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
    raws = [(i, picture) for i, picture in enumerate(pictures) if is_raw(picture)]
    developed = develop_set(raws, out, name, raw, progress) if raws else {}
    files: list[str] = []
    sizes: list[tuple[int, int]] = []
    sharp: list[float] = []
    levels: list[float] = []
    exifs: list[Exif | None] = []
    clipped: list[float] = []
    turned = 0
    for i, picture in enumerate(pictures):
        progress(i / len(pictures), f"{name}: {i + 1} of {len(pictures)} photos")
        if i in developed:
            photo = developed[i]
            file, size, grey = photo.file, (photo.width, photo.height), photo.grey
            exifs.append(None)
        else:
            info = probe_picture(picture)
            file = f"frames/{name}/{copy_upright(info, folder, f'{i:06d}')}"
            turned += info.turned
            exifs.append(info.exif)
            rgb = read_picture(out / file)
            size, grey = (rgb.shape[1], rgb.shape[0]), grey_small(rgb)
            clipped.append(clipped_share(rgb[:, :, :3]))
        files.append(file)
        sizes.append(size)
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
            linear = developed[i].linear if i in developed else None
            if linear is not None:
                (out / linear).unlink()
        records.append(FrameRecord(i, None, sharp[i], used, file if used else None, exifs[i]))
    notes = numbering(pictures)
    if turned:
        notes.append(f"{turned} photos turned as their EXIF tag says")
    if len(taken) > 1:
        notes.append(f"photos of several sizes, a camera each: {_sizes(counts, taken)}")
    if len(taken) < len(counts):
        other = _sizes(counts, set(counts) - taken)
        notes.append(
            f"mixed sizes: {_sizes(counts, taken)} are used, {other} are not; one camera in one mode is expected"
        )
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
        faults=tuple(highlight_faults(clipped) if role == "sweep" else ()),  # a board is white paper
    )


def _row_bands(grey: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, " bands"]:
    """Mean level of bands of rows, in the order the sensor reads them."""
    rows = cv2.reduce(grey, 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)
    return cv2.resize(rows, (1, ROW_BANDS), interpolation=cv2.INTER_AREA)[:, 0].astype(np.float64)


def _sizes(counts: dict[tuple[int, int], int], which: set[tuple[int, int]]) -> str:
    return ", ".join(f"{n} of {w}x{h}" for (w, h), n in counts.items() if (w, h) in which)


def _nothing_used(path: Path, keep: Keep, time_s: Float[np.ndarray, " n"], info: VideoInfo) -> str:
    if keep.range_s is None:
        if len(time_s):
            return f"{path}: no frame can be used; record the clip again"
        return f"{path}: none of its frames has a time; correct capture.timestamps"
    from_s, to_s = keep.range_s
    if len(time_s):
        there = f"it goes from {time_s[0]:.2f} to {time_s[-1]:.2f} s"
    else:
        there = "its length is unknown" if info.duration_s is None else f"it is {info.duration_s:.2f} s long"
    return f"{path}: no frame between {from_s:.2f} and {to_s:.2f} s ({there}); change capture.range_s"
