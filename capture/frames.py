"""Frames on disk and what is known of each: time, sharpness, whether it is used; and how they are chosen.

A `FrameSet` is the content of `ingest.json`. Times are seconds of file time, or of the common clock where
a table of true times was given. Sharpness is the variance of the Laplacian of a grey picture brought to
one size; only ratios between frames of one camera mean something.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.capture.exif import Exif, exif_from_dict
from devrf.capture.measure import ENOUGH_CAMERAS, Measure
from devrf.capture.orientation import Upright, by_exif
from devrf.capture.system.amounts import some
from devrf.capture.system.errors import CaptureError

Role = Literal["sweep", "camera", "test", "board", "joint"]

SWEEP = "static"  # the sweep's name among the cameras
SHARPNESS_SIDE_PX = 640  # blur of one pixel at this size matters to matching; noise of single pixels does not
SHARP_SHARE_OF_MEDIAN = 0.5  # less than this times the neighbours' median: blurred
SHARP_NEIGHBOURS = 7  # on each side
VARIABLE_STEP = 0.05  # steps further than this share of the usual one from a multiple of it, ...
VARIABLE_STEP_S = 1.1e-3  # ... and by more than the rounding of millisecond time bases
VARIABLE_SHARE = 0.02  # ... in more than this share of the steps: a variable rate, not single drops
DROPPED_STEP = 1.5  # a step this many times the usual one: frames are missing


@dataclass(frozen=True)
class FrameRecord:
    """One frame of one source.

    Attributes:
        index: Position in the clip or in the sorted folder, from 0.
        time_s: File time or true time, seconds; None for photos and for frames without a known time.
        sharpness: Variance of the Laplacian.
        used: Whether later stages use it.
        file: Picture on disk, relative to the ingest folder; None where it was not kept.
        exif: What a photo's tags say of device, lens and place; None for frames of a video.
        photo: A photo's name in its folder; None for frames of a video.
        orientation: EXIF's number of how a photo was made upright, as its camera's others were; None for frames of a
            video.
        own_orientation: The number that its own tag says.
    """

    index: int
    time_s: float | None
    sharpness: float
    used: bool
    file: str | None
    exif: Exif | None = None
    photo: str | None = None
    orientation: int | None = None
    own_orientation: int | None = None

    @property
    def re_turned(self) -> Upright:
        """From the picture as its own tag makes it upright to the one that is used."""
        if self.orientation is None or self.own_orientation is None:
            return Upright()
        return by_exif(self.own_orientation).inverse.then(by_exif(self.orientation))

    @property
    def place(self) -> str:
        """What to call it in a message."""
        if self.photo is not None:
            return self.photo
        return f"frame {self.index}" if self.time_s is None else f"frame {self.index} ({self.time_s:.2f} s)"


@dataclass(frozen=True)
class CameraFrames:
    """All frames of one camera, of the sweep or of one board clip.

    Attributes:
        role: sweep, camera, test (never trained on), board or joint.
        source: Raw file or folder, relative to scene.yaml.
        width, height: Size of its pictures, upright, pixels.
        fps_mean: Mean rate, None for photos; never used for times.
        variable_rate: Whether the steps between timestamps differ.
        has_audio: Whether there is a sound track with something to hear.
        exif_focal_px: Focal length by EXIF, pixels, or None.
        rotation_deg: Turn that was applied, degrees counter-clockwise; of photos to those of this size.
        frames: Every frame, used or not.
        level: Median brightness over the clip, 0 to 255 (sRGB).
        audio_start_s: File time of the first sample of its sound, or None.
        created_s: When the file says it was made, seconds since 1970 UTC, or None.
        timecode_s: Timecode of its first frame, seconds of the day, or None.
        timecode_fps: Frames that the timecode counts in a second, or None.
        missing_frames: Frames that its timestamps say were dropped.
        ended_early: Where a damaged or truncated file ended, in words; None for a whole one.
        announced_frames: Frames the file announces, or None.
        mirrored: Whether columns were exchanged, left and right, before the turn.
        pixel_aspect: Width of a pixel over its height, as the file says.
        notes: What is unusual, one sentence each.
        faults: What is suspicious.
    """

    role: Role
    source: str
    width: int
    height: int
    fps_mean: float | None
    variable_rate: bool
    has_audio: bool
    exif_focal_px: float | None
    rotation_deg: int
    frames: tuple[FrameRecord, ...]
    level: float | None = None
    audio_start_s: float | None = None
    created_s: float | None = None
    timecode_s: float | None = None
    timecode_fps: float | None = None
    missing_frames: int = 0
    ended_early: str | None = None
    announced_frames: int | None = None
    mirrored: bool = False
    pixel_aspect: float = 1.0
    notes: tuple[str, ...] = ()
    faults: tuple[Measure, ...] = ()

    @property
    def upright(self) -> Upright:
        """How its pictures were made upright."""
        return Upright(self.rotation_deg // 90 % 4, self.mirrored)

    @property
    def used(self) -> tuple[FrameRecord, ...]:
        """The frames that later stages use."""
        return tuple(frame for frame in self.frames if frame.used)

    @property
    def no_lens(self) -> str | None:
        """What its pictures are, in words, where no lens makes such (`projection.py`)."""
        return next((str(f.value) for f in self.faults if f.code == "coding" and f.found == "fail"), None)

    def filmed(self, folder: Path) -> "list[PictureFile]":
        """The pictures of the frames that are used, where they were kept and their time is known.

        Args:
            folder: That of ingest.
        """
        kept = [(f.index, f.file, f.time_s) for f in self.used]
        return [PictureFile(n, folder / file, t) for n, file, t in kept if file is not None and t is not None]


@dataclass(frozen=True)
class PictureFile:
    """A picture on disk: its frame's position in the clip, its file and its file time, seconds."""

    index: int
    file: Path
    time_s: float


