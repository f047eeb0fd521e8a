"""What `check` looks at in the sweep and in each fixed camera's clip, decoding a few pictures of each by seeking."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devrf.calibration.field.fixed import glance_at_fixed
from devrf.calibration.field.matching import Features, features
from devrf.calibration.field.steady import steadiness
from devrf.calibration.field.sweep import glance_at_sweep
from devrf.capture.frames import CameraFrames, grey_small, sharpness
from devrf.capture.pictures import list_pictures, read_picture
from devrf.capture.planned import planned_frames, sweep_pictures
from devrf.capture.progress import Progress
from devrf.capture.sampled import read_runs, spread_starts
from devrf.capture.session import CaptureSession
from devrf.capture.survey import Look, Picture, look_at, small
from devrf.pipelines.check import rows as check_rows
from devrf.pipelines.health.rows import HealthRow

SWEEP_PICTURES = 40  # whose neighbours are compared
SHARP_OF = 3  # successive pictures, of which the sharpest counts, as ingest takes the sharpest of a window
CLIP_PICTURES = 12  # that tell size, brightness and whether the camera stands
REST_PICTURES = 4


@dataclass(frozen=True)
class SweepSeen:
    """The sweep, looked at.

    Attributes:
        planned: What ingest will use of it.
        features: Of the pictures that are compared, in order.
        rows: What is said of them.
    """

    planned: CameraFrames
    features: list[Features]
    rows: list[HealthRow]


def see_sweep(path: Path, progress: Progress) -> SweepSeen:
    """Look at a clip or a folder of photos."""
    look = look_at(path, CLIP_PICTURES)
    used = sweep_pictures(look)
    chosen = used[np.unique(np.linspace(0, len(used) - 1, SWEEP_PICTURES).round().astype(int))]
    length = min(SHARP_OF, int(np.diff(chosen).min(initial=look.count)))  # runs that do not overlap
    found: list[Features] = []
    sharp: list[float] = []
    kept: list[int] = []
    runs = _read(look, chosen.tolist(), length)
    for n, (index, pictures) in enumerate(zip(chosen.tolist(), runs, strict=True)):
        progress(0.8 * n / len(chosen), "the sweep")
        if pictures:
            sharpest = max(pictures, key=_sharpness)
            sharp.append(_sharpness(sharpest))
            found.append(features(sharpest))
            kept.append(index)

    def between(n: int) -> Picture | None:
        inside = used[(used > kept[n]) & (used < kept[n + 1])]
        pictures = next(_read(look, [int(inside[len(inside) // 2])])) if len(inside) else []
        return pictures[0] if pictures else None

    progress(0.8, "overlap of the sweep")
    glance = glance_at_sweep(found, between)
    where = [f"{look.times_s[i]:.1f} s" if look.is_clip else f"photo {i + 1}" for i in kept]
    rows = check_rows.sweep_rows(glance, steadiness(look.greys), look.black, where)
    return SweepSeen(planned_frames(look, "sweep", path.name, sharpness=sharp), found, rows)


def camera_rows(name: str, look: Look, session: CaptureSession, sweep: Sequence[Features]) -> list[HealthRow]:
    """Look at a fixed camera's clip, and for its view in the sweep."""
    rest: list[Picture] = []
    if session.rest != "none":
        starts = spread_starts(look.times_s, 2, REST_PICTURES)
        at = starts[0] if session.rest == "start" else starts[-1]
        rest = [small(f.rgb) for f in next(read_runs(look.path, look.times_s, [at], REST_PICTURES))]
    at_rest = features(rest[0] if rest else look.pictures[0])
    glance = glance_at_fixed(look.pictures, rest, at_rest, sweep)
    steady = steadiness(look.greys)
    return check_rows.camera_rows(
        name, glance, steady, look.black, session.rest, has_sweep=session.static is not None
    )


def _read(look: Look, indices: Sequence[int], length: int = 1) -> Iterator[list[Picture]]:
    """Runs of pictures that begin at the given ones; of photos just these."""
    if look.is_clip:
        starts = [float(look.times_s[n]) for n in indices]
        for run in read_runs(look.path, look.times_s, starts, length):
            yield [small(frame.rgb) for frame in run]
    else:
        photos = list_pictures(look.path)
        yield from ([small(read_picture(photos[n])[:, :, :3])] for n in indices)


def _sharpness(picture: Picture) -> float:
    return sharpness(grey_small(picture))
