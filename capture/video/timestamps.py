"""A table of true frame times beside the clips, and whether its steps are those of the clip that it belongs to."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.measure import Measure
from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import CLIP_S, TEXT_BYTES, check_bytes
from devrf.capture.video.media import check_file
from devrf.capture.video.slow_motion import is_one

TIMESTAMP_COLUMNS = ("camera", "frame_index", "time_s")
UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}  # of a second
MOST_TIMES, LEAST_TIMES = 100.0, 1e-3  # a clip's own steps: no camera lies outside, another unit does
MOST_FRAMES = 2**31  # of a clip; indices are whole numbers of 64 bits


@dataclass(frozen=True)
class FrameTimes:
    """True times of one camera's frames: `time_s` [n] belongs to frame `index` [n] of its clip."""

    index: Int[np.ndarray, " n"]
    time_s: Float[np.ndarray, " n"]


def read_timestamps(path: Path, cameras: Iterable[str]) -> dict[str, FrameTimes]:
    """Read a table of true frame times.

    Args:
        path: CSV with a header and at least the columns camera, frame_index (from 0), time_s (one clock).
        cameras: Names that must be in it.
    Returns:
        Camera name -> times, sorted by frame index.
    Raises:
        InputError: Naming the row or the camera, and what was expected.
        CaptureError: The file is larger than any table.
    """
    check_file(path)
    check_bytes(path, TEXT_BYTES)
    rows: dict[str, dict[int, float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = tuple(reader.fieldnames or ())
            missing = [c for c in TIMESTAMP_COLUMNS if c not in columns]
            if missing:
                wrong = f"{path}: no column {', '.join(missing)} (it has: {', '.join(columns) or 'nothing'})"
                raise InputError("entry-missing", f"{wrong}; expected {', '.join(TIMESTAMP_COLUMNS)}")
            for row in reader:
                name, index, time_s = _times_row(row, f"{path}: line {reader.line_num}")
                if index in rows.setdefault(name, {}):
                    text = f"{path}: line {reader.line_num}: frame {index} of camera {name} is given twice"
                    raise InputError("entry-twice", text)
                rows[name][index] = time_s
    except UnicodeDecodeError as error:
        wrong = f"{path}: not UTF-8 text ({error.reason} at byte {error.start}); expected a CSV text file"
        raise InputError("encoding-wrong", f"{wrong}; save it as UTF-8 (UTF-16 is not read)") from None
    except csv.Error as error:
        raise InputError("file-damaged", f"{path}: not a CSV text file ({error})") from None
    names = list(cameras)
    absent = [name for name in names if name not in rows]
    if absent:
        wrong = f"{path}: no rows for camera {', '.join(absent)} (it has: {', '.join(rows) or 'no rows'})"
        raise InputError("camera-missing", f"{wrong}; use the names of capture.cameras")
    out = {}
    for name in names:
        index = np.array(sorted(rows[name]))
        time_s = np.array([rows[name][i] for i in index.tolist()])
        back = np.flatnonzero(time_s[1:] <= time_s[:-1])
        if len(back):
            i = int(back[0])
            a, b = (f"frame {index[n]} ({time_s[n]:.6f} s)" for n in (i, i + 1))
            text = f"{path}: camera {name}: time does not increase from {a} to {b}; correct the table"
            raise InputError("times-not-rising", text)
        out[name] = FrameTimes(index, time_s)
    return out


def table_factor(times: FrameTimes, clip_s: Mapping[int, float]) -> float | None:
    """How many times longer the steps of a table are than those of the clip; None where too little is in both.

    Args:
        times: The table's, of one camera.
        clip_s: Frame -> its file time.
    """
    both = [
        (t, clip_s[i])
        for i, t in zip(times.index.tolist(), times.time_s.tolist(), strict=True)
        if i in clip_s
    ]
    table, clip = np.diff(np.array(both).reshape(-1, 2) / 2, axis=0).T  # halves, whose differences are finite
    rising = clip > 0
    return float(np.median(table[rising] / clip[rising])) if rising.any() else None


def check_table(path: Path, camera: str, times: FrameTimes, factor: float | None) -> None:
    """Refuse times that are not in seconds, by how their steps compare with those of the clip (`table_factor`).

    Raises:
        InputError: Naming the factor and the unit.
    """
    if factor is not None and not LEAST_TIMES < factor < MOST_TIMES:
        wrong = f"{path}: camera {camera}: its steps are {factor:.4g} times those of the clip"
        unit = min(UNITS, key=lambda u: abs(math.log(max(factor, 1.0) / u)))
        guess = f"time_s is in {UNITS[unit]}: divide it by {unit:.0f}, to have seconds" if factor > 1 else ""
        raise InputError("times-unit-wrong", f"{wrong}; {guess or 'time_s is in seconds: correct the table'}")
    # not in numpy, which warns where it is infinite
    span_s = float(times.time_s[-1]) - float(times.time_s[0])
    if span_s > CLIP_S:
        wrong = f"{path}: camera {camera}: its times are {span_s:.0f} s apart, at most {CLIP_S} s are read"
        raise InputError("times-too-long", f"{wrong}; time_s is in seconds: correct the table")


def check_indices(table: Path, camera: str, times: FrameTimes, clip: Path, frames: int) -> None:
    """Refuse a table none of whose frames a clip has; that it has some more, or fewer, is usual.

    Raises:
        InputError: Naming its first frame, and how many the clip has.
    """
    first = int(times.index[0])
    if first >= frames:
        wrong = f"{table}: camera {camera}: its first frame has index {first}, and {clip} has {frames} frames"
        raise InputError("frames-not-in-clip", f"{wrong}; count frame_index from 0 in each clip")


def table_faults(factor: float | None) -> list[Measure]:
    """What to say where a table's steps are not those of the clip, though both may be right: slow motion."""
    if factor is None or is_one(factor):
        return []
    like = f"slow motion, {1 / factor:.3g} times" if factor < 1 else "a time lapse"
    text = f"steps of the table are {factor:.3g} times those of the clip, as of {like}; the table is used"
    return [Measure("clip-times", text, why="table")]


def _times_row(row: dict[str, str], where: str) -> tuple[str, int, float]:
    try:
        index, time_s = int(row["frame_index"]), float(row["time_s"])
    except (TypeError, ValueError):
        wrong = f"{where}: frame_index {row['frame_index']!r}, time_s {row['time_s']!r}"
        raise InputError("entry-wrong", f"{wrong}; expected a whole number and seconds") from None
    if not 0 <= index < MOST_FRAMES or not np.isfinite(time_s):
        text = f"{where}: frame_index {index:g}, time_s {time_s}; expected 0 or more, and finite"
        raise InputError("entry-wrong", text)
    return (row["camera"] or "").strip(), index, time_s