@dataclass(frozen=True)
class FrameSet:
    """Everything ingest leaves on disk.

    Attributes:
        cameras: Name -> frames: "static", the cameras, "board_<camera>", "joint_<camera>".
        joint: Camera -> name of the entry in `cameras` that shows the board to several cameras at once.
        true_times: Whether the cameras' times come from a table on one clock.
        left_out: Test camera that has no picture to measure with -> why.
    """

    cameras: dict[str, CameraFrames]
    joint: dict[str, str] = field(default_factory=dict)
    true_times: bool = False
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def trained(self) -> dict[str, CameraFrames]:
        """The fixed cameras that film the motion and are trained on; the first one's clock is the session's."""
        return self._of_role("camera")

    @property
    def tests(self) -> dict[str, CameraFrames]:
        """The fixed cameras that film the motion and are only measured with: nothing depends on what they show."""
        return self._of_role("test")

    @property
    def moving(self) -> dict[str, CameraFrames]:
        """The fixed cameras that film the motion, test cameras last."""
        return self.trained | self.tests

    @property
    def without_lens(self) -> dict[str, str]:
        """Fixed cameras whose pictures no lens makes -> what they are; of training only where enough others remain."""
        odd = {name: why for name, camera in self.moving.items() if (why := camera.no_lens) is not None}
        if len(self.trained.keys() - odd.keys()) >= ENOUGH_CAMERAS:
            return odd
        return {name: why for name, why in odd.items() if name in self.tests}

    def _of_role(self, role: Role) -> dict[str, CameraFrames]:
        return {name: c for name, c in self.cameras.items() if c.role == role}

    def write(self, folder: Path) -> None:
        """Write `ingest.json` into `folder`."""
        (folder / "ingest.json").write_text(json.dumps(asdict(self), indent=1))

    @staticmethod
    def read(folder: Path) -> "FrameSet":
        """Read `ingest.json` of `folder`.

        Raises:
            CaptureError: If it is missing or not what `write` wrote.
        """
        path = folder / "ingest.json"
        try:
            raw = json.loads(path.read_text())
            cameras = {name: _camera_frames(entry) for name, entry in raw["cameras"].items()}
            left_out = dict(raw.get("left_out", {}))
            return FrameSet(cameras, dict(raw["joint"]), bool(raw["true_times"]), left_out)
        except (OSError, ValueError, KeyError, TypeError) as error:
            text = f"{path}: cannot be read ({error!r}); run again with --from ingest"
            raise CaptureError("file-damaged", text) from None


def _camera_frames(raw: dict[str, Any]) -> CameraFrames:
    frames = tuple(FrameRecord(**{**frame, "exif": exif_from_dict(frame["exif"])}) for frame in raw["frames"])
    faults = tuple(Measure(**fault) for fault in raw["faults"])
    return CameraFrames(**{**raw, "frames": frames, "notes": tuple(raw["notes"]), "faults": faults})


