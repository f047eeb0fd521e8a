"""What a photo's EXIF data say of device, lens, place and exposure (EXIF 2.32, CIPA DC-008).

Focal lengths are in pixels of the upright picture. Places are WGS 84: degrees north and east, metres above
sea level.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from PIL import ExifTags, Image

FULL_FRAME_DIAGONAL_MM = 43.2666
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF FocalPlaneResolutionUnit
PNG_CHUNKS, PNG_CRC = 8, 4  # bytes: before the first chunk, and behind each
MOST_TAGS = 10_000_000  # bytes; they hold a small picture at most


@dataclass(frozen=True)
class Place:
    """Where a photo was taken.

    Attributes:
        latitude_deg, longitude_deg: North and east are positive.
        altitude_m: Above sea level; None where the device did not say.
        std_m: The device's own word on its horizontal error, or None.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None
    std_m: float | None = None


@dataclass(frozen=True)
class Exif:
    """What is known of one photo.

    Attributes:
        device: Maker and model; empty where it does not say.
        focal_px: Focal length, pixels of the upright picture, or None.
        place: Where it was taken, or None.
        exposure_stops: Light by the settings (`exposure_stops`), or None.
        taken_s: When it was taken, seconds since 1970 by the device's own clock, or None.
    """

    device: str = ""
    focal_px: float | None = None
    place: Place | None = None
    exposure_stops: float | None = None
    taken_s: float | None = None


def read_exif(image: Image.Image) -> Exif:
    """Read the tags of an open picture (as stored, not turned upright)."""
    exif = tags_of(image)
    words = [str(exif.get(tag, "")).strip(" \0") for tag in (ExifTags.Base.Make, ExifTags.Base.Model)]
    width, height = image.size
    device, focal_px = " ".join(filter(None, words)), _focal_px(exif, width, height)
    return Exif(device, focal_px, _place(exif), _exposure(exif), _taken_s(exif))


def tags_of(image: Image.Image) -> Image.Exif:
    """The tags of a picture that was opened from a file, without decoding its pixels.

    Tags of PNG may stand behind the pixels, where Pillow finds them by decoding all of it.
    """
    if image.format != "PNG":
        return image.getexif()
    if "exif" not in image.info and (found := png_chunk(image, b"eXIf")) is not None:
        image.info["exif"] = b"Exif\0\0" + found
    return Image.Image.getexif(image)


def png_chunk(image: Image.Image, kind: bytes, behind: bool = True) -> bytes | None:
    """Content of the first such chunk of a PNG; None of other files, or without one.

    `behind`: it is looked for behind the pixels, too.
    """
    if image.format != "PNG":
        return None
    with open(getattr(image, "filename", ""), "rb") as file:
        file.seek(PNG_CHUNKS)
        while len(head := file.read(8)) == 8:
            length = int.from_bytes(head[:4], "big")
            if head[4:] == b"IDAT" and not behind:
                return None
            if head[4:] == kind:
                return file.read(min(length, MOST_TAGS))
            file.seek(length + PNG_CRC, 1)
    return None


def exposure_stops(time_s: float | None, iso: float | None, aperture: float | None) -> float | None:
    """Light by a camera's settings, log2 of time x ISO / aperture squared; None where time or ISO is unknown."""
    if time_s is None or iso is None:
        return None
    return float(np.log2(time_s * iso / (aperture or 1.0) ** 2))


def exif_from_dict(raw: Mapping[str, Any] | None) -> Exif | None:
    """Inverse of `dataclasses.asdict`, for `ingest.json`."""
    if raw is None:
        return None
    place = raw["place"]
    return Exif(**{**raw, "place": None if place is None else Place(**place)})


def _focal_px(exif: Image.Exif, width: int, height: int) -> float | None:
    """Focal length in pixels from the 35 mm equivalent, else from the focal plane's resolution.

    The equivalent is defined by the diagonal for pictures that are not 3:2 (CIPA DCG-001), but many phones
    use the width; the two differ by 4 % at 4:3, which is within what structure from motion refines.
    """
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    equivalent = _positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent:
        return equivalent * float(np.hypot(width, height)) / FULL_FRAME_DIAGONAL_MM
    focal_mm = _positive(tags.get(ExifTags.Base.FocalLength))
    resolution = _positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = MM_PER_UNIT.get(int(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2) or 2), 25.4)
    stored_width = _positive(tags.get(ExifTags.Base.ExifImageWidth))
    if not (focal_mm and resolution):
        return None
    resized = width / stored_width if stored_width else 1.0  # the tag speaks of the picture as it was taken
    return focal_mm * resolution / unit * resized


def _exposure(exif: Image.Exif) -> float | None:
    tags, base = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
    speed = tags.get(base.ISOSpeedRatings)
    return exposure_stops(
        _positive(tags.get(base.ExposureTime)),
        _positive(speed[0] if isinstance(speed, tuple) and speed else speed),
        _positive(tags.get(base.FNumber)),
    )


def _taken_s(exif: Image.Exif) -> float | None:
    tags, base = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
    try:
        whole = datetime.strptime(str(tags.get(base.DateTimeOriginal, "")).strip(" \0"), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    digits = str(tags.get(base.SubsecTimeOriginal, "")).strip(" \0")
    return whole.replace(tzinfo=timezone.utc).timestamp() + (
        float(f"0.{digits}") if re.fullmatch(r"[0-9]{1,9}", digits) else 0.0
    )


def _place(exif: Image.Exif) -> Place | None:
    tags = exif.get_ifd(ExifTags.IFD.GPSInfo)
    gps = ExifTags.GPS
    latitude = _degrees(tags.get(gps.GPSLatitude), tags.get(gps.GPSLatitudeRef), "S", 90.0)
    longitude = _degrees(tags.get(gps.GPSLongitude), tags.get(gps.GPSLongitudeRef), "W", 180.0)
    if latitude is None or longitude is None or (latitude == 0.0 and longitude == 0.0):
        return None  # devices without a fix write zeros
    altitude = _number(tags.get(gps.GPSAltitude))
    below = tags.get(gps.GPSAltitudeRef) in (1, b"\x01")
    std_m = _positive(tags.get(gps.GPSHPositioningError))
    return Place(latitude, longitude, None if altitude is None else -altitude if below else altitude, std_m)


def _degrees(parts: object, side: object, negative: str, most: float) -> float | None:
    """Degrees, minutes and seconds as one number; None where they are not three numbers in range."""
    if not isinstance(parts, tuple) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    d, m, s = (number or 0.0 for number in numbers)
    value = d + m / 60 + s / 3600
    if not 0 <= value <= most:
        return None
    return -value if str(side).strip(" \0").upper() == negative else value


def _number(value: object) -> float | None:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) else None


def _positive(value: object) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None
