"""The flow of one camera's clip, pair by pair: in parallel, in bounded memory, and resumed where it was stopped.

Flow is computed backward, from each used frame to the one before it, on pictures of the size that they are loaded
at, and then reduced to the size the model is trained at. Across a gap in the clip (dropped frames) there is none: the
entry is there, and nowhere valid. A clip is one camera's, so no pair ever crosses from one camera to another.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from devrf.capture.system.errors import FlowError
from devrf.capture.system.progress import Progress, no_progress
from devrf.flow.checks import FlowChecks, PairChecks, summary
from devrf.flow.pair import Find, Load, measured
from devrf.flow.store import pair_path, read_checks, write_pair

GAP = 1.5  # a time step longer than this many median steps has lost at least one frame
ASKED_ELSEWHERE = 8  # pairs of a clip whose flow is tried on other pairs too: these need more pictures


def gaps_of(camera: str, time: Sequence[float] | Float[np.ndarray, " n"]) -> Bool[np.ndarray, " pairs"]:
    """Between which frames others are missing.

    Raises:
        FlowError: Fewer than two frames, or times that do not rise.
    """
    steps = np.diff(np.asarray(time, dtype=np.float64))
    if len(steps) == 0 or not (steps > 0).all():
        wrong = f"camera {camera!r}: {len(time)} frames at times {[round(float(t), 4) for t in time][:5]}…"
        expected = "expected at least two at rising times; check the clip and its timestamps"
        raise FlowError("times-not-rising", f"{wrong}, {expected}")
    return steps > GAP * np.median(steps)


@dataclass(frozen=True)
class ClipPictures:
    """One camera's used frames, in order of time.

    Attributes:
        camera: Name, for files and messages.
        index: Frame numbers [N].
        gap: Between which frames there is no flow [N - 1, the pairs].
        load: Gives the n-th frame's RGB picture; asked from several threads.
    """

    camera: str
    index: Sequence[int]
    gap: Bool[np.ndarray, " pairs"]
    load: Load


def clip_flow(
    clip: ClipPictures,
    size: tuple[int, int],
    find: Find,
    folder: Path,
    workers: int = 1,
    progress: Progress = no_progress,
) -> FlowChecks:
    """Write the backward flow of a clip; pairs that are there are kept.

    Args:
        clip: The frames.
        size: (width, height) of the stored flow.
        find: Gives the flow of a pair; asked from as many threads as there are workers.
        folder: Where `<camera>/<index>.npz` are written, and looked for.
        workers: Pairs worked on at once, of which each holds its pictures and flow.
        progress: Told how far it is.
    Raises:
        FlowError: Pictures of different sizes, or that no method takes.
    """
    camera, index, gap = clip.camera, clip.index, clip.gap
    pairs = range(1, len(index))
    whole = [n for n in pairs if not gap[n - 1]]
    asked = set(whole[:: max(1, len(whole) // ASKED_ELSEWHERE)])

    def make(n: int) -> PairChecks:
        path = pair_path(folder, camera, index[n])
        try:
            return PairChecks(**read_checks(path))
        except (FlowError, TypeError):
            pass  # not made yet, or cut off
        if gap[n - 1]:
            found = np.zeros((size[1], size[0], 2), np.float32), np.zeros(size[::-1], np.uint8), PairChecks()
        else:
            try:
                found = measured(find, n, clip.load, size, n in asked, len(index) - 1)
            except FlowError as error:
                text = f"camera {camera!r}: frames {index[n]} and {index[n - 1]}: {error}"
                raise FlowError(error.code, text) from error
        write_pair(path, found[0], found[1], asdict(found[2]))
        return found[2]

    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(make, n) for n in pairs]
        try:
            checks = []
            for future in futures:
                checks.append(future.result())
                progress(len(checks) / len(pairs), f"{camera}: {len(checks)} of {len(pairs)} pairs")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return summary([checks[n - 1] for n in whole], int(gap.sum()))
