"""What lies in a folder that a crew brought home: clips, folders of photos, sound, tables; and a look into each.

Nothing is written and nothing is decided here: roles are guessed by `pipelines/init/roles.py`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.ingest.empty_ends import EMPTY_LEVELS
from devrf.capture.orientation import Upright
from devrf.capture.photos.photo_folders import CARD_FOLDER, UNREAD_KINDS, list_pictures
from devrf.capture.photos.picture_files import PICTURE_SUFFIXES, natural_key
from devrf.capture.photos.raw import RAW_SUFFIXES
from devrf.capture.photos.upright_pictures import probe_picture, read_picture, shared_turns
from devrf.capture.projection import Projection, odd_ones, projection_of
from devrf.capture.system.doubles import doubles
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.file_names import CLIP_SUFFIXES
from devrf.capture.system.spread import spread
from devrf.capture.video.reader import probe_video
from devrf.capture.video.sampled import picture_times, read_runs, spread_starts

Picture = UInt8[np.ndarray, "height width 3"]
End = Literal["start", "end"]
ENDS: tuple[End, ...] = ("start", "end")  # of a clip

KINDS: dict[str, frozenset[str]] = {
    "clips": CLIP_SUFFIXES,
    "photos": frozenset(PICTURE_SUFFIXES) | frozenset(RAW_SUFFIXES),
    "sounds": frozenset(".wav .mp3 .m4a .aac .flac .ogg".split()),
    "tables": frozenset((".csv",)),
    "unreadable": frozenset(UNREAD_KINDS),
}
UNREAD_CLIPS = frozenset(".braw .r3d .crm .ari .arx .nev .360".split())  # RAW and 360° files of their makers
PREVIEWS = frozenset(".lrv .lrf .thm".split())  # small copies and still pictures that action cameras write
OURS = ("stamp.json", "ingest", "devrf.log")  # what marks a run folder
DEEPEST = 3  # folders in folders that are looked into
MOST_SIDE_PX = 1280  # of sampled pictures: boards and backgrounds are found at it, large clips stay in memory
BLACK_LEVEL = 10.0  # of 255: brighter than a lens cap, darker than a dim room
END_PICTURES = 4  # successive ones, at the start or the end of a clip, ...
AS_STORED = Upright()
LONGER_END = 24  # ... looked for among so many where some show nothing


@dataclass(frozen=True)
class Material:
    """The files of a folder by kind, in natural order.

    Attributes:
        clips, sounds, tables: Files.
        photos: Folder -> its photos.
        unreadable: Photos that need a conversion first.
        others: Files of no such kind.
    """

    clips: list[Path] = field(default_factory=list)
    photos: dict[Path, list[Path]] = field(default_factory=dict)
    sounds: list[Path] = field(default_factory=list)
    tables: list[Path] = field(default_factory=list)
    unreadable: list[Path] = field(default_factory=list)
    others: list[Path] = field(default_factory=list)


@dataclass(frozen=True)
class Footage:
    """A clip or a folder of photos, looked into.

    Attributes:
        path: The clip or the folder.
        is_clip: Whether it is a clip.
        width, height: Size of the upright pictures; of a folder the most frequent one.
        count: Pictures in it.
        has_audio: Whether a clip has a sound track.
        device: What EXIF says took the photos; empty where unknown.
        notes: What is unusual, one sentence each.
        times_s: Times of a clip's pictures [n].
        pictures: Some pictures, spread evenly, of one size, at most `MOST_SIDE_PX` [h, w, 3].
        projection: What is said of them, or seen, that no lens makes; None: nothing.
        upright, pixel_aspect: Of a clip, as of `VideoInfo`.
    """

    path: Path
    is_clip: bool
    width: int
    height: int
    count: int
    has_audio: bool
    device: str
    notes: tuple[str, ...]
    times_s: Float[np.ndarray, " n"]
    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]
    projection: Projection | None = None
    upright: Upright = AS_STORED
    pixel_aspect: float = 1.0

    @property
    def greys(self) -> list[UInt8[np.ndarray, "h w"]]:
        """The sampled pictures as grey levels."""
        return [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in self.pictures]

    @property
    def level(self) -> float:
        """Median brightness of the sampled pictures, of 255."""
        return float(np.median([np.median(picture) for picture in self.pictures])) if self.pictures else 0.0

    @property
    def black(self) -> bool:
        """Whether there is nothing to be seen."""
        return self.level < BLACK_LEVEL and all(np.quantile(p, 0.99) < 3 * BLACK_LEVEL for p in self.pictures)

    @property
    def duration_s(self) -> float:
        """From a clip's first picture to its last; 0 for photos."""
        return float(self.times_s[-1] - self.times_s[0]) if len(self.times_s) else 0.0


