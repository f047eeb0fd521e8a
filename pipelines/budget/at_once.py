"""How many pictures a stage works on at once, so that it keeps within the memory that is allowed: bytes by their size.

Memory is that of the whole process, with the libraries and the processes it starts. Each rate was measured with what
takes the memory in a process of its own (docs/budgets.md). Where not even one picture fits, one is tried: the memory
of the run is watched, whatever is expected here.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from devrf.calibration.sweep.static_poses import FINE_OCTAVE_BELOW, MAX_IMAGE_SIZE
from devrf.capture.cores import usable_cores
from devrf.pipelines.stage import StageContext

if TYPE_CHECKING:  # at run time it brings OpenCV, which a data set with its own flow does not need
    from devrf.capture.frames import CameraFrames

BASE = 420_000_000  # bytes: Python with NumPy, SciPy, OpenCV and PyTorch; 0.36 to 0.41 GB
SFM_WORKER = 160_000_000  # bytes: the process of pycolmap with nothing to do
SWEEP_PICTURE = 3_000_000  # bytes: a sweep picture's features, matches and points while the sweep is mapped
REGISTERED = 1_000_000  # bytes: and while fixed cameras are registered to it

# Bytes for each pixel of a picture
SIFT = 80  # in which features are found, at the size at which they are: blurred copies and gradients
SIFT_READ = 5  # and at the full size, for reading
BOARD = 30  # of a picture with a board, looked at one after the other
PAIR_FLOW = 190  # of a pair whose flow is found, both ways, and checked (480x360 to 3840x2160: 160 to 200)

# of the sweep's pictures; features below that are too few to match
SIDES_PX = (MAX_IMAGE_SIZE, 960, 720, 540)


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
