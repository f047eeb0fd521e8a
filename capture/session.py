"""Which raw file is what: one capture session, and everything that is wrong with its files.

A session is a sweep of the scene at rest, clips of fixed cameras while it moves, or both; with optional
clips of a calibration board and an optional table of true frame times.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from devrf.capture.photos.photo_folders import list_pictures
from devrf.capture.photos.raw import WhiteBalance, check_unpacks, is_raw
from devrf.capture.photos.raw_compression import compression_of
from devrf.capture.photos.upright_pictures import probe_picture
from devrf.capture.rest import Rest
from devrf.capture.system.doubles import doubles
from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.video.media import check_file
from devrf.capture.video.reader import VideoInfo, probe_video
from devrf.capture.video.sampled import picture_times
from devrf.capture.video.slow_motion import check_filmed_rate
from devrf.capture.video.timestamps import (
    FrameTimes,
    check_indices,
    check_table,
    read_timestamps,
    table_factor,
)

MIN_SWEEP_FRAMES = 2  # structure from motion needs two; how many are enough is for its own health check


def _no_files() -> Mapping[str, Path]:
    return MappingProxyType({})


@dataclass(frozen=True)
class CaptureSession:
    """The raw files of one capture; paths are absolute or relative to the working folder.

    Attributes:
        static: The sweep: a video, or a folder of photos or RAW files; None without one.
        cameras: Name -> clip of every fixed camera, test cameras last; the first one's clock is the session's.
        test_names: Names of the cameras that are never trained on.
        timestamps: CSV with camera, frame_index, time_s, or None.
        board_clips: Name -> clip or folder of photos of the board before this camera alone.
        joint_clips: Name -> clip of the board before several cameras at once; may be the moving clip itself.
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
        for path in (self.static, *self.cameras.values(), *self.board_clips.values()):
            if path is not None:
                out.extend(list_pictures(path) if path.is_dir() else [path])
        out.extend(self.joint_clips.values())
        if self.timestamps is not None:
            out.append(self.timestamps)
        return list(dict.fromkeys(out))


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

    def probe_camera(name: str, path: Path) -> None:
        clips[name] = probe_video(path)
        if session.timestamps is None:
            check_filmed_rate(path)

    for name, path in session.cameras.items():
        attempt(lambda name=name, path=path: probe_camera(name, path), f"capture camera {name}")
    for name, path in session.board_clips.items():
        attempt(lambda path=path: _check_clip_or_folder(path), f"capture.board.clips.{name}")
    for name, path in session.joint_clips.items():
        if not session.shares_joint_clip(name):
            attempt(lambda path=path: probe_video(path), f"capture.board.joint_clips.{name}")
    if session.timestamps is not None:
        table = session.timestamps
        times: dict[str, FrameTimes] = {}
        attempt(lambda: times.update(_checked_table(table, session.cameras, clips)), "capture.timestamps")
        problems += _outside_range(times, session.range_s, "times in capture.timestamps go")
    elif session.cameras and session.range_s is not None and not problems:
        first = next(iter(session.cameras))
        attempt(
            lambda: problems.extend(_outside_clip(first, clips[first], session.range_s)),
            f"capture camera {first}",
        )
    problems += _same_file_twice(session.cameras, session.test_names)
    return problems


def _checked_table(
    table: Path, cameras: Mapping[str, Path], clips: Mapping[str, VideoInfo]
) -> dict[str, FrameTimes]:
    """The times of a table that fits the clips, as far as these can be read."""
    times = read_timestamps(table, cameras)
    for name, own in times.items():
        clip_s: list[float] = []
        if name in clips:
            clip_s = picture_times(cameras[name]).tolist()
            check_indices(table, name, own, cameras[name], len(clip_s))
        check_table(table, name, own, table_factor(own, dict(enumerate(clip_s))))
    return times


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
    raws = [picture for picture in pictures if is_raw(picture)]
    for raw in {compression_of(raw): raw for raw in reversed(raws)}.values():  # the first of each kind
        check_unpacks(raw)
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


def _same_file_twice(cameras: Mapping[str, Path], tests: Sequence[str]) -> list[str]:
    """Cameras with the file of another one; a copy of it where one of the two is tested on, the other trained on."""
    names = [name for name, path in cameras.items() if path.is_file()]
    found = []
    for n, first in doubles([cameras[name] for name in names]).items():
        name, other = names[n], names[first]
        path = cameras[name]
        if path.resolve() == cameras[other].resolve() or (name in tests) != (other in tests):
            found.append(
                f"capture camera {name}: {path} is also the clip of camera {other}; expected its own"
            )
    return found
