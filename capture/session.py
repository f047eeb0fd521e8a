"""Which raw file is what: one capture session, and everything that is wrong with its files.

A session is a sweep of the scene at rest, clips of fixed cameras while it moves, or both; with optional
clips of a calibration board and an optional table of true frame times.
"""

import csv
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.errors import DevrfError, InputError
from devrf.capture.limits import CLIP_S, TEXT_BYTES, check_bytes
from devrf.capture.media import check_file
from devrf.capture.pictures import is_photo, list_pictures, probe_picture
from devrf.capture.raw import WhiteBalance
from devrf.capture.sampled import picture_times
from devrf.capture.scene import Rest
from devrf.capture.video import VideoInfo, probe_video

TIMESTAMP_COLUMNS = ("camera", "frame_index", "time_s")
MOST_FRAMES = 2**31  # of a clip; indices are whole numbers of 64 bits
MIN_SWEEP_FRAMES = 2  # structure from motion needs two; how many are enough is for its own health check


def _no_files() -> Mapping[str, Path]:
    return MappingProxyType({})


@dataclass(frozen=True)
class CaptureSession:
    """The raw files of one capture; paths are absolute or relative to the working folder.

    Attributes:
        static: The sweep: a video, or a folder of photos or RAW files; None without one.
        cameras: Name -> clip of every fixed camera, test cameras too; the first one's clock is the session's.
        test_names: Names of the cameras that are never trained on.
        timestamps: CSV with camera, frame_index, time_s, or None.
        board_clips: Name -> clip or folder of photos of the board before this camera alone.
        joint_clips: Name -> clip of the board before several cameras at once; may be the moving clip itself.
        white: Name, or "static" for the sweep's camera -> clip, photo or folder of photos of a white sheet.
        white_balance: Multipliers for R, G, B, second G of all RAW photos; None: daylight of each folder's sensor.
        range_s: (from, to) on the first camera's clock, or None for all.
        rest: When the moving clips show the scene as in the sweep.
    """

    static: Path | None = None
    cameras: Mapping[str, Path] = field(default_factory=_no_files)
    test_names: tuple[str, ...] = ()
    timestamps: Path | None = None
    board_clips: Mapping[str, Path] = field(default_factory=_no_files)
    joint_clips: Mapping[str, Path] = field(default_factory=_no_files)
    white: Mapping[str, Path] = field(default_factory=_no_files)
    white_balance: WhiteBalance | None = None
    range_s: tuple[float, float] | None = None
    rest: Rest = "auto"

    def shares_joint_clip(self, camera: str) -> bool:
        """Whether this camera's joint board clip is its moving clip."""
        joint, moving = self.joint_clips.get(camera), self.cameras.get(camera)
        return joint is not None and moving is not None and joint.resolve() == moving.resolve()

    def files(self) -> list[Path]:
        """Every raw file, photos of folders one by one, in a fixed order."""
        out: list[Path] = []
        for path in (self.static, *self.cameras.values(), *self.board_clips.values(), *self.white.values()):
            if path is not None:
                out.extend(list_pictures(path) if path.is_dir() else [path])
        out.extend(self.joint_clips.values())
        if self.timestamps is not None:
            out.append(self.timestamps)
        return list(dict.fromkeys(out))


@dataclass(frozen=True)
class FrameTimes:
    """True times of one camera's frames: `time_s` [n] belongs to frame `index` [n] of its clip."""

    index: Int[np.ndarray, " n"]
    time_s: Float[np.ndarray, " n"]


