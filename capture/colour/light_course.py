"""The light of a fixed camera's clip over time: exposure, white balance and lamps, measured on what stands still.

Every frame is averaged to a grid of cells in linear light and compared with the first frame, cell by cell. Where most
cells of a picture tell the same ratio, that is the camera or the lamps; cells that tell another are what moves. Stops
are log2 of light; the sRGB curve (IEC 61966-2-1) is taken as the one the pictures were coded with. All is gathered in
one pass, about a hundred bytes a frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from devrf.capture.colour.srgb import LINEAR_OF_LEVEL
from devrf.capture.measure import Measure
from devrf.capture.system.arrays import ArrayError, read_npy
from devrf.capture.system.errors import CaptureError

CELLS = (24, 32)  # rows, columns; a moving hand leaves most of them alone
BANDS = 12  # bands of rows: lamps at 100 Hz give a sensor that reads out in 16 ms between one and two waves
SMALL_SIDE_PX = 160  # pictures come at this size, so that a cell is the mean of some twenty in linear light
DARK, BRIGHT = 0.01, 0.75  # linear light of cells that are compared: above the noise, well below white
NEAR_WHITE = 0.95  # cells that have grown brighter than this no longer tell how much
CLIPPED_SHARE = 0.01  # of a picture: colours at white are no colours
AT_WHITE = 253  # levels of 255; compression leaves clipped pixels within two levels of white
AGREE_STOPS = 0.15  # cells agree within this: lamps differ by 10 % between rows, other things by more ...
AGREE_SHARE = 0.1  # ... and this share of the change: a camera's curve is not exactly sRGB
FEWEST_CELLS = 20  # a median of fewer says nothing
FEWEST_AGREEING = 0.5  # of the cells: a subject that fills the picture hides the light
COLUMNS = 6 + BANDS
NOTHING = np.full(3, np.nan), np.nan, np.full(BANDS, np.nan)  # what is known of the light where it is hidden


@dataclass(frozen=True)
class LightCourse:
    """How the light of a clip changes.

    Attributes:
        index: Numbers of the frames [n].
        time_s: Their times [n], seconds.
        stops: Light of R, G, B against the first frame [n, 3], log2; NaN where what moves hides it.
        left: What `stops` do not explain [n], log2: the median over still cells and channels; NaN like `stops`.
        bands: As `stops`, of the grey picture by bands of rows in the order the sensor reads them [n, bands].
    """

    index: Int[np.ndarray, " n"]
    time_s: Float[np.ndarray, " n"]
    stops: Float[np.ndarray, "n 3"]
    left: Float[np.ndarray, " n"]
    bands: Float[np.ndarray, "n bands"]

    def without(self, frames: Sequence[int]) -> "LightCourse":
        """The course without some frames."""
        kept = ~np.isin(self.index, frames)
        parts = (self.index, self.time_s, self.stops, self.left, self.bands)
        return LightCourse(*(part[kept] for part in parts))

    def write(self, path: Path) -> None:
        """Write a table [n, 6 + bands]: frame, seconds, stops of R, G, B, what they leave, stops of the bands."""
        np.save(path, np.column_stack([self.index, self.time_s, self.stops, self.left, self.bands]))

    @staticmethod
    def read(path: Path) -> "LightCourse":
        """Read what `write` wrote.

        Raises:
            CaptureError: If it is missing or something else.
        """
        try:
            table = read_npy(path)
            if table.ndim != 2 or table.shape[1] != COLUMNS:
                raise ValueError(f"a table {table.shape}, expected {COLUMNS} columns")
        except (ArrayError, ValueError) as error:
            text = f"{path}: cannot be read ({error}); run again with --from ingest"
            raise CaptureError("file-damaged", text) from None
        return _course(table)


class LightMeter:
    """Gathers a `LightCourse`, frame by frame."""

    def __init__(self) -> None:
        self._first: Float[np.ndarray, "rows columns 3"] | None = None
        self._rows: list[np.ndarray] = []

    def add(self, index: int, time_s: float, small: UInt8[np.ndarray, "h w 3"]) -> None:
        """Measure one frame, R, G, B, as stored: not turned. `SMALL_SIDE_PX` are enough."""
        cells = cv2.resize(cv2.LUT(small, LINEAR_OF_LEVEL), CELLS[::-1], interpolation=cv2.INTER_AREA)
        if self._first is None and _comparable(cells).sum() >= FEWEST_CELLS:
            self._first = cells
        stops, left, bands = NOTHING if self._first is None else _against(self._first, cells)
        self._rows.append(np.concatenate([[index, time_s], stops, [left], bands]))

    def course(self) -> LightCourse:
        """What was measured."""
        table = np.array(self._rows).reshape(-1, COLUMNS)
        return _course(table)


def clipped_share(rgb: UInt8[np.ndarray, "h w 3"]) -> float:
    """Share of a picture with a channel at white."""
    return float((rgb.max(axis=-1) >= AT_WHITE).mean())


def highlight_faults(shares: Sequence[float]) -> list[Measure]:
    """What `clipped_share` of several pictures of one source says."""
    share = float(np.median(shares)) if shares else 0.0
    if share <= CLIPPED_SHARE:
        return []
    text = f"{100 * share:.0f} % of the picture is at white, expected at most {100 * CLIPPED_SHARE:.0f} %"
    return [Measure("highlights", text)]


def _course(table: Float[np.ndarray, "n columns"]) -> LightCourse:
    return LightCourse(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:5], table[:, 5], table[:, 6:])


def _comparable(cells: Float[np.ndarray, "rows columns 3"]) -> Bool[np.ndarray, "rows columns"]:
    return (cells.min(axis=-1) > DARK) & (cells.max(axis=-1) < BRIGHT)


def _against(
    first: Float[np.ndarray, "rows columns 3"], cells: Float[np.ndarray, "rows columns 3"]
) -> tuple[Float[np.ndarray, "3"], float, Float[np.ndarray, " bands"]]:
    """Stops of R, G, B over the picture, what they leave, and grey by bands, by the cells that agree with most."""
    usable = _comparable(first) & (cells.max(axis=-1) < NEAR_WHITE)
    if usable.sum() < FEWEST_CELLS:
        return NOTHING
    ratio = np.log2(np.maximum(cells, 1e-6) / np.maximum(first, 1e-6)).astype(np.float64)
    grey = ratio.mean(axis=-1)
    middle = float(np.median(grey[usable]))
    agrees = usable & (np.abs(grey - middle) <= AGREE_STOPS + AGREE_SHARE * abs(middle))
    if agrees.sum() < max(FEWEST_CELLS, FEWEST_AGREEING * usable.sum()):
        return NOTHING
    # a band is whole rows of cells
    by_band = np.sort(np.where(agrees, grey, np.inf).reshape(BANDS, -1), axis=-1)
    last = np.arange(BANDS), np.maximum(agrees.reshape(BANDS, -1).sum(axis=-1) - 1, 0)
    lower, upper = by_band[last[0], last[1] // 2], by_band[last[0], (last[1] + 1) // 2]
    bands = np.where(np.isfinite(upper), (lower + upper) / 2, np.nan)
    stops = np.median(ratio[agrees], axis=0)
    return stops, float(np.median(np.abs(ratio[agrees] - stops))), bands