# --- sharpness and choice ---


def grey_small(
    picture: UInt8[np.ndarray, "height width channels"], side_px: int = SHARPNESS_SIDE_PX
) -> UInt8[np.ndarray, "small_height small_width"]:
    """Grey picture whose longer side is at most `side_px`, area-averaged."""
    return shrunk(cv2.cvtColor(picture[:, :, :3], cv2.COLOR_RGB2GRAY), side_px)


def shrunk(
    picture: UInt8[np.ndarray, "height width *channels"], side_px: int
) -> UInt8[np.ndarray, "small_height small_width *channels"]:
    """A picture averaged to a longer side of at most `side_px`: by halves, and less than that by interpolation.

    A seventh of the time of averaging over areas in one step, because means of 2 x 2 pixels are fast.
    """
    if max(picture.shape[:2]) <= side_px:
        return np.array(picture)  # not a view: what it shows may be the decoder's
    while max(picture.shape[:2]) >= 2 * side_px and not (picture.shape[0] % 2 or picture.shape[1] % 2):
        half = (picture.shape[1] // 2, picture.shape[0] // 2)
        picture = cv2.resize(picture, half, interpolation=cv2.INTER_AREA)
    scale = side_px / max(picture.shape[:2])
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR if scale > 0.5 else cv2.INTER_AREA)


def sharpness(grey: UInt8[np.ndarray, "height width"]) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al., ICPR 2000); comparable within one camera only."""
    return float(cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))[1][0, 0] ** 2)


def window_of(index: int, count: int, windows: int) -> int:
    """Window of frame `index` when `count` frames are cut into at most `windows` nearly equal runs."""
    return index * min(windows, count) // count


def sharpest_per_window(values: Sequence[float], windows: int) -> list[int]:
    """Index of the sharpest frame of each of at most `windows` windows; all where there are fewer."""
    best: dict[int, int] = {}
    for i, value in enumerate(values):
        w = window_of(i, len(values), windows)
        if w not in best or value > values[best[w]]:
            best[w] = i
    return sorted(best.values())


def sharp(values: Sequence[float]) -> Bool[np.ndarray, " n"]:
    """Which frames [n] are at least half as sharp as the median of their neighbours."""
    v = np.asarray(values, dtype=np.float64)
    medians = [np.median(v[max(0, i - SHARP_NEIGHBOURS) : i + SHARP_NEIGHBOURS + 1]) for i in range(len(v))]
    return v >= SHARP_SHARE_OF_MEDIAN * np.asarray(medians)


# --- what timestamps tell ---


@dataclass(frozen=True)
class ClipTiming:
    """What a clip's timestamps tell: mean rate, whether it varies, frames dropped, and notes in words."""

    fps_mean: float | None
    variable_rate: bool
    missing_frames: int
    notes: tuple[str, ...]


def timing(time_s: Float[np.ndarray, " n"]) -> ClipTiming:
    """Look at increasing frame times [n], seconds."""
    if len(time_s) < 2:
        return ClipTiming(None, False, 0, ())
    steps = np.diff(time_s)
    usual = float(np.median(steps))
    tolerance = max(VARIABLE_STEP * usual, VARIABLE_STEP_S)
    whole = usual * np.maximum(1, np.round(steps / usual))  # dropped frames leave multiples
    variable = float(np.mean(np.abs(steps - whole) > tolerance)) > VARIABLE_SHARE
    notes = []
    if variable:
        notes.append(
            f"variable rate: steps from {1e3 * steps.min():.1f} to {1e3 * steps.max():.1f} ms; "
            "the timestamps are used"
        )
    gaps = np.flatnonzero(steps > max(DROPPED_STEP * usual, usual + VARIABLE_STEP_S))
    missing = 0
    if len(gaps):
        missing = int(np.round(steps[gaps] / usual - 1).clip(1).sum())
        where = some([f"{time_s[i]:.2f} s" for i in gaps])
        notes.append(f"{missing} frames missing in {len(gaps)} gaps, after {where}; the gaps are kept")
    fps_mean = float((len(time_s) - 1) / (time_s[-1] - time_s[0]))
    return ClipTiming(fps_mean, variable, missing, tuple(notes))
