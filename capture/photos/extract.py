"""From a folder of photos to upright pictures on disk, RAW photos developed."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.colour.light_course import clipped_share, highlight_faults
from devrf.capture.colour.photo_profile import PhotoSpace
from devrf.capture.exif import Exif
from devrf.capture.frames import (
    CameraFrames,
    FrameRecord,
    Role,
    grey_small,
    sharpest_per_window,
    sharpness,
    shrunk,
    some,
)
from devrf.capture.measure import Measure
from devrf.capture.orientation import Upright
from devrf.capture.photos.photo_folders import list_pictures, numbering, unread_faults
from devrf.capture.photos.raw import WhiteBalance, is_raw
from devrf.capture.photos.raw_set import develop_set
from devrf.capture.photos.upright_pictures import copy_upright, probe_picture, read_picture, shared_turns
from devrf.capture.projection import (
    ENOUGH,
    SIDE_PX,
    Picture,
    Projection,
    odd_ones,
    projection_faults,
    projection_of,
)
from devrf.capture.system.progress import Progress, no_progress

ONCE: tuple[Role, ...] = ("sweep", "board")  # of which the same picture twice tells nothing more
# Two photos are one picture where they differ by less, root mean square of levels at this size: copies coded anew
# differ by 0.6, neighbours of sweeps by 2.4 and more (two photos from one place: 1.0).
SAME_LEVEL, SAME_SIZE = 0.8, (64, 48)
SHOWS = 4.0  # standard deviation of levels: with less nothing is seen that could be told apart
FEWEST_OF_A_SIZE = 5  # photos of a sweep; fewer leave their focal length to chance

Size = tuple[int, int]


@dataclass(frozen=True)
class _Photo:
    """A photo as it was put into the ingest folder.

    Attributes:
        name: In its folder.
        file: Relative to the ingest folder.
        size: Width and height, upright, pixels.
        sharpness: As of frames.
        grey: Small, of one size for all, levels.
        level: Median brightness, 0 to 255.
        upright: How it was turned; own: what its tag asks for.
        exif: Its tags, or None.
        space: What its levels meant in the file, where that was not sRGB.
        clipped: Share at white; None of RAW photos, whose sidecar has it.
        small: The picture, small; of RAW photos None.
        projection: As of `PictureInfo`.
    """

    name: str
    file: str
    size: Size
    sharpness: float
    grey: UInt8[np.ndarray, "48 64"]
    level: float
    upright: Upright
    own: Upright
    exif: Exif | None = None
    space: PhotoSpace | None = None
    clipped: float | None = None
    small: Picture | None = None
    projection: Projection | None = None


def extract_folder(
    path: Path,
    out: Path,
    name: str,
    role: Role,
    source: str,
    most: int | None = None,
    white_balance: WhiteBalance | None = None,
    progress: Progress = no_progress,
    workers: int | None = None,
) -> CameraFrames:
    """Put a folder of photos upright into `out/frames/<name>`; see `clips.extract_clip` for the arguments.

    A picture that is there twice is used once. Photos of one camera are turned alike, as most of them ask for. Those of
    another size than most are not used, because one set of intrinsics must fit all; in a sweep, a size of which there
    are enough photos to fix its intrinsics is a camera of its own.

    Raises:
        InputError: If the folder or a photo cannot be read.
        CaptureError: If a photo's content is damaged.
    """
    (out / "frames" / name).mkdir(parents=True, exist_ok=True)
    pictures = list_pictures(path)
    photos = list(_put(pictures, out, name, white_balance, progress, workers))
    copies = _copies(photos) if role in ONCE else {}
    stitched = odd_ones([photo.projection for photo in photos])
    left = {i: photo for i, photo in enumerate(photos) if i not in copies and i not in stitched}
    counts = Counter(photo.size for photo in left.values())
    size = counts.most_common(1)[0][0]
    taken = {s for s, n in counts.items() if s == size or (role == "sweep" and n >= FEWEST_OF_A_SIZE)}
    alike = [i for i, photo in left.items() if photo.size in taken]
    chosen = {alike[k] for k in sharpest_per_window([photos[i].sharpness for i in alike], most or len(alike))}
    records = []
    for i, photo in enumerate(photos):
        used = i in chosen
        if not used:
            (out / photo.file).unlink()
        kept = photo.file if used else None
        turns = (photo.upright.orientation, photo.own.orientation)
        records.append(FrameRecord(i, None, photo.sharpness, used, kept, photo.exif, photo.name, *turns))
    focals = [p.exif.focal_px for p in photos if p.exif is not None and p.exif.focal_px is not None]
    main = [photo for photo in left.values() if photo.size == size]
    kind = projection_of(
        (p.projection for p in main), [p.small for p in main if p.small is not None][:ENOUGH]
    )
    faults = [*projection_faults(kind), *unread_faults(path), *_space_faults(photos)]
    if role == "sweep":  # a board is white paper
        faults += highlight_faults([photo.clipped for photo in photos if photo.clipped is not None])
    return CameraFrames(
        role=role,
        source=source,
        width=size[0],
        height=size[1],
        fps_mean=None,
        variable_rate=False,
        has_audio=False,
        exif_focal_px=float(np.median(focals)) if focals else None,
        rotation_deg=main[0].upright.degrees,
        mirrored=main[0].upright.mirrored,
        frames=tuple(records),
        level=float(np.median([photo.level for photo in photos])),
        notes=(
            *numbering(pictures),
            *_copies_note(photos, copies),
            *_stitched_note(photos, stitched),
            *_notes(photos, counts, taken),
        ),
        faults=tuple(faults),
    )


def _put(
    pictures: list[Path],
    out: Path,
    name: str,
    white_balance: WhiteBalance | None,
    progress: Progress,
    workers: int | None,
) -> Iterator[_Photo]:
    """Write each photo to the ingest folder."""
    infos = [probe_picture(picture) for picture in pictures]
    turns = shared_turns(infos)
    raws = [(i, picture) for i, picture in enumerate(pictures) if is_raw(picture)]
    developed = develop_set(raws, out, name, white_balance, progress, workers) if raws else {}
    for i, picture in enumerate(pictures):
        progress(i / len(pictures), f"{name}: {i + 1} of {len(pictures)} photos")
        if i in developed:
            photo = developed[i]
            size, grey = (photo.width, photo.height), photo.grey
            level = float(np.median(grey))
            yield _Photo(
                picture.name,
                photo.file,
                size,
                sharpness(grey),
                _same_size(grey),
                level,
                photo.upright,
                infos[i].upright,
            )
            continue
        info, rgb = infos[i], read_picture(picture, turns[i])
        file = f"frames/{name}/{copy_upright(info, turns[i], out / 'frames' / name, f'{i:06d}')}"
        grey = grey_small(rgb)
        yield _Photo(
            name=picture.name,
            file=file,
            size=(rgb.shape[1], rgb.shape[0]),
            sharpness=sharpness(grey),
            grey=_same_size(grey),
            level=float(np.median(grey)),
            upright=turns[i],
            own=info.upright,
            exif=info.exif,
            space=info.space,
            clipped=clipped_share(rgb[:, :, :3]),
            small=shrunk(rgb[:, :, :3], SIDE_PX),
            projection=info.projection,
        )


def _same_size(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "48 64"]:
    return cv2.resize(grey, SAME_SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _copies(photos: list[_Photo]) -> dict[int, int]:
    """Photos that show the very picture of another one, to the byte or coded anew: number -> that of the other.

    The largest is kept, of equal ones that which still has its tags, then that of the shortest name.
    """
    rows = np.stack([photo.grey.ravel() for photo in photos]).astype(np.float32)
    shows, rows = rows.std(axis=1) > SHOWS, rows - rows.mean()
    square = np.square(rows).sum(axis=1)
    off = (square[:, None] + square - 2 * rows @ rows.T) / rows.shape[1]  # mean squares of all pairs at once
    alike = (off < SAME_LEVEL**2) & shows & shows[:, None]

    def worth(i: int) -> tuple[int, bool, int, int]:
        exif = photos[i].exif
        return -photos[i].size[0] * photos[i].size[1], exif is None or not exif.device, len(photos[i].name), i

    copies: dict[int, int] = {}
    for i in range(len(photos)):
        best = min([i, *np.flatnonzero(alike[i]).tolist()], key=worth)
        if best != i:
            copies[i] = best
    return copies


def _copies_note(photos: list[_Photo], copies: dict[int, int]) -> list[str]:
    if not copies:
        return []
    which = some([f"{photos[i].name} of {photos[other].name}" for i, other in copies.items()])
    return [f"{len(copies)} of {len(photos)} photos are copies of others and are not used: {which}"]


def _stitched_note(photos: list[_Photo], stitched: set[int]) -> list[str]:
    if not stitched:
        return []
    which = some([photos[i].name for i in sorted(stitched)])
    return [f"{len(stitched)} of {len(photos)} photos are panoramas by their tags and are not used: {which}"]


def _notes(photos: list[_Photo], counts: Counter[Size], taken: set[Size]) -> list[str]:
    notes = []
    turned = sum(not photo.upright.nothing for photo in photos)
    if turned:
        notes.append(f"{turned} photos turned as their EXIF tag says")
    other = [photo.name for photo in photos if photo.own != photo.upright]
    if other:
        notes.append(
            f"{len(other)} photos say another turn than most of their camera and are turned like these, because a lens "
            f"belongs to the picture as it is stored: {some(other)}"
        )
    for name in dict.fromkeys(s.name for p in photos if (s := p.space) is not None and s.light is not None):
        inside = [photo.name for photo in photos if photo.space is not None and photo.space.name == name]
        notes.append(f"{len(inside)} of {len(photos)} photos are brought from {name} to sRGB: {some(inside)}")
    if len(taken) > 1:
        notes.append(f"photos of several sizes, a camera each: {_sizes(counts, taken)}")
    if len(taken) < len(counts):
        other = [photo.name for photo in photos if photo.size in counts.keys() - taken]
        notes.append(
            f"mixed sizes: {_sizes(counts, taken)} are used, {_sizes(counts, set(counts) - taken)} are not "
            f"({some(other)}); one camera in one mode is expected"
        )
    return notes


def _space_faults(photos: list[_Photo]) -> list[Measure]:
    """Photos whose levels mean what cannot be told, or something like linear light."""
    faults = []
    for why, words, meant in (
        ("profile", "have a colour profile that is not read", lambda space: space.light is None),
        ("linear", "hold linear light, by", lambda space: space.linear),
    ):
        found = [p for p in photos if p.space is not None and meant(p.space)]
        if found:
            names = ", ".join(dict.fromkeys(p.space.name for p in found if p.space is not None))
            text = f"{len(found)} of {len(photos)} photos {words} ({names}): {some([p.name for p in found])}"
            faults.append(Measure("coding", text, why=why))
    return faults


def _sizes(counts: Counter[Size], which: set[Size]) -> str:
    return ", ".join(f"{n} of {w}x{h}" for (w, h), n in counts.items() if (w, h) in which)
