"""A model in front of cameras over time: each moment is set once, and what cameras see then is kept for the next."""

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.lab.simulate.render.folder import OutputFolder
from devrf.lab.simulate.render.studio import Studio, StudioScene
from devrf.lab.simulate.render.true_geometry import TrueSurface, corners_of, flow_bwd
from devrf.lab.simulate.scenes.shapes import Model


class MomentCache:
    """The moments of a model, numbered; the last two are kept."""

    def __init__(self, studio: Studio, model: Model, times: Float[np.ndarray, " n"]) -> None:
        self._studio, self._model, self._times = studio, model, times
        self._stages: dict[int, StudioScene] = {}
        self._corners: dict[int, np.ndarray] = {}
        self._surfaces: dict[tuple[int, str], TrueSurface] = {}

    def stage(self, moment: int) -> StudioScene:
        """The scene at a moment."""
        if moment not in self._stages:
            self._stages = {m: s for m, s in self._stages.items() if abs(m - moment) < 2}
            self._corners = {m: c for m, c in self._corners.items() if m in self._stages}
            self._surfaces = {key: s for key, s in self._surfaces.items() if key[0] in self._stages}
            meshes = [part.at(float(self._times[moment])) for part in self._model]
            self._stages[moment] = self._studio.stage(meshes)
            self._corners[moment] = corners_of(meshes)
        return self._stages[moment]

    def surface(self, moment: int, name: str, camera: Camera) -> TrueSurface:
        """What the camera of this name sees at a moment."""
        if (moment, name) not in self._surfaces:
            triangles = self.stage(moment).triangles(camera)
            self._surfaces[moment, name] = TrueSurface(camera, triangles, self._corners[moment])
        return self._surfaces[moment, name]

    def write_truth(
        self, folder: OutputFolder, moment: int, name: str, camera: Camera, depth: str, flow: str
    ) -> None:
        """Write the camera's depth and, after the first moment, its flow, unless they are there.

        Args:
            folder: Data set.
            moment: Its number.
            name: Of the camera.
            camera: The camera; it does not move.
            depth, flow: Names of the files.
        """
        if not folder.has(depth):
            folder.arrays(depth, depth=self.surface(moment, name, camera).depth.astype(np.float32))
        if moment > 0 and not folder.has(flow):
            before = self.surface(moment - 1, name, camera)
            uv, mask = flow_bwd(self.surface(moment, name, camera), before)
            folder.arrays(flow, flow=uv.astype(np.float16), mask=mask)
