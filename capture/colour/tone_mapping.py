"""High dynamic range video (HLG, PQ) to the 8-bit sRGB of all other pictures, by one rule for every clip.

The light a reference display shows (ITU-R BT.2100-2: for HLG the inverse OETF and the OOTF of a display of
1000 cd/m2, for PQ the EOTF) is divided by HDR reference white (203 cd/m2, ITU-R BT.2408-7, Section 2.2), brought
from BT.2020 to BT.709 primaries (ITU-R BT.2087-0), clipped to [0, 1] and coded by the sRGB curve (IEC 61966-2-1).
So reference white becomes 255 and an 18 % grey card about 100, as a camera in a standard profile writes them. What is
brighter than reference white is clipped, as that camera clips it: a soft knee would bend linear light, by which
cameras are matched. Nothing depends on the single picture.
"""

from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from devrf.capture.colour.primaries import BT2020, STRIPE_ROWS, srgb_from_primaries
from devrf.capture.colour.srgb import LEVEL_OF_LINEAR

Transfer = Literal["HLG", "PQ"]

REFERENCE_WHITE = 203.0  # cd/m2, BT.2408-7: HLG at 75 %, PQ at 58 %
HLG_PEAK = 1000.0  # cd/m2, nominal peak of the reference display of HLG ...
HLG_GAMMA = np.float32(1.2)  # ... and its system gamma (BT.2100-2, Table 5)
BT2020_LUMA = np.array([0.2627, 0.6780, 0.0593], np.float32)
FULL_CODE = 255 * 256  # what swscale makes of the brightest 16-bit code: its 8-bit white, shifted


def srgb_from_hdr(
    code: UInt16[np.ndarray, "height width 3"], transfer: Transfer, primaries: int = BT2020
) -> UInt8[np.ndarray, "height width 3"]:
    """8-bit sRGB of R'G'B' codes, 0 to `FULL_CODE` (more is taken for that), in primaries of `CHROMATICITIES`."""
    out = np.empty(code.shape, np.uint8)
    table, srgb_from_own = _light(transfer), srgb_from_primaries(primaries)
    for top in range(0, len(code), STRIPE_ROWS):
        light = table[code[top : top + STRIPE_ROWS]]
        if transfer == "HLG":  # OOTF: display light = scene light * luminance ** (gamma - 1)
            light = (
                light * ((light @ BT2020_LUMA) ** (HLG_GAMMA - 1))[..., None] * (HLG_PEAK / REFERENCE_WHITE)
            )
        linear = np.clip(light @ srgb_from_own.T, 0, 1)
        out[top : top + STRIPE_ROWS] = LEVEL_OF_LINEAR[(linear * 65535 + 0.5).astype(np.uint16)]
    return out


@cache
def _light(transfer: Transfer) -> Float32[np.ndarray, " codes"]:
    """Of every 16-bit code: scene light in [0, 1] (HLG), or display light over reference white (PQ)."""
    signal = np.minimum(1, np.arange(65536) / FULL_CODE)
    if transfer == "HLG":
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) * (10_000 / REFERENCE_WHITE)
    return light.astype(np.float32)