def find_material(folder: Path, deeper: int = DEEPEST) -> Material:
    """Files of a folder and of the folders in it; run folders and hidden ones are left out."""
    material = Material()
    if any((folder / name).exists() for name in OURS):
        return material
    entries = (e for e in folder.iterdir() if not e.name.startswith("."))
    for entry in sorted(entries, key=lambda e: (natural_key(e.name), e.name)):
        if entry.is_dir():
            inner = find_material(entry, deeper - 1) if deeper > 0 else Material()
            material.photos.update(inner.photos)
            for kind in ("clips", "sounds", "tables", "unreadable", "others"):
                getattr(material, kind).extend(getattr(inner, kind))
            continue
        kind = next((k for k, suffixes in KINDS.items() if entry.suffix.lower() in suffixes), "others")
        if kind == "photos":
            material.photos.setdefault(folder, []).append(entry)
        else:
            getattr(material, kind).append(entry)
    _join_card(folder, material)
    return material


def _join_card(folder: Path, material: Material) -> None:
    """Take the folders of a card (DCIM/100CANON, DCIM/101CANON) as the one folder of photos that they are."""
    parts = [p for p in material.photos if p.parent == folder and CARD_FOLDER.fullmatch(p.name)]
    if len(parts) > 1 and folder not in material.photos:
        material.photos[folder] = [photo for part in parts for photo in material.photos.pop(part)]


def look_at(path: Path, count: int) -> Footage:
    """Read at most `count` pictures, spread over a clip or over a folder of photos.

    Raises:
        DevrfError: It is not a video, nothing of it decodes, or a photo cannot be read.
    """
    return _look_at_photos(path, count) if path.is_dir() else _look_at_clip(path, count)


def _look_at_clip(path: Path, count: int) -> Footage:
    info, times = probe_video(path), picture_times(path)
    runs = read_runs(path, times, spread_starts(times, count))
    pictures = tuple(small(run[0].rgb) for run in runs if run)
    if not pictures:
        text = f"{path}: none of its pictures decodes at {len(times)} times; record or copy it again"
        raise CaptureError("video-unreadable", text)
    size, kind = (info.width, info.height), projection_of([info.projection], pictures)
    shown = (times, pictures, kind, info.upright, info.pixel_aspect)
    return Footage(path, True, *size, len(times), info.has_audio, "", info.notes, *shown)


def _look_at_photos(folder: Path, count: int) -> Footage:
    photos = list_pictures(folder)
    chosen = spread(photos, count)
    headers = [probe_picture(photo) for photo in chosen]
    stitched = odd_ones([header.projection for header in headers])
    chosen = [photo for n, photo in enumerate(chosen) if n not in stitched]
    headers = [header for n, header in enumerate(headers) if n not in stitched]
    turns = shared_turns(headers)
    read = [_size_and_small(photo, turn) for photo, turn in zip(chosen, turns, strict=True)]
    sizes = [own for own, _ in read]
    size = max(dict.fromkeys(sizes), key=sizes.count)
    pictures = tuple(picture for own, picture in read if own == size)
    notes = (f"photos of {len(set(sizes))} sizes",) if len(set(sizes)) > 1 else ()
    copies = doubles(photos)
    notes += (f"{len(copies)} of them are copies of others",) if copies else ()
    exif, kind = headers[0].exif, projection_of([header.projection for header in headers], pictures)
    device = "" if exif is None else exif.device
    return Footage(folder, False, *size, len(photos), False, device, notes, np.zeros(0), pictures, kind)


def _size_and_small(photo: Path, upright: Upright) -> tuple[tuple[int, int], Picture]:
    """A photo's width and height, and itself made small: one large photo is in memory at a time."""
    picture = read_picture(photo, upright)[:, :, :3]
    return (picture.shape[1], picture.shape[0]), small(picture)


def pictures_at(look: Footage, end: End) -> list[Picture]:
    """Successive pictures of a clip at its start or its end, where they show something; fewer where it is damaged."""
    for length in (END_PICTURES, LONGER_END):
        starts = spread_starts(look.times_s, 2, length)
        at = starts[0] if end == "start" else starts[-1]
        run = [small(f.rgb) for f in next(read_runs(look.path, look.times_s, [at], length))]
        shown = [picture for picture in run if picture.std() > EMPTY_LEVELS]
        if len(shown) == len(run):
            return run
    return shown[:END_PICTURES] if end == "start" else shown[-END_PICTURES:]


def small(
    picture: UInt8[np.ndarray, "height width *c"], side_px: int = MOST_SIDE_PX
) -> UInt8[np.ndarray, "h w *c"]:
    """The picture with a longer side of at most so many pixels, area-averaged."""
    scale = side_px / max(picture.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(picture)
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
