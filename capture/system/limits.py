"""How large raw material, data sets, arrays and weights may be, asked by headers and sizes before they are decoded.

A file of a few kilobytes may claim a picture of gigabytes. No picture of today's cameras is above the limits, and one
file within them takes no more than some gigabytes. Texts of a format of its own (scene.yaml, calibrations) have their
limits beside their readers. docs/security.md lists all of them.
"""

import stat
from pathlib import Path

from devrf.capture.system.errors import CaptureError

PICTURE_PX = 250_000_000  # photos: medium format has 150 million pixels, sensor shift of full frame 240
CLIP_PX = 100_000_000  # of one picture of a clip: 12K cameras have 80 million
CLIP_S = 4 * 3600  # from a clip's first picture or sample to its last; its sound is held in memory: 2.8 GB
TEXT_BYTES = 100_000_000  # JSON, CSV: 100 000 pictures of a data set, or of timestamps, are a tenth of it
MODEL_BYTES = 1_000_000_000  # one file of a COLMAP model: 10 000 keypoints of a picture are 0.24 MB
ARRAY_BYTES = 1_000_000_000  # in one npy or npz, unpacked: flow of a picture of 8K takes 0.3 GB
WEIGHT_BYTES = 2_000_000_000  # in one file of weights, unpacked: VGG-16 has 0.55 GB


def check_pixels(path: Path, width: int, height: int, most: int = PICTURE_PX) -> None:
    """Refuse a picture of more than `most` pixels, by what its header says.

    Raises:
        CaptureError: It claims more, or none.
    """
    if width < 1 or height < 1:
        text = f"{path}: its header says {width}x{height} pixels; copy it from the camera again"
        raise CaptureError("file-damaged", text)
    if width * height > most:
        wrong = f"{path}: its header says {width}x{height}, {width * height / 1e6:.0f} million pixels"
        remedy = (
            f"at most {most / 1e6:.0f} million are read: make it smaller, or copy it again if it is damaged"
        )
        raise CaptureError("picture-too-large", f"{wrong}; {remedy}")


def check_bytes(path: Path, most: int, size: int | None = None) -> None:
    """Refuse a file of more than `most` bytes, and what is none; `size` is that of its content where it is packed.

    Raises:
        CaptureError: It is larger, or a device or a pipe.
        OSError: It cannot be looked at.
    """
    if is_device(path):
        raise CaptureError("file-is-device", f"{path}: is a device or a pipe; expected a file")
    size = path.stat().st_size if size is None else size
    if size > most:
        wrong = f"{path}: {size / 1e6:.0f} MB, at most {most / 1e6:.0f} MB are read of such a file"
        remedy = "is it another kind of file, or damaged? Copy it again"
        raise CaptureError("file-too-large", f"{wrong}; {remedy}")


def is_device(path: Path) -> bool:
    """Whether a path leads to a device, a pipe or a socket, of which a program may wait for ever for the end.

    Raises:
        OSError: It cannot be looked at.
    """
    mode = path.stat().st_mode
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def check_span(path: Path, seconds: float) -> None:
    """Refuse times of a clip that lie further apart than any recording is long.

    Raises:
        CaptureError: They do.
    """
    if not seconds <= CLIP_S:
        wrong = f"{path}: its times are {seconds:.0f} s apart, at most {CLIP_S} s are read"
        raise CaptureError("clip-too-long", f"{wrong}; cut the clip, or copy it again if it is damaged")
