"""How good a model is while it is still being trained."""

from functools import partial

import numpy as np

from devrf.capture.scene import Scene, load_image
from devrf.reconstruct.evaluation.evaluate import Render
from devrf.reconstruct.evaluation.metrics import Comparison
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.storage.watch import Watch

VIEWS = 6  # of the test views, spread over time


class Looks:
    """PSNR of a few test views while a model is trained, off the clock.

    Args:
        scene: Its moving test views are looked at.
        every_s: Seconds of training to the second look of a `Watch`; later ones come less often.
    """

    def __init__(self, scene: Scene, every_s: float = 0.0) -> None:
        scene = scene.in_box_frame()
        test = sorted((f for f in scene.dynamic if f.split == "test"), key=lambda f: (f.time or 0.0, f.index))
        chosen = sorted({round(n) for n in np.linspace(0, len(test) - 1, min(VIEWS, len(test)))})
        self._cameras = [(test[n].camera.scaled(scene.image_scale), test[n].time) for n in chosen]
        self._true = [
            load_image(test[n], scene.image_scale, scene.background).astype(np.float32) / 255 for n in chosen
        ]
        self._every_s = every_s
        self._seen: list[dict[str, float]] = []

    def of_rest(self) -> Watch:
        """Of the scene at rest."""
        return Watch(self._every_s, lambda rest, seconds: self._see(DynamicModel(rest), seconds))

    def of_motion(self, rest: RestModel) -> Watch:
        """Of the motion of a scene."""

        def look(motion: MotionField, seconds: float) -> None:
            self._see(DynamicModel(rest, motion), seconds)

        return Watch(self._every_s, look)

    def taken(self) -> list[dict[str, float]]:
        """Looks since this was last asked for: `seconds` of this training, mean `psnr`, dB."""
        seen, self._seen = self._seen, []
        return seen

    def at(self, render: Render, seconds: float) -> None:
        """Look at what a model renders after so many seconds of training."""
        scores = [
            Comparison(render(camera, time), true).whole().psnr
            for (camera, time), true in zip(self._cameras, self._true, strict=True)
        ]
        mean = float(np.mean([s for s in scores if s is not None]))
        self._seen.append({"seconds": round(seconds, 2), "psnr": round(mean, 3)})

    def _see(self, model: DynamicModel, seconds: float) -> None:
        self.at(partial(render_view, model), seconds)
