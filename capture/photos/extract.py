"""From a folder of photos to upright pictures on disk, RAW photos developed."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devrf.capture.colour.light_course import clipped_share, highlight_faults
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
    projection_faults,
    projection_of,
)
from devrf.capture.system.progress import Progress, no_progress

FEWEST_OF_A_SIZE = 5  # photos of a sweep; fewer leave their focal length to chance
LEAST_GAMMA = 1.6  # the curves of displays and cameras are 1.8 to 2.4; less is linear light or a logarithm

Size = tuple[int, int]


@dataclass(frozen=True)
class _Photo:
    """A photo as it was put into the ingest folder.

    Attributes:
        name: In its folder.
        file: Relative to the ingest folder.
        size: Width and height, upright, pixels.
        sharpness: As of frames.
        level: Median brightness, 0 to 255.
        upright: How it was turned; own: what its tag asks for.
        exif: Its tags, or None.
        gamma: Of its curve, where the file names one.
        clipped: Share at white; None of RAW photos, whose sidecar has it.
        small: The picture, small; of RAW photos None.
        projection: As of `PictureInfo`.
    """

    name: str
    file: str
    size: Size
    sharpness: float
    level: float
    upright: Upright
    own: Upright
    exif: Exif | None = None
    gamma: float | None = None
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

    Photos of one camera are turned alike, as most of them ask for. Those of another size than most are not used,
    because one set of intrinsics must fit all; in a sweep, a size of which there are enough photos to fix its
    intrinsics is a camera of its own.

    Raises:
        InputError: If the folder or a photo cannot be read.
        CaptureError: If a photo's content is damaged.
    """
    (out / "frames" / name).mkdir(parents=True, exist_ok=True)
    pictures = list_pictures(path)
    photos = list(_put(pictures, out, name, white_balance, progress, workers))
    counts = Counter(photo.size for photo in photos)
    size = counts.most_common(1)[0][0]
    taken = {s for s, n in counts.items() if s == size or (role == "sweep" and n >= FEWEST_OF_A_SIZE)}
    alike = [i for i, photo in enumerate(photos) if photo.size in taken]
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
    main = [photo for photo in photos if photo.size == size]
    kind = projection_of(
        (p.projection for p in main), [p.small for p in main if p.small is not None][:ENOUGH]
    )
    faults = [*projection_faults(kind), *unread_faults(path), *_curve_fault(photos)]
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
        notes=(*numbering(pictures), *_notes(photos, counts, taken)),
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
                picture.name, photo.file, size, sharpness(grey), level, photo.upright, infos[i].upright
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
            level=float(np.median(grey)),
            upright=turns[i],
            own=info.upright,
            exif=info.exif,
            gamma=info.gamma,
            clipped=clipped_share(rgb[:, :, :3]),
            small=shrunk(rgb[:, :, :3], SIDE_PX),
            projection=info.projection,
        )


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
    if len(taken) > 1:
        notes.append(f"photos of several sizes, a camera each: {_sizes(counts, taken)}")
    if len(taken) < len(counts):
        other = [photo.name for photo in photos if photo.size not in taken]
        notes.append(
            f"mixed sizes: {_sizes(counts, taken)} are used, {_sizes(counts, set(counts) - taken)} are not "
            f"({some(other)}); one camera in one mode is expected"
        )
    return notes


def _curve_fault(photos: list[_Photo]) -> list[Measure]:
    """Photos that say they hold something like linear light."""
    other = [photo for photo in photos if photo.gamma is not None and photo.gamma < LEAST_GAMMA]
    if not other:
        return []
    gamma = (
        f"{len(other)} of {len(photos)} photos name a gamma of {other[0].gamma:.2g}, all are taken as sRGB"
    )
    return [Measure("coding", f"{gamma}: {some([photo.name for photo in other])}", why="linear")]


def _sizes(counts: Counter[Size], which: set[Size]) -> str:
    return ", ".join(f"{n} of {w}x{h}" for (w, h), n in counts.items() if (w, h) in which)
