"""All RAW photos of a folder: developed side by side by one recipe, written to disk, and what was used of each.

A photo of 24 million pixels takes 0.6 GB while it is developed, so at most one per core, or as many as are allowed, are
in memory. The picture in `frames` is sRGB with 8 bits.
`raw/<name>.json` holds the recipe and, per file, levels, white balance as shot, matrix and what was clipped.
"""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from devrf.capture.exif import exposure_stops
from devrf.capture.frames import grey_small
from devrf.capture.orientation import Upright
from devrf.capture.photos.raw import DEMOSAIC, Development, Recipe, WhiteBalance, develop, recipe_for
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import Progress, no_progress


@dataclass(frozen=True)
class RawPhoto:
    """A RAW photo as it lies on disk.

    Attributes:
        file: The 8-bit picture, relative to the ingest folder.
        width, height: Its size, pixels.
        grey: The picture in grey, at the size in which sharpness is measured.
        upright: How it was turned.
    """

    file: str
    width: int
    height: int
    grey: UInt8[np.ndarray, "small_height small_width"]
    upright: Upright


def develop_set(
    pictures: Sequence[tuple[int, Path]],
    out: Path,
    name: str,
    white_balance: WhiteBalance | None = None,
    progress: Progress = no_progress,
    workers: int | None = None,
) -> dict[int, RawPhoto]:
    """Develop all RAW photos of a folder.

    Args:
        pictures: Index and file of each, of one camera.
        out: The ingest folder.
        name: The folder's name among the cameras.
        white_balance: Multipliers for R, G, B, second G; None: daylight of the set's sensor.
        progress: Told how far it is.
        workers: Photos developed at once; None: one per core.
    Returns:
        Index -> what was written.
    Raises:
        InputError: If a file is not a RAW file that LibRaw reads.
        CaptureError: If the content of one is damaged.
    """
    recipe = recipe_for([path for _, path in pictures], white_balance)
    for folder in (out / "frames" / name, out / "raw"):
        folder.mkdir(parents=True, exist_ok=True)

    def one(job: tuple[int, Path]) -> tuple[RawPhoto, dict[str, Any]]:
        index, path = job
        photo = develop(path, recipe)
        file = f"frames/{name}/{index:06d}.png"
        rgb = photo.rgb
        write_picture(out / file, rgb)
        height, width = rgb.shape[:2]
        return RawPhoto(file, width, height, grey_small(rgb), recipe.upright), _used(photo, file)

    photos: dict[int, RawPhoto] = {}
    used = []
    with ThreadPoolExecutor(workers or usable_cores()) as pool:
        try:
            for (index, path), (photo, entry) in zip(pictures, pool.map(one, pictures), strict=True):
                photos[index] = photo
                used.append(entry)
                progress(len(photos) / len(pictures), f"{name}: {path.name} developed")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    sidecar = {"recipe": _recipe(recipe), "files": used}
    (out / "raw" / f"{name}.json").write_text(json.dumps(sidecar, indent=1))
    return photos


def read_raw_sidecar(path: Path) -> dict[str, Any]:
    """What was used of a set: `recipe`, and `files`, a list; as `develop_set` wrote it.

    Raises:
        CaptureError: If it is missing or something else.
    """
    try:
        sidecar = json.loads(path.read_text())
        if set(sidecar) != {"recipe", "files"}:
            raise ValueError(f"keys {sorted(sidecar)}, expected files and recipe")
        return sidecar
    except (OSError, ValueError) as error:
        text = f"{path}: cannot be read ({error}); run again with --from ingest"
        raise CaptureError("file-damaged", text) from None


def _recipe(recipe: Recipe) -> dict[str, Any]:
    import rawpy

    return {
        "white_balance": recipe.white_balance,
        "white": recipe.white,
        "turn_deg": recipe.upright.degrees,
        "demosaic": DEMOSAIC,
        "auto_bright": False,
        "highlights": "clip",
        "primaries": "sRGB",
        "curve": "sRGB",
        "libraw": ".".join(map(str, rawpy.libraw_version)),
    }


def _used(photo: Development, file: str) -> dict[str, Any]:
    header = photo.header
    return {
        "source": header.path.name,
        "file": file,
        "black": header.black,
        "white": header.white,
        "as_shot": header.as_shot,
        "daylight": header.daylight,
        "turn_deg": header.upright.degrees,
        "exposure_s": header.exposure_s,
        "iso": header.iso,
        "aperture": header.aperture,
        "exposure_stops": exposure_stops(header.exposure_s, header.iso, header.aperture),
        "camera_matrix": photo.camera_matrix.tolist(),
        "clipped": photo.clipped,
        "below_black": photo.below_black,
        "floor": photo.floor,
        "highest": photo.highest,
        "at_highest": photo.at_highest,
    }
