"""What `check` looks at in the sweep and in each fixed camera's clip, a few pictures of each, and its health rows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from devrf.calibration.preview.matching import Features, features
from devrf.calibration.preview.overlap import ENOUGH, overlap_of, shared_features
from devrf.calibration.preview.stability import steadiness
from devrf.capture.frames import CameraFrames, FrameRecord, Role, grey_small, sharpness, timing
from devrf.capture.ingest.ingest import MAX_SWEEP_FRAMES, with_clock_cues
from devrf.capture.ingest.recordings import chapter_faults
from devrf.capture.ingest.stillness import moving_mask, moving_share, smooth_grey
from devrf.capture.ingest.survey import ENDS, Footage, Picture, pictures_at, small
from devrf.capture.measure import Measure
from devrf.capture.photos.photo_folders import list_pictures, unread_faults
from devrf.capture.photos.upright_pictures import probe_picture, read_picture, shared_turns
from devrf.capture.projection import projection_faults
from devrf.capture.rest import Rest
from devrf.capture.system.doubles import doubles
from devrf.capture.system.progress import Progress
from devrf.capture.system.spread import spread
from devrf.capture.video.audio import Sound
from devrf.capture.video.sampled import read_runs
from devrf.capture.video.timestamps import FrameTimes, table_factor, table_faults

SWEEP_PICTURES = 40  # whose neighbours are compared
SHARP_OF = 3  # successive pictures, of which the sharpest counts, as ingest takes the sharpest of a window
LISTED = 4  # places named in a message
FEWEST_SHARED = 12.0  # features of one picture; stage rig finds more points, and refuses below 30


@dataclass(frozen=True)
class SweepSeen:
    """The sweep, looked at.

    Attributes:
        frames: What ingest will make of it.
        features: Of the pictures that are compared, in order.
        measures: What is said of them.
    """

    frames: CameraFrames
    features: list[Features]
    measures: list[Measure]


def planned_frames(
    look: Footage, role: Role, source: str, sound: Sound | None = None, true: FrameTimes | None = None
) -> CameraFrames:
    """Frames and times of one camera as `ingest` would write them, without pictures and sharpness."""
    seen = timing(look.times_s)
    used = set(range(look.count) if role != "sweep" else _sweep_pictures(look).tolist())
    times = look.times_s.tolist() or [None] * look.count
    faults = [] if true is None else table_faults(table_factor(true, dict(enumerate(look.times_s.tolist()))))
    faults += projection_faults(look.projection)
    faults += chapter_faults(look.path) if look.is_clip else unread_faults(look.path)
    frames = CameraFrames(
        role=role,
        source=source,
        width=look.width,
        height=look.height,
        fps_mean=seen.fps_mean,
        variable_rate=seen.variable_rate,
        has_audio=False,
        exif_focal_px=None,
        rotation_deg=0,
        frames=tuple(FrameRecord(n, t, np.nan, n in used, None) for n, t in enumerate(times)),
        level=look.level,
        missing_frames=seen.missing_frames,
        notes=(*look.notes, *seen.notes),
        faults=tuple(faults),
    )
    return frames if role == "sweep" else with_clock_cues(frames, sound, look.path, whole=true is None)


def see_sweep(look: Footage, progress: Progress) -> SweepSeen:
    """Look for sharpness, overlap and depth along a clip or a folder of photos."""
    used = _sweep_pictures(look)
    chosen = np.array(spread(used.tolist(), SWEEP_PICTURES))
    length = min(SHARP_OF, int(np.diff(chosen).min(initial=look.count)))  # runs that do not overlap
    found: list[Features] = []
    sharp: list[float] = []
    kept: list[int] = []
    for n, pictures in enumerate(_read(look, chosen.tolist(), length)):
        progress(0.8 * n / len(chosen), "the sweep")
        if pictures:
            sharpest = max(pictures, key=_sharpness)
            sharp.append(_sharpness(sharpest))
            found.append(features(sharpest))
            kept.append(int(chosen[n]))

    def between(n: int) -> Picture | None:
        inside = used[(used > kept[n]) & (used < kept[n + 1])]
        pictures = next(_read(look, [int(inside[len(inside) // 2])])) if len(inside) else []
        return pictures[0] if pictures else None

    progress(0.8, "overlap of the sweep")
    frames = planned_frames(look, "sweep", look.path.name)
    if sharp:  # each stands for the pictures around it
        of_all = [sharp[n * len(sharp) // look.count] for n in range(look.count)]
        frames = replace(
            frames, frames=tuple(replace(f, sharpness=s) for f, s in zip(frames.frames, of_all, strict=True))
        )
    if look.black:
        return SweepSeen(frames, found, [_black("sweep-blurred", "the sweep")])
    where = [f"{look.times_s[i]:.1f} s" if look.is_clip else f"photo {i + 1}" for i in kept]
    overlap = overlap_of(found, between)
    breaks = [f"{where[n]} to {where[n + 1]}" for n in overlap.breaks[:LISTED]]
    facts = {"enough": ENOUGH, "breaks": ", ".join(breaks)}
    measures = [Measure("sweep-overlap", overlap.linked, facts=facts)]
    if steadiness(look.greys).stands:
        measures.append(Measure("sweep-depth", "its background stands still", why="stands", found="fail"))
    measures.append(Measure("sweep-depth", overlap.depth_share))
    return SweepSeen(frames, found, measures)


def camera_measures(name: str, look: Footage, rest: Rest, sweep: Sequence[Features]) -> Iterator[Measure]:
    """Look at a fixed camera's clip, and for its view in the sweep; `sweep` is empty without one."""
    if look.black:
        yield _black("subject-small", name)
        return
    steady = steadiness(look.greys)
    if steady.stands is not None:
        lost = np.isnan(steady.moved)
        moved = "its background is never found again" if lost else 100 * steady.moved
        yield Measure("camera-moves", moved, name, found="fail")
    moves = moving_mask([smooth_grey(picture) for picture in look.pictures])
    yield Measure("subject-small", float(moves.mean()), name)
    at_rest = list(look.pictures[:1])
    if rest in ("auto", "start", "end"):
        ends = {end: pictures_at(look, end) for end in ENDS if rest in ("auto", end)}
        moving = {end: moving_share([smooth_grey(p) for p in pictures]) for end, pictures in ends.items()}
        known = {end: share for end, share in moving.items() if share is not None}
        end = min(known or ends, key=lambda end: known.get(end, 0.0))
        at_rest = ends[end]
        if sweep and steady.stands is not False:
            share = moving[end]
            yield Measure("rest-unseen", None if share is None else 100 * share, name, facts={"end": end})
    if sweep:
        shared = shared_features(features((at_rest or look.pictures)[0]), sweep)
        yield Measure("camera-points", float(shared), name, fail=FEWEST_SHARED)


