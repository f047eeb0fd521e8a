"""Backward flow that a data set brings with its pictures, checked like flow of our own.

The vectors lead to the picture before, in pixels of the size they are stored at, which may be smaller than the
pictures'. There is no flow the other way, so the round trip cannot be measured.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from devrf.capture.errors import FlowError
from devrf.capture.progress import Progress, no_progress
from devrf.capture.resize import shrink
from devrf.flow.clip import FlowChecks, Tally
from devrf.flow.consistency import resize_flow, supported
from devrf.flow.store import CameraFlow

METHOD = "given"  # in flow.json


def given_clip_flow(
    camera: str,
    index: Sequence[int],
    load: Callable[[int], UInt8[np.ndarray, "height width 3"]],
    load_flow: Callable[[int], tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]],
    size: tuple[int, int],
    progress: Progress = no_progress,
) -> tuple[CameraFlow, FlowChecks]:
    """Given backward flow of one camera's used frames, in order of time.

    Args:
        camera: Name, for the result and for messages.
        index: Frame numbers [N].
        load: Gives the n-th frame's full-size RGB picture.
        load_flow: Gives the n-th frame's vectors to the one before, and where they can be trusted (n > 0).
        size: (width, height) of the stored flow.
    Returns:
        N - 1 entries, and the checks.
    Raises:
        FlowError: Fewer than two frames.
    """
    if len(index) < 2:
        raise FlowError(f"camera {camera!r}: {len(index)} frame, expected at least two; check the data set")
    width, height = size
    vectors = np.zeros((len(index) - 1, height, width, 2), dtype=np.float16)
    valid = np.zeros((len(index) - 1, height, width), dtype=bool)
    tally = Tally()
    previous = load(0)
    for n in range(len(index) - 1):
        current = load(n + 1)
        flow, trusted = load_flow(n + 1)
        before, now = (shrink(picture, flow.shape[1], flow.shape[0]) for picture in (previous, current))
        tally.add(before, now, flow, None, supported(now), trusted)
        reduced, valid[n] = resize_flow(flow, trusted, width, height)
        vectors[n] = reduced.astype(np.float16)
        previous = current
        progress((n + 1) / (len(index) - 1), f"{camera}: {n + 1} of {len(index) - 1} pairs")
    return CameraFlow(camera, np.asarray(index[1:], dtype=np.int32), vectors, valid), tally.checks()
