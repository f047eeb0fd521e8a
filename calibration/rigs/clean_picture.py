"""One clean picture per fixed camera, for matching with the sweep: the scene without what moves in it.

Candidates: the median over the whole clip removes what moves and the noise; the median of the few frames at rest shows
the scene exactly as the sweep saw it. When that is need not be known: which one registers best is decided there.
"""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.rest import Rest
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.spread import spread

CLIP_FRAMES = 21  # of the whole clip's median
REST_FRAMES = 3
REST_MOMENTS = ("start", "middle", "end")  # when a clip may show the rest


def clean_pictures(name: str, files: list[Path], rest: Rest, out: Path) -> list[Path]:
    """Write the candidates `<name>_start.png`, `_middle` or `_end` (where there may be a rest) and `_clip` into `out`.

    Args:
        name: Of the camera.
        files: Its frames in order of time.
        rest: When the clip shows the scene as in the sweep; auto: at its start or at its end.
        out: Existing folder.
    """
    if not files:
        text = f"camera '{name}' has no frames; check its clip and capture.range_s"
        raise CaptureError("pictures-none", text)
    candidates = {
        moment: [files[n] for n in rest_frames(moment, len(files))]
        for moment in (("start", "end") if rest == "auto" else (rest,))
        if moment != "none"
    }
    candidates["clip"] = spread(files, CLIP_FRAMES)
    written = []
    for label, sources in candidates.items():
        path = out / f"{name}_{label}.png"
        write_png(path, median_picture(sources))
        written.append(path)
    return written


def rest_frames(moment: str, count: int) -> range:
    """Which of a clip's frames are at its `start`, `middle` or `end`."""
    last = max(0, count - REST_FRAMES)
    first = {"start": 0, "middle": last // 2}.get(moment, last)
    return range(first, min(count, first + REST_FRAMES))


def median_picture(files: list[Path]) -> UInt8[np.ndarray, "h w 3"]:
    """Median over pictures, per pixel and channel, RGB."""
    try:
        pictures = [read_pixels(file)[:, :, :3] for file in files]
    except CaptureError as error:
        raise CaptureError(error.code, f"{error}; run again with --from ingest") from None
    if len(pictures) == 1:
        return pictures[0]
    return np.median(np.stack(pictures), axis=0).round().astype(np.uint8)