def _sweep_pictures(look: Footage) -> np.ndarray:
    """About which pictures of a sweep are used [n]: one of each window of a clip, every photo that is no copy."""
    if not look.is_clip:
        return np.setdiff1d(np.arange(look.count), list(doubles(list_pictures(look.path))))
    if look.count <= MAX_SWEEP_FRAMES:
        return np.arange(look.count)
    return ((np.arange(MAX_SWEEP_FRAMES) + 0.5) * look.count / MAX_SWEEP_FRAMES).astype(np.int64)


def _read(look: Footage, indices: Sequence[int], length: int = 1) -> Iterator[list[Picture]]:
    """Runs of pictures that begin at the given ones; of photos just these."""
    if look.is_clip:
        starts = [float(look.times_s[n]) for n in indices]
        for run in read_runs(look.path, look.times_s, starts, length):
            yield [small(frame.rgb) for frame in run]
    else:
        photos = list_pictures(look.path)
        turns = shared_turns([probe_picture(photo) for photo in photos])
        yield from ([small(read_picture(photos[n], turns[n])[:, :, :3])] for n in indices)


def _sharpness(picture: Picture) -> float:
    return sharpness(grey_small(picture))


def _black(code: str, name: str) -> Measure:
    return Measure(code, "its picture is black", name, "black", found="fail")
