"""Bytes by the size of pictures: how many of them a stage works on at once, to keep within the memory that is allowed.

Memory is that of the whole process, with the libraries and the processes it starts. Each rate was measured with what
takes the memory in a process of its own (docs/budgets.md); those of training are in `reconstruct/adapt/footprint.py`.
Where not even one picture fits, one is tried: the memory of the run is watched, whatever is expected here.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.calibration.sweep.static_poses import FINE_OCTAVE_BELOW, MAX_IMAGE_SIZE
from devrf.capture.system.cores import usable_cores
from devrf.pipelines.stage import StageContext

if TYPE_CHECKING:  # at run time they bring OpenCV, which a data set with its own flow does not need
    from devrf.capture.frames import CameraFrames
    from devrf.capture.session import CaptureSession

BASE = 420_000_000  # bytes: Python with NumPy, SciPy, OpenCV and PyTorch; 0.36 to 0.41 GB
SFM_WORKER = 160_000_000  # bytes: the process of pycolmap with nothing to do
SWEEP_PICTURE = 3_000_000  # bytes: a sweep picture's features, matches and points while the sweep is mapped
REGISTERED = 1_000_000  # bytes: and while fixed cameras are registered to it
SOUND_READ = 48_000 * 16  # bytes a second of decoded sound
FILM = 900_000_000  # bytes: the process while it unpacks a model: the example's

# Bytes for each pixel of a picture
SIFT = 80  # in which features are found, at the size at which they are: blurred copies and gradients
SIFT_READ = 5  # and at the full size, for reading
BOARD = 30  # of a picture with a board, looked at one after the other
PAIR_FLOW = 190  # of a pair whose flow is found, both ways, and checked (480x360 to 3840x2160: 160 to 200)
REFERENCES = 12  # that the decoder of a clip keeps to predict others from; twice with more than 8 bits
DECODED, DECODED_DEEP = 7, 30  # for each one decoded or written; with more than 8 bits, on its way to 8
PHOTO, RAW = 10, 30  # a photo read and measured; a RAW photo developed (12 to 24 megapixels: 23 to 29)
RENDERED, WITH_DEPTH = 230, 330  # of a film's picture; measured: 136 before white, surroundings more

# of the sweep's pictures; features below that are too few to match
SIDES_PX = (MAX_IMAGE_SIZE, 960, 720, 540)


def ingested_at_once(context: StageContext, session: "CaptureSession") -> int:
    """Pictures in memory at once, of whatever raw file they are."""
    from devrf.capture.photos.photo_folders import list_pictures
    from devrf.capture.photos.raw import is_raw
    from devrf.capture.video.reader import probe_video

    held, each, sound_s = [0], [0], 0.0
    heard = {*session.cameras.values(), *session.joint_clips.values()}
    for path in {session.static, *session.board_clips.values(), *heard} - {None}:
        if path.is_dir():
            first = list_pictures(path)[0]
            (each if is_raw(first) else held).append(photo_bytes(first))
            continue
        clip = probe_video(path)
        deep, pixels = clip.bits > 8, clip.width * clip.height
        held.append((REFERENCES + REFERENCES * deep) * pixels)
        each.append((DECODED_DEEP if deep else DECODED) * pixels)
        sound_s += clip.duration_s or 0.0 if clip.has_audio and path in heard else 0.0
    base = BASE + max(held) + int(SOUND_READ * sound_s)
    return fitting(context, base + max(each), max(each))  # the writer has one more in its hands


def photo_bytes(path: Path) -> int:
    """What a photo takes while it is read and measured, or developed, by its header."""
    from devrf.capture.photos.raw import is_raw
    from devrf.capture.photos.upright_pictures import probe_picture

    photo = probe_picture(path)
    return (RAW if is_raw(path) else PHOTO) * photo.width * photo.height


def swept_at_once(context: StageContext, sweep: "CameraFrames") -> tuple[int, int]:
    """Pictures of the sweep that are searched for features at once, and the longer side at which they are, pixels.

    A smaller side only where not even one picture fits at a larger one.
    """
    allowed = context.allowance.memory
    base = BASE + SFM_WORKER + SIFT_READ * sweep.width * sweep.height + SWEEP_PICTURE * len(sweep.used)
    sides = (px for px in SIDES_PX if allowed is None or base + _sift_bytes(sweep, px) <= allowed)
    side_px = next(sides, SIDES_PX[-1])
    return fitting(context, base, _sift_bytes(sweep, side_px)), side_px


def registered_at_once(context: StageContext, cameras: "Sequence[CameraFrames]", sweep_pictures: int) -> int:
    """Pictures of fixed cameras that are searched for features at once."""
    pixels = max(camera.width * camera.height for camera in cameras)
    base = BASE + SFM_WORKER + BOARD * pixels + REGISTERED * sweep_pictures
    return fitting(context, base, max(_sift_bytes(camera, MAX_IMAGE_SIZE) for camera in cameras))


def flow_at_once(context: StageContext, pixels: int) -> int:
    """Pairs of pictures of so many pixels whose flow is found at once."""
    return fitting(context, BASE, PAIR_FLOW * pixels)


def fitting(context: StageContext, base: int, each: int) -> int:
    """How many pictures of `each` bytes fit beside `base` bytes, of one for each core; fewer are said."""
    most, allowed = usable_cores(), context.allowance.memory
    if allowed is None or base + most * each <= allowed:
        return most
    count = max(1, min(most, (allowed - base) // max(1, each)))
    if count < most:
        context.say(f"  {count} instead of {most} at once, to keep within the memory that is allowed")
    return count


def _sift_bytes(camera: "CameraFrames", side_px: int) -> int:
    """Of a picture as SIFT blurs it: reduced, or doubled where it is small."""
    longest = max(camera.width, camera.height)
    scale = min(1.0, side_px / longest) * (2 if longest <= FINE_OCTAVE_BELOW else 1)
    return int(SIFT * camera.width * camera.height * scale**2)