def preflight(session: CaptureSession) -> list[str]:
    """Everything that is wrong with the raw files, each with file and remedy; empty when all is well."""
    problems: list[str] = []

    def attempt(check: Callable[[], object], key: str) -> None:
        try:
            check()
        except DevrfError as error:
            problems.append(f"{key}: {error}")

    if session.static is None and not session.cameras:
        problems.append("capture: neither static nor cameras; name at least one")
    if session.static is not None:
        sweep = session.static
        attempt(lambda: _check_sweep(sweep), "capture.static")
    clips: dict[str, VideoInfo] = {}
    for name, path in session.cameras.items():
        attempt(
            lambda name=name, path=path: clips.update({name: probe_video(path)}), f"capture camera {name}"
        )
    for name, path in session.board_clips.items():
        attempt(lambda path=path: _check_clip_or_folder(path), f"capture.board.clips.{name}")
    for name, path in session.joint_clips.items():
        if not session.shares_joint_clip(name):
            attempt(lambda path=path: probe_video(path), f"capture.board.joint_clips.{name}")
    for name, path in session.white.items():
        attempt(lambda path=path: _check_white(path), f"capture.white.{name}")
    if session.timestamps is not None:
        table = session.timestamps
        times: dict[str, FrameTimes] = {}
        attempt(lambda: times.update(read_timestamps(table, session.cameras)), "capture.timestamps")
        for name in clips.keys() & times.keys():
            attempt(
                lambda name=name: _check_indices(table, name, times[name], clips[name]), "capture.timestamps"
            )
        problems += _outside_range(times, session.range_s, "times in capture.timestamps go")
    elif session.cameras and session.range_s is not None and not problems:
        first = next(iter(session.cameras))
        attempt(
            lambda: problems.extend(_outside_clip(first, clips[first], session.range_s)),
            f"capture camera {first}",
        )
    problems += _same_file_twice(session.cameras)
    return problems


