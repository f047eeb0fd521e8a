"""Develop RAW photos with one fixed recipe for all photos of a set, so that equal light gives equal pixels.

Nothing is adapted to the single picture: no automatic brightness, no automatic maximum, one white balance, one white
level, one demosaicing (AHD), highlights clipped, 16 bits linear in sRGB primaries. LibRaw's turn by EXIF is off: one
sensor must keep one set of intrinsics, so the whole set is turned by the one turn most of its photos ask for, here,
once. For display and training the sRGB curve (IEC 61966-2-1) and 8 bits follow.

Black levels are each photo's own (some cameras measure them anew for every exposure); a photo's white level would be
its own gain, so the first photo's is used for all.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from devrf.capture.colour.srgb import LEVEL_OF_LINEAR
from devrf.capture.orientation import Upright, by_exif
from devrf.capture.photos.raw_compression import compression_of, compression_words
from devrf.capture.system.errors import CaptureError, DevrfError, InputError
from devrf.capture.system.limits import check_pixels

if TYPE_CHECKING:
    from rawpy import RawPy

RAW_SUFFIXES = frozenset(
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .k25 .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf "
    ".raw .rw2 .rwl .sr2 .srf .srw .x3f".split()
)
DEMOSAIC = "AHD"
EXIF_OF_FLIP = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}  # LibRaw's code -> EXIF's orientation
BELOW_BLACK = 0.002  # of the range: noise of a dark pixel seldom reaches it, a wrong level does
FLOOR_QUANTILE = 0.001  # of the pixels are darker than the floor

WhiteBalance = tuple[float, float, float, float]


@dataclass(frozen=True)
class RawLayout:
    """What can be told of a RAW file without reading its pixels.

    Attributes:
        width, height: Size of the picture before any turn, pixels.
        upright: The turn and mirror its tag asks for.
    """

    width: int
    height: int
    upright: Upright


@dataclass(frozen=True)
class RawHeader:
    """What a RAW file says of its sensor and settings.

    Attributes:
        path: The file.
        black: Black levels of R, G, B and the second G, as stored.
        white: White level, as stored.
        as_shot: White balance the camera chose, multipliers with G at 1; None where the file has none.
        daylight: The sensor's multipliers for daylight, the smallest at 1; ones where LibRaw knows none.
        upright: The turn and mirror its tag asks for.
        exposure_s, iso, aperture: As set; None where unknown.
    """

    path: Path
    black: tuple[int, int, int, int]
    white: int
    as_shot: tuple[float, float, float] | None
    daylight: WhiteBalance
    upright: Upright
    exposure_s: float | None
    iso: float | None
    aperture: float | None


@dataclass(frozen=True)
class Recipe:
    """How every photo of a set is developed.

    Attributes:
        white_balance: Multipliers for R, G, B and the second G, the smallest at 1.
        white: White level, as stored.
        upright: Turn and mirror of the whole set.
    """

    white_balance: WhiteBalance
    white: int
    upright: Upright


@dataclass(frozen=True)
class Development:
    """A developed RAW photo.

    Attributes:
        linear: Picture [height, width, 3], linear light in sRGB primaries, 65535 is white; upright.
        header: What the file says.
        camera_matrix: LibRaw's matrix from the sensor's colours to linear sRGB [3, 4].
        clipped: Share of pixels with a channel at white after white balance.
        below_black: Share of sensor values below black by more than a five hundredth of the range.
        floor: The darkest sensor values, above black: their quantile 0.001, share of the range.
        highest: The highest sensor value, as stored.
        at_highest: How many times more values it has than each of the thirty-two below it, on average.
    """

    linear: UInt16[np.ndarray, "height width 3"]
    header: RawHeader
    camera_matrix: Float[np.ndarray, "3 4"]
    clipped: float
    below_black: float
    floor: float
    highest: int
    at_highest: float

    @property
    def rgb(self) -> UInt8[np.ndarray, "height width 3"]:
        """The picture in sRGB, 8 bits."""
        return LEVEL_OF_LINEAR[self.linear]


def is_raw(path: Path) -> bool:
    """Whether the file name is that of a RAW photo."""
    return path.suffix.lower() in RAW_SUFFIXES


def read_layout(path: Path) -> RawLayout:
    """Size and turn of a RAW file; its pixels are not read.

    Raises:
        InputError: If the file is not a RAW file that LibRaw reads.
    """
    with _open(path) as file:
        sizes = file.sizes
        return RawLayout(int(sizes.width), int(sizes.height), _upright(sizes.flip))


def recipe_for(paths: Sequence[Path], white_balance: WhiteBalance | None = None) -> Recipe:
    """The recipe of a set of photos of one camera.

    Args:
        paths: At least one.
        white_balance: Multipliers for R, G, B, second G; None: daylight of the first photo's sensor.
    Raises:
        InputError: If a file is not a RAW file that LibRaw reads.
        CaptureError: If the first one is damaged.
    """
    turns = Counter(read_layout(path).upright for path in paths)
    with _open(paths[0]) as file:
        first = _header(paths[0], file)
    balance = white_balance or first.daylight
    smallest = min(balance)
    r, g, b, g2 = (value / smallest for value in balance)
    return Recipe((r, g, b, g2), first.white, turns.most_common(1)[0][0])


def develop(path: Path, recipe: Recipe | None = None) -> Development:
    """Develop one RAW file.

    Args:
        path: The file.
        recipe: That of its set; None: it is a set of its own.
    Raises:
        InputError: If the file is not a RAW file that LibRaw reads.
        CaptureError: If its content is damaged.
    """
    import rawpy

    recipe = recipe or recipe_for([path])
    with _open(path) as file:
        header = _header(path, file)
        if recipe.white <= max(header.black):
            wrong = f"{path}: black level {max(header.black)}, but the set's white level is {recipe.white}"
            remedy = "photos of one folder must come from one camera"
            raise CaptureError("raw-levels-differ", f"{wrong}; {remedy}")
        try:
            sensor = _sensor_values(file, header)  # before LibRaw works on them in place
            linear = file.postprocess(
                gamma=(1, 1),
                output_bps=16,
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_wb=list(recipe.white_balance),
                user_sat=recipe.white - max(header.black),  # LibRaw takes it as above black
                user_flip=0,
                demosaic_algorithm=rawpy.DemosaicAlgorithm[DEMOSAIC],
                highlight_mode=rawpy.HighlightMode.Clip,
                output_color=rawpy.ColorSpace.sRGB,
            )
        except rawpy.LibRawError as error:
            raise _damaged(path, error) from None
        matrix = np.asarray(file.color_matrix, dtype=np.float64)
    clipped = float((linear.max(axis=-1) == 65535).mean())
    upright = recipe.upright.apply(linear)
    return Development(upright, header, matrix, clipped, *sensor)


def _open(path: Path) -> "RawPy":
    import rawpy

    if not path.is_file():
        raise InputError("file-missing", f"{path}: no such file; check the path in scene.yaml")
    try:
        file = rawpy.imread(str(path))
    except rawpy.LibRawError as error:
        if path.suffix.lower() == ".dng" and compression_of(path) is not None:
            raise _unread(path) from None
        text = f"{path}: not a RAW file that LibRaw reads ({_reason(error)}); convert it to DNG"
        raise InputError("file-not-raw", text) from None
    try:
        check_pixels(path, file.sizes.raw_width, file.sizes.raw_height)
    except CaptureError:
        file.close()
        raise
    return file


def _upright(flip: int) -> Upright:
    return by_exif(EXIF_OF_FLIP.get(flip, 1))


def check_unpacks(path: Path) -> None:
    """Read the pixels of a RAW file, which tells whether LibRaw can.

    Raises:
        InputError: It is compressed in a way that LibRaw does not read.
        CaptureError: Its content is damaged.
    """
    with _open(path) as file:
        _header(path, file)


def _damaged(path: Path, error: Exception) -> DevrfError:
    import rawpy

    # It opened, so it is the way its pixels are stored.
    if isinstance(error, rawpy.LibRawFileUnsupportedError):
        return _unread(path)
    text = f"{path}: the RAW data is damaged ({_reason(error)}); copy it from the camera again"
    return CaptureError("file-damaged", text)


def _unread(path: Path) -> InputError:
    words = compression_words(path) or "a way that it does not name"
    wrong = f"{path}: compressed by {words}, which LibRaw does not read"
    remedy = "set the camera to lossless or none, convert them by Adobe DNG Converter or dnglab, or give JPEG"
    return InputError("raw-compression-unread", f"{wrong}; {remedy}")


def _header(path: Path, file: "RawPy") -> RawHeader:
    import rawpy

    try:
        r, g, b, g2 = (int(level) for level in file.black_level_per_channel)  # reads the pixels
    except rawpy.LibRawError as error:
        raise _damaged(path, error) from None
    red, green, blue = (float(m) for m in file.camera_whitebalance[:3])
    settings = file.other
    return RawHeader(
        path=path,
        black=(r, g, b, g2),
        white=int(file.white_level),
        as_shot=(red / green, 1.0, blue / green) if min(red, green, blue) > 0 else None,
        daylight=_daylight(file.daylight_whitebalance),
        upright=_upright(file.sizes.flip),
        exposure_s=float(settings.shutter_speed) or None,
        iso=float(settings.iso_speed) or None,
        aperture=float(settings.aperture) or None,
    )


def _sensor_values(file: "RawPy", header: RawHeader) -> tuple[float, float, int, float]:
    """Share below black, floor, highest value and how many more pixels have it than its neighbours; see Development."""
    values = file.raw_image_visible
    pattern = file.raw_pattern
    if values is None or values.ndim != 2 or pattern is None:  # layered sensors have no mosaic
        return 0.0, 0.0, header.white, 1.0
    span = header.white - max(header.black)
    above = np.zeros(65536 * 2, dtype=np.int64)  # histogram of values above black, from -65536
    stored = np.zeros(65536, dtype=np.int64)
    rows, columns = pattern.shape
    for y in range(rows):
        for x in range(columns):
            counts = np.bincount(values[y::rows, x::columns].ravel(), minlength=65536)
            begin = 65536 - header.black[int(pattern[y, x])]
            above[begin : begin + 65536] += counts
            stored += counts
    total = int(stored.sum())
    below = int(above[: 65536 - round(BELOW_BLACK * span)].sum())
    floor = int(np.searchsorted(above.cumsum(), FLOOR_QUANTILE * total)) - 65536
    highest = int(np.flatnonzero(stored)[-1])
    next_to_it = stored[max(0, highest - 32) : highest]
    return below / total, floor / span, highest, float(stored[highest] / max(1.0, next_to_it.mean()))


def _daylight(multipliers: Sequence[float]) -> WhiteBalance:
    """Multipliers scaled so that the smallest is 1; sensors without a table keep their own balance."""
    r, g, b, g2 = (float(m) for m in (*multipliers, 0.0, 0.0, 0.0, 0.0)[:4])
    g2 = g2 or g
    if min(r, g, b) <= 0:
        return (1.0, 1.0, 1.0, 1.0)
    smallest = min(r, g, b, g2)
    return (r / smallest, g / smallest, b / smallest, g2 / smallest)


def _reason(error: Exception) -> str:
    text = error.args[0] if error.args else error
    return text.decode(errors="replace") if isinstance(text, bytes) else str(text)
