"""By how much later a camera that is not trained on took its pictures than its clock says.

Without sound such a clock may be known to a few pictures only, and where things move fast an error of one picture costs
more than anything that is to be measured with the camera. One number is found, by where things are on their way:
optical flow from what the model shows at a time to what the camera shows, along the flow from there to a moment later.
No colours are compared, nothing else is fitted, and the model stays as it is. Every other picture is asked, so that the
others can be scored with it (`evaluate.py`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from devrf.capture.photos.picture_files import to_8_bits
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.capture.system.spread import spread
from devrf.flow.estimator import FlowEstimator
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.sampling.pictures import in_two
from devrf.reconstruct.tracking.offsets import CLEAR, SIGMAS

PICTURES = 12  # that are looked at, evenly
# times between two pictures, from which the way is seen: the first one in which enough goes
AHEAD = (1, 2, 4)
LEAST_WAY = 1.0  # pixels that it goes then
ROUNDS = 3  # flow is surer the less is left
SETTLED = 0.05  # of the time between two pictures: less is no reason to look again
FEWEST_PIXELS, FEWEST_PICTURES = 30, 4  # that show something on its way


@dataclass(frozen=True)
class ViewOffset:
    """What was found of a camera's clock.

    Attributes:
        offset_s: Seconds by which it took its pictures later than the scene says; None where that is not clear.
        why: Why there is none; empty where there is one.
    """

    offset_s: float | None
    why: str = ""


def view_offset(scene: Scene, model: DynamicModel, camera_name: str, estimator: FlowEstimator) -> ViewOffset:
    """By how much later than the scene says a camera took its pictures, by those in even places.

    Args:
        scene: In the box frame, with the times that the model was trained with.
        model: What was learned.
        camera_name: Of the camera.
        estimator: Of optical flow.
    """
    even, odd = in_two([f for f in scene.dynamic if f.camera_name == camera_name])
    if len(even) < FEWEST_PICTURES:
        return ViewOffset(None, f"{len(even)} pictures to find it on, at least {FEWEST_PICTURES} are needed")
    gap = float(np.median(np.diff(sorted(f.time or 0.0 for f in even + odd))))
    chosen = spread(even, PICTURES)
    true = [load_image(f, scene.image_scale, scene.background) for f in chosen]
    offset, std = 0.0, np.inf
    for _ in range(ROUNDS):
        every = (_late(scene, model, view, offset, gap, estimator) for view in zip(chosen, true, strict=True))
        said = [late for late in every if late is not None]
        if len(said) < FEWEST_PICTURES:
            return ViewOffset(None, "too few pictures show something on its way")
        more = float(np.median(said))
        std = gap * 1.4826 * float(np.median(np.abs(np.array(said) - more))) / np.sqrt(len(said))
        offset += gap * more
        if abs(more) < SETTLED:
            break
    if abs(offset) <= max(CLEAR * gap, SIGMAS * std):
        return ViewOffset(None, "not clear: within chance of the clock as it was calibrated")
    return ViewOffset(offset * (scene.t1_s - scene.t0_s))


def _late(
    scene: Scene,
    model: DynamicModel,
    view: tuple[PosedFrame, UInt8[np.ndarray, "h w 3"]],
    offset: float,
    gap: float,
    estimator: FlowEstimator,
) -> float | None:
    """What one picture says beside an offset, in times between two pictures; None where nothing is on its way."""
    frame, true = view
    assert frame.time is not None
    time, camera = frame.time + offset, frame.camera.scaled(scene.image_scale)
    if not 0 <= time <= 1:
        return None
    here = to_8_bits(render_view(model, camera, time))
    for ahead in AHEAD:
        step = gap * (ahead if time + ahead * gap <= 1 else -ahead)
        if time + step < 0:
            return None
        way = estimator.estimate(here, to_8_bits(render_view(model, camera, time + step)))
        goes = np.square(way).sum(-1) > LEAST_WAY**2
        if goes.sum() >= FEWEST_PIXELS:
            break
    else:
        return None
    along = way[goes] * (gap / step)
    squared = np.square(along).sum(-1)
    left = estimator.estimate(here, true)[goes]
    said = (left * along).sum(-1) / squared
    return float(np.quantile(said, 0.5, weights=squared, method="inverted_cdf"))