def read_timestamps(path: Path, cameras: Iterable[str]) -> dict[str, FrameTimes]:
    """Read a table of true frame times.

    Args:
        path: CSV with a header and at least the columns camera, frame_index (from 0), time_s (one clock).
        cameras: Names that must be in it.
    Returns:
        Camera name -> times, sorted by frame index.
    Raises:
        InputError: Naming the row or the camera, and what was expected.
        CaptureError: The file is larger than any table.
    """
    check_file(path)
    check_bytes(path, TEXT_BYTES)
    rows: dict[str, dict[int, float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = tuple(reader.fieldnames or ())
            missing = [c for c in TIMESTAMP_COLUMNS if c not in columns]
            if missing:
                wrong = f"{path}: no column {', '.join(missing)} (it has: {', '.join(columns) or 'nothing'})"
                raise InputError("entry-missing", f"{wrong}; expected {', '.join(TIMESTAMP_COLUMNS)}")
            for row in reader:
                name, index, time_s = _times_row(row, f"{path}: line {reader.line_num}")
                if index in rows.setdefault(name, {}):
                    text = f"{path}: line {reader.line_num}: frame {index} of camera {name} is given twice"
                    raise InputError("entry-twice", text)
                rows[name][index] = time_s
    except UnicodeDecodeError as error:
        wrong = f"{path}: not UTF-8 text ({error.reason} at byte {error.start}); expected a CSV text file"
        raise InputError("encoding-wrong", f"{wrong}; save it as UTF-8 (UTF-16 is not read)") from None
    except csv.Error as error:
        raise InputError("file-damaged", f"{path}: not a CSV text file ({error})") from None
    names = list(cameras)
    absent = [name for name in names if name not in rows]
    if absent:
        wrong = f"{path}: no rows for camera {', '.join(absent)} (it has: {', '.join(rows) or 'no rows'})"
        raise InputError("camera-missing", f"{wrong}; use the names of capture.cameras")
    out = {}
    for name in names:
        index = np.array(sorted(rows[name]))
        time_s = np.array([rows[name][i] for i in index.tolist()])
        back = np.flatnonzero(time_s[1:] <= time_s[:-1])
        if len(back):
            i = int(back[0])
            a, b = (f"frame {index[n]} ({time_s[n]:.6f} s)" for n in (i, i + 1))
            text = f"{path}: camera {name}: time does not increase from {a} to {b}; correct the table"
            raise InputError("times-not-rising", text)
        _check_table_span(path, name, index, time_s)
        out[name] = FrameTimes(index, time_s)
    return out


def _check_table_span(
    path: Path, name: str, index: Int[np.ndarray, " n"], time_s: Float[np.ndarray, " n"]
) -> None:
    """Refuse times of a camera that lie further apart than any recording is long: a wrong row, or another unit."""
    span_s = float(time_s[-1]) - float(time_s[0])  # not in numpy, which warns where it is infinite
    if span_s > CLIP_S:
        i = int(np.argmax(np.diff(time_s / 2)))  # halves, whose differences are finite
        a, b = (f"frame {index[n]} ({time_s[n]:.6g} s)" for n in (i, i + 1))
        wrong = f"{path}: camera {name}: its times are {span_s:.6g} s apart, most of it from {a} to {b}"
        remedy = f"at most {CLIP_S} s are read: correct these rows, or the unit, which is seconds"
        raise InputError("times-too-far", f"{wrong}; {remedy}")


def _check_indices(path: Path, name: str, times: FrameTimes, clip: VideoInfo) -> None:
    """Refuse a table none of whose frames a clip has; that it has some more, or fewer, is usual."""
    first = int(times.index[0])
    if clip.announced_frames is not None and first < clip.announced_frames:
        return
    count = len(picture_times(clip.path))
    if first >= count:
        wrong = (
            f"{path}: camera {name}: its first frame has index {first}, and {clip.path} has {count} frames"
        )
        raise InputError("frames-not-in-clip", f"{wrong}; count frame_index from 0 in each clip")


def _times_row(row: dict[str, str], where: str) -> tuple[str, int, float]:
    try:
        index, time_s = int(row["frame_index"]), float(row["time_s"])
    except (TypeError, ValueError):
        wrong = f"{where}: frame_index {row['frame_index']!r}, time_s {row['time_s']!r}"
        raise InputError("entry-wrong", f"{wrong}; expected a whole number and seconds") from None
    if not 0 <= index < MOST_FRAMES or not np.isfinite(time_s):
        text = f"{where}: frame_index {index:g}, time_s {time_s}; expected 0 or more, and finite"
        raise InputError("entry-wrong", text)
    return (row["camera"] or "").strip(), index, time_s


def _check_sweep(path: Path) -> None:
    if not path.exists():
        raise InputError("file-missing", f"{path}: no such file or folder; check the path in scene.yaml")
    if not path.is_dir():
        probe_video(path)
        return
    pictures = _check_folder(path)
    if len(pictures) < MIN_SWEEP_FRAMES:
        text = f"{path}: {len(pictures)} picture; a sweep needs many views of the scene, at least 20"
        raise InputError("sweep-too-short", text)


def _check_clip_or_folder(path: Path) -> None:
    if path.is_dir():
        _check_folder(path)
    else:
        probe_video(path)


def _check_white(path: Path) -> None:
    if path.is_file() and is_photo(path):
        probe_picture(path)
    else:
        _check_clip_or_folder(path)


def _check_folder(path: Path) -> list[Path]:
    pictures = list_pictures(path)
    broken = []
    for picture in pictures:
        try:
            check_file(picture)
            probe_picture(picture)
        except DevrfError as error:
            broken.append(error)
    if broken:
        more = f" (and {len(broken) - 1} more)" if len(broken) > 1 else ""
        raise InputError(broken[0].code, f"{broken[0]}{more}")
    return pictures


def _outside_clip(first: str, clip: VideoInfo, range_s: tuple[float, float] | None) -> list[str]:
    """Whether the first camera's clip, whose clock is the session's, has nothing in the range."""
    if range_s is None or clip.duration_s is None or (range_s[0] <= clip.duration_s and range_s[1] >= 0):
        return []
    time_s = picture_times(clip.path)  # an announced duration is not always true
    return _outside_range({first: FrameTimes(np.arange(len(time_s)), time_s)}, range_s, "clip goes")


def _outside_range(
    times: Mapping[str, FrameTimes], range_s: tuple[float, float] | None, source: str
) -> list[str]:
    """Cameras of which the range leaves nothing; `source` goes from the first to the last of their times."""
    if range_s is None:
        return []
    from_s, to_s = range_s
    return [
        f"capture.range_s: [{from_s:g}, {to_s:g}]: camera {name} has no frame in it, its {source} from "
        f"{t.time_s[0]:.2f} to {t.time_s[-1]:.2f} s; change the range"
        for name, t in times.items()
        if not ((t.time_s >= from_s) & (t.time_s <= to_s)).any()
    ]


def _same_file_twice(cameras: Mapping[str, Path]) -> list[str]:
    seen: dict[Path, str] = {}
    problems = []
    for name, path in cameras.items():
        first = seen.setdefault(path.resolve(), name)
        if first != name:
            problems.append(
                f"capture camera {name}: {path} is also the clip of camera {first}; expected its own"
            )
    return problems
