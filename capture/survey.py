"""What lies in a folder that a crew brought home: clips, folders of photos, sound, tables; and a look into each.

Nothing is written and nothing is decided here: roles are guessed by `pipelines/init/roles.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.errors import CaptureError
from devrf.capture.picture_files import PICTURE_SUFFIXES, natural_key
from devrf.capture.pictures import UNREADABLE_SUFFIXES, list_pictures, probe_picture, read_picture
from devrf.capture.raw import RAW_SUFFIXES
from devrf.capture.recorded import read_recorded
from devrf.capture.sampled import picture_times, read_runs, spread_starts
from devrf.capture.stillness import moving_share, smooth_grey
from devrf.capture.video import VideoInfo, probe_video

Picture = UInt8[np.ndarray, "height width 3"]

VIDEO_SUFFIXES = frozenset(
    ".mp4 .mov .mkv .avi .m4v .mts .m2ts .ts .mxf .webm .mpg .mpeg .wmv .3gp .insv".split()
)
SOUND_SUFFIXES = frozenset(".wav .mp3 .m4a .aac .flac .ogg".split())
TABLE_SUFFIXES = frozenset((".csv",))
OURS = ("stamp.json", "ingest", "devrf.log")  # what marks a run folder
DEEPEST = 3  # folders in folders that are looked into
MOST_SIDE_PX = 1280  # of sampled pictures: boards and backgrounds are found at it, large clips stay in memory
BLACK_LEVEL = 10.0  # of 255: brighter than a lens cap, darker than a dim room


@dataclass(frozen=True)
class Material:
    """The files of a folder by kind, paths sorted; `photos` are folders.

    Attributes:
        clips, sounds, tables: Files.
        photos: Folder -> its photos.
        heic: Photos that need a conversion first.
        ignored: Names of other files.
    """

    clips: list[Path] = field(default_factory=list)
    photos: dict[Path, list[Path]] = field(default_factory=dict)
    sounds: list[Path] = field(default_factory=list)
    tables: list[Path] = field(default_factory=list)
    heic: list[Path] = field(default_factory=list)
    ignored: list[Path] = field(default_factory=list)


@dataclass(frozen=True)
class Look:
    """A clip or a folder of photos, looked into.

    Attributes:
        path: The clip or the folder.
        is_clip: Whether it is a clip.
        width, height: Size of the upright pictures; of a folder the most frequent one.
        count: Pictures in it.
        duration_s, fps: Of a clip; None for photos.
        has_audio: Whether a clip has a sound track.
        device: What EXIF says took the photos; empty where unknown.
        created_s: When the clip says it was made, seconds since 1970 UTC.
        notes: What is unusual, one sentence each.
        times_s: Times of a clip's pictures [n].
        pictures: Some pictures, spread evenly, of one size, at most `MOST_SIDE_PX` [h, w, 3].
        level: Median brightness of them.
    """

    path: Path
    is_clip: bool
    width: int
    height: int
    count: int
    duration_s: float | None
    fps: float | None
    has_audio: bool
    device: str
    created_s: float | None
    notes: tuple[str, ...]
    times_s: Float[np.ndarray, " n"]
    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]
    level: float

    @property
    def greys(self) -> list[UInt8[np.ndarray, "h w"]]:
        """The sampled pictures as grey levels."""
        return [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in self.pictures]

    @property
    def black(self) -> bool:
        """Whether there is nothing to be seen."""
        return self.level < BLACK_LEVEL and all(np.quantile(p, 0.99) < 3 * BLACK_LEVEL for p in self.pictures)


def find_material(folder: Path) -> Material:
    """Files of a folder and of the folders in it; run folders and hidden ones are left out."""
    material = Material()
    _collect(folder, material, DEEPEST)
    return material


def _collect(folder: Path, material: Material, deeper: int) -> None:
    if any((folder / name).exists() for name in OURS):
        return
    entries = sorted(
        (e for e in folder.iterdir() if not e.name.startswith(".")),
        key=lambda e: (natural_key(e.name), e.name),
    )
    photos = []
    for entry in entries:
        suffix = entry.suffix.lower()
        if entry.is_dir():
            if deeper > 0:
                _collect(entry, material, deeper - 1)
        elif suffix in VIDEO_SUFFIXES:
            material.clips.append(entry)
        elif suffix in PICTURE_SUFFIXES or suffix in RAW_SUFFIXES:
            photos.append(entry)
        elif suffix in SOUND_SUFFIXES:
            material.sounds.append(entry)
        elif suffix in TABLE_SUFFIXES:
            material.tables.append(entry)
        elif suffix in UNREADABLE_SUFFIXES:
            material.heic.append(entry)
        else:
            material.ignored.append(entry)
    if photos:
        material.photos[folder] = photos


def look_at(path: Path, count: int) -> Look:
    """`look_at_photos` of a folder, `look_at_clip` of a file."""
    return look_at_photos(path, count) if path.is_dir() else look_at_clip(path, count)


def look_at_clip(path: Path, count: int) -> Look:
    """Decode at most `count` pictures, spread over a clip.

    Raises:
        DevrfError: It is not a video, or nothing of it decodes.
    """
    info: VideoInfo = probe_video(path)
    times = picture_times(path)
    runs = read_runs(path, times, spread_starts(times, count))
    pictures = [small(run[0].rgb) for run in runs if run]
    if not pictures:
        raise CaptureError(
            f"{path}: none of its pictures decodes at {len(times)} times; record or copy it again"
        )
    duration = float(times[-1] - times[0])
    return Look(
        path,
        True,
        info.width,
        info.height,
        len(times),
        duration,
        (len(times) - 1) / duration if duration > 0 else info.fps,
        info.has_audio,
        "",
        read_recorded(path).created_s,
        info.notes,
        times,
        tuple(pictures),
        _level(pictures),
    )


def look_at_photos(folder: Path, count: int) -> Look:
    """Read at most `count` photos, spread over a folder.

    Raises:
        DevrfError: One of them cannot be read.
    """
    photos = list_pictures(folder)
    chosen = [photos[i] for i in np.unique(np.linspace(0, len(photos) - 1, count).round().astype(int))]
    read = [read_picture(photo)[:, :, :3] for photo in chosen]
    sizes = [(picture.shape[1], picture.shape[0]) for picture in read]
    width, height = max(dict.fromkeys(sizes), key=sizes.count)
    pictures = [small(picture) for picture, size in zip(read, sizes, strict=True) if size == (width, height)]
    notes = [f"photos of {len(set(sizes))} sizes"] if len(set(sizes)) > 1 else []
    exif = probe_picture(chosen[0]).exif if chosen[0].suffix.lower() not in RAW_SUFFIXES else None
    device = "" if exif is None else exif.device
    none = np.zeros(0)
    return Look(
        folder,
        False,
        width,
        height,
        len(photos),
        None,
        None,
        False,
        device,
        None,
        tuple(notes),
        none,
        tuple(pictures),
        _level(pictures),
    )


def small(picture: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with a longer side of at most `MOST_SIDE_PX`, area-averaged."""
    scale = MOST_SIDE_PX / max(picture.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(picture)
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _level(pictures: Sequence[UInt8[np.ndarray, "h w 3"]]) -> float:
    return float(np.median([np.median(picture) for picture in pictures])) if pictures else 0.0


def still_ends(look: Look, length: int = 4) -> tuple[float | None, float | None]:
    """Largest share of the picture that changes between successive pictures at the start and at the end of a clip."""
    starts = spread_starts(look.times_s, 2, length)
    runs = list(read_runs(look.path, look.times_s, starts, length))
    shares = [moving_share([smooth_grey(frame.rgb) for frame in run]) for run in runs]
    return shares[0], shares[-1]
