"""By which curve a photo says that its levels code light (PNG 3, gAMA; ICC.1:2022, tone reproduction curves)."""

import struct

import numpy as np
from PIL import Image

ICC_TAGS_AT = 128  # number of tags, after the header; then signature, offset and size of each
FIXED = 65536.0  # s15Fixed16Number


def declared_gamma(image: Image.Image) -> float | None:
    """Exponent from levels to light that an open photo names; None where it names none."""
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes):
        try:
            return _profile_gamma(profile)
        except struct.error:  # cut short
            return None
    coded = image.info.get("gamma")  # of PNG: from light to levels
    return 1 / coded if isinstance(coded, float) and coded > 0 else None


def _profile_gamma(profile: bytes) -> float | None:
    """Exponent of the green (or grey) curve of an ICC profile; of a table, that which its middle has."""
    (count,) = struct.unpack_from(">I", profile, ICC_TAGS_AT)
    tags = {
        s: at
        for s, at, _ in (struct.unpack_from(">4sII", profile, ICC_TAGS_AT + 4 + 12 * n) for n in range(count))
    }
    at = tags.get(b"gTRC", tags.get(b"kTRC"))
    if at is None:
        return None
    kind = profile[at : at + 4]
    if kind == b"para":
        return struct.unpack_from(">i", profile, at + 12)[0] / FIXED
    if kind != b"curv":
        return None
    (points,) = struct.unpack_from(">I", profile, at + 8)
    if points == 0:
        return 1.0
    values = struct.unpack_from(f">{points}H", profile, at + 12)
    if points == 1:
        return values[0] / 256
    middle = max(1, values[points // 2]) / 65535
    return float(np.log(middle) / np.log(points // 2 / (points - 1)))
