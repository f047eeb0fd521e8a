"""Points on the surfaces of the scene at rest, which are followed through time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from devrf.capture.scene import Scene
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.geometry.cloud import Cloud, point_cloud
from devrf.reconstruct.geometry.seen import SeenView, look, poses
from devrf.reconstruct.rendering.model import DynamicModel

SPACING = 1.2  # voxels between points: with 1.5 small things are lost
OF_SWEEP = 24  # poses of the sweep: by 8 a quarter of the points is missing, on leaves and between limbs more


@dataclass(frozen=True)
class SurfacePoints(Cloud):
    """Surface points at rest.

    Attributes:
        spacing: Their distance from one another.
    """

    spacing: float

    def __len__(self) -> int:
        """Number of points."""
        return len(self.xyz)

    def only(self, kept: Bool[np.ndarray, " n"]) -> "SurfacePoints":
        """Some of the points."""
        return SurfacePoints(self.xyz[kept], self.normals[kept], self.rgb[kept], self.spacing)


def views_at_rest(scene: Scene, rest: RestModel) -> list[SeenView]:
    """What training cameras see of the scene at rest inside its box.

    Args:
        scene: In the box frame.
        rest: Its model.
    """
    model = DynamicModel(rest).alone("black")
    return [look(model, camera, None) for camera in poses(scene, OF_SWEEP)]


def surface_at_rest(views: Sequence[SeenView], rest: RestModel) -> SurfacePoints:
    """The surfaces that these views show."""
    spacing = SPACING * rest.canonical.voxel
    cloud = point_cloud(views, spacing)
    return SurfacePoints(cloud.xyz, cloud.normals, cloud.rgb, spacing)
