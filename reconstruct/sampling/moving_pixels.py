"""Where pictures of a camera that stands still change over time: the pixels worth drawing.

A change of colour tells, and so does flow: what moves over a ground of its own colour changes next to nothing.
"""

from collections import defaultdict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Int
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.system.cores import usable_cores
from devrf.flow.store import BEST, CameraFlow
from devrf.reconstruct.rendering.rays import RayBatch, RaySet

NOISE_FACTOR = 5.0  # a change is this many times the noise
LEAST_CHANGE = 0.04  # of the full range; compression alone changes half as much
MOVES_PX = 1.0  # of the training size: no method is that wrong where its flow is
SURE = BEST / 2  # confidence, from which a vector is believed
BLUR_REACH = 3  # pixels: three standard deviations
AT_ONCE = 1 << 20  # numbers
GROW = 0.015  # of the picture's width, around what changed: motion that is still to be explained lies there


class ChangingPixels:
    """Pixels that change, per picture; those of one camera share them."""

    def __init__(self, of_frame: list[Int[Tensor, " _"]]) -> None:
        self.of_frame = of_frame
        distinct = {id(pixels): pixels for pixels in of_frame}
        ends = np.cumsum([len(pixels) for pixels in distinct.values()]).tolist()
        self._all, end = torch.cat([*distinct.values()]), dict(zip(distinct, ends, strict=True))
        self._first = [end[id(pixels)] - len(pixels) for pixels in of_frame]

    def draw(
        self, n: int, frames: Int[Tensor, " f"], generator: torch.Generator
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """About `n` pixels of `frames`, each picture alike: (picture, pixel). None of pictures without change.

        Drawn on the CPU and sent to the pixels' device at once.
        """
        usable = [f for f in frames.tolist() if len(self.of_frame[f])]
        if not usable:
            return self._all[:0], self._all[:0]
        counts = [n // len(usable) + (i < n % len(usable)) for i in range(len(usable))]
        drawn = [
            self._first[f] + torch.randint(len(self.of_frame[f]), (count,), generator=generator)
            for f, count in zip(usable, counts, strict=True)
        ]
        frame = torch.tensor(usable).repeat_interleave(torch.tensor(counts))
        sent = torch.stack([frame, torch.cat(drawn)]).to(self._all.device)
        return sent[0], self._all[sent[1]]


def changing_pixels(rays: RaySet, flows: Mapping[str, CameraFlow] | None = None) -> ChangingPixels:
    """Find them: pictures with one pose are compared over time, against their own noise, and their flow is asked.

    Cameras that move while the scene does (every picture another pose) have none: all pixels are alike there.
    """
    groups: dict[tuple[object, ...], list[int]] = defaultdict(list)
    for n, camera in enumerate(rays.cameras):
        groups[camera.view].append(n)
    of_frame = [torch.zeros(0, dtype=torch.int64, device=rays.device)] * len(rays)
    for members in groups.values():
        if len(members) < 2:
            continue
        pixels = torch.from_numpy(np.flatnonzero(_changes(rays, members, flows or {}))).to(rays.device)
        for n in members:
            of_frame[n] = pixels
    return ChangingPixels(of_frame)


def grown_pixels(camera: Camera) -> int:
    """How many pixels a flicker counts for at most: 2 x 2 pixels that change as much as can be."""
    return (2 * BLUR_REACH + _grown_side(camera)) ** 2


def draw_with_importance(
    rays: RaySet,
    changing: ChangingPixels | None,
    n: int,
    share: float,
    pictures: Int[Tensor, " f"],
    generator: torch.Generator,
) -> RayBatch:
    """Draw `n` rays of pictures, a share of them where the pictures change (if anything does)."""
    if changing is not None and (chosen := round(n * share)):
        frame, pixel = changing.draw(chosen, pictures, generator)
        if len(frame):
            rest = rays.draw(n - len(frame), generator, pictures)
            return rays.at(torch.cat([frame, rest.frame]), torch.cat([pixel, rest.pixel]))
    return rays.draw(n, generator, pictures)


def same(rays: RaySet, a: int, b: int) -> bool:
    """Whether two pictures of a camera show the same; not where it has moved, nor of one picture twice."""
    if a == b or rays.cameras[a].view != rays.cameras[b].view:
        return False
    one, other = (_smooth(rays.picture(n)).astype(np.float32) / 255 for n in (a, b))
    return not _as_a_whole(np.abs(one - other).max(axis=2)).any()


def _changes(rays: RaySet, members: list[int], flows: Mapping[str, CameraFlow]) -> np.ndarray:
    """True where the pictures of one camera change or move [H, W], and a little around."""
    camera = rays.cameras[members[0]]
    with ThreadPoolExecutor(usable_cores()) as pool:  # NumPy and SciPy let other threads run
        smooth = np.stack([*pool.map(lambda n: _smooth(rays.picture(n)), members)])
        apart = np.empty(smooth.shape[1:3], np.float32)
        rows = max(1, AT_ONCE // smooth[:, 0].size)

        def compare(at: int) -> None:
            band = smooth[:, at : at + rows].astype(np.float32) / 255
            apart[at : at + rows] = np.abs(band - np.median(band, axis=0)).max(axis=(0, 3))

        # In bands: in floating point all would be many times as large.
        list(pool.map(compare, range(0, len(apart), rows)))
    blocks = _as_a_whole(apart)
    for name in {rays.frames[n].camera_name for n in members} & flows.keys() if flows else ():
        if flows[name].flow.shape[1:3] == blocks.shape:
            blocks |= _moves(flows[name])
    return maximum_filter(blocks, size=_grown_side(camera), mode="constant")


def _grown_side(camera: Camera) -> int:
    """Side of the square that a change of 2 x 2 pixels grows to."""
    return 2 * max(1, round(GROW * camera.width)) + 2


def _moves(clip: CameraFlow) -> np.ndarray:
    """Where flow moves at any time, and is sure of it [H, W]."""
    out = np.zeros(clip.flow.shape[1:3], bool)
    for n, vectors in enumerate(clip.flow):
        sure = clip.valid[n]
        if clip.confidence is not None:
            sure = sure & (clip.confidence[n] >= SURE)
        out |= _whole_blocks(sure & (np.hypot(*vectors.astype(np.float32).transpose(2, 0, 1)) > MOVES_PX))
    return out


def _as_a_whole(apart: np.ndarray) -> np.ndarray:
    """Where 2 x 2 pixels differ as a whole, by more than their noise [H, W]."""
    return _whole_blocks(apart > max(LEAST_CHANGE, NOISE_FACTOR * float(np.median(apart))))


def _whole_blocks(mask: np.ndarray) -> np.ndarray:
    return minimum_filter(mask, size=2, mode="constant", cval=1)


def _smooth(picture: np.ndarray) -> np.ndarray:
    """Blurred by a pixel; noise of single pixels is no motion. Rounded again, which saves memory."""
    blurred = gaussian_filter(picture.astype(np.float32), (1, 1, 0), mode="mirror", radius=BLUR_REACH)
    return blurred.round().astype(np.uint8)
