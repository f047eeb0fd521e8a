"""Flow held against the pictures that it is between: what they contradict does not count, and is counted."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from devrf.capture.system.cores import usable_cores
from devrf.flow.agreement import MOSTLY_CONTRADICTED, Agreement, agreement
from devrf.flow.store import BEST, CameraFlow
from devrf.reconstruct.rendering.rays import RaySet

# of a picture, for flow to be judged as a whole: where hardly anything moves, noise answers
FEWEST_ASKED = 0.01


@dataclass(frozen=True)
class CheckedFlow:
    """Flow of all cameras, and what pictures say of it.

    Attributes:
        flows: By camera, with their `agreement`; what is contradicted is not valid.
        contradicted: By camera: of the pixels where anything moves and pictures can tell, the share whose vectors they
            contradict. Only cameras with such pixels.
    """

    flows: dict[str, CameraFlow]
    contradicted: dict[str, float]


def checked_flow(rays: RaySet, flows: Mapping[str, CameraFlow]) -> CheckedFlow:
    """Ask the training pictures about each pair's flow; flow of other pictures or another size stays as it is.

    A pair that they mostly contradict where it moves does not count at all, nor does any of a camera whose flow they
    mostly contradict: what is left there moves too little to be told from right vectors, and is as wrong.
    """
    numbers: dict[str, dict[int, int]] = {}
    for n, frame in enumerate(rays.frames):
        numbers.setdefault(frame.camera_name, {})[frame.index] = n
    out, contradicted = dict(flows), {}
    for name, clip in flows.items():
        mine = numbers.get(name, {})
        order = sorted(mine)
        before = {index: mine[earlier] for earlier, index in zip(order, order[1:], strict=False)}
        agrees = np.full(clip.valid.shape, BEST, np.uint8)
        pairs = [(mine.get(index), before.get(index)) for index in clip.index.tolist()]
        with ThreadPoolExecutor(usable_cores()) as pool:  # its filters let other threads run
            answers = pool.map(partial(_asked, rays, clip), range(len(pairs)), pairs)
            found = {n: answer for n, answer in enumerate(answers) if answer is not None}
        for n, pair in found.items():
            agrees[n] = np.rint(BEST * pair.weight)
        asked, against = (sum(getattr(pair, x) for pair in found.values()) for x in ("asked", "contradicted"))
        if asked:
            contradicted[name] = against / asked
        for n, pair in found.items():
            pixels = agrees[n].size
            if _mostly(pair.contradicted, pair.asked, pixels) or _mostly(against, asked, pixels):
                agrees[n] = 0
        out[name] = replace(clip, agreement=agrees, valid=clip.valid & (agrees > 0))
    return CheckedFlow(out, contradicted)


def _asked(rays: RaySet, clip: CameraFlow, n: int, pair: tuple[int | None, int | None]) -> Agreement | None:
    """What two pictures say of a clip's flow from one to the other; None where one is missing or of another size."""
    if None in pair:
        return None
    current, previous = (rays.picture(number) for number in pair if number is not None)
    if not current.shape == previous.shape == (*clip.valid[n].shape, 3):
        return None
    return agreement(current, previous, clip.flow[n].astype(np.float32), clip.valid[n])


def _mostly(contradicted: int, asked: int, pixels: int) -> bool:
    """Whether that many of those asked are most of them, and more than noise in a picture of so many pixels."""
    return asked >= FEWEST_ASKED * pixels and contradicted > MOSTLY_CONTRADICTED * asked
