"""A studio without walls: pictures with alpha of meshes under even light and a soft lamp, and what each pixel sees.

Pictures are 8-bit sRGB with straight alpha; where nothing is, all four values are 0. The light is a
uniform sky, darker in corners, and a large square lamp above and in front; all surfaces are diffuse, and
light is not passed on between them, so the same point has the same colour from everywhere.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.capture.camera import Camera
from devrf.lab.simulate.render.mitsuba import ShapeMaker, linear_to_srgb, load_mitsuba, perspective
from devrf.lab.simulate.scenes.catalogue import Mesh

SKY = 0.75  # radiance
LAMP_RADIANCE, LAMP_HALF = 17.0, 1.2  # a light surface that faces it stays just below 1
LAMP_POSITION = [4.5, -4.0, 7.0]  # above and behind the cameras, which are 4 units from the origin


class Studio:
    """Renders what stands in it."""

    def __init__(self, spp: int) -> None:
        self.mi, self.spp = load_mitsuba(), spp
        self.shape = ShapeMaker(self.mi)
        self.light = self.mi.load_dict({"type": "direct", "hide_emitters": True})
        self.distance = self.mi.load_dict({"type": "depth"})
        self.numbers = self.mi.load_dict({"type": "aov", "aovs": "triangle:prim_index,depth:depth"})

    def stage(self, meshes: Sequence[Mesh]) -> "StudioScene":
        """Set the scene; every picture of it is taken by the stage."""
        return StudioScene(self, meshes)


class StudioScene:
    """One moment of the scene."""

    def __init__(self, studio: Studio, meshes: Sequence[Mesh]) -> None:
        self._studio, self._meshes = studio, meshes

    def picture(self, camera: Camera, seed: int) -> UInt8[np.ndarray, "h w 4"]:
        """sRGB and straight alpha [H, W, 4]."""
        return straight_srgb(self._render(self._lit, self._studio.light, camera, self._pixels(seed)))

    def coverage(self, camera: Camera, seed: int) -> Float[np.ndarray, "h w"]:
        """Share of each pixel that shows something [H, W], which is the alpha of `picture`."""
        return self._render(self._bare, self._studio.distance, camera, self._pixels(seed))[..., 3]

    def triangles(self, camera: Camera) -> Int[np.ndarray, "h w"]:
        """The triangle at each pixel's centre [H, W], counted over all meshes in order; -1 for none."""
        centre = {"type": "stratified", "sample_count": 1, "jitter": False}, 0
        image = self._render(self._bare, self._studio.numbers, camera, centre)
        triangle = np.rint(image[..., -2]).astype(np.int64)  # exact in float32 up to 16 million
        return np.where(image[..., -1] > 0, triangle, -1)

    @cached_property
    def _lit(self) -> Any:
        studio = self._studio
        lamp = studio.mi.ScalarTransform4f().look_at(LAMP_POSITION, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        shapes = [studio.shape(mesh) for mesh in self._meshes]
        return studio.mi.load_dict(
            {
                "type": "scene",
                **{f"mesh{i}": shape for i, shape in enumerate(shapes)},
                "sky": {
                    "type": "constant",
                    "sampling_weight": 0.0,
                    "radiance": {"type": "rgb", "value": SKY},
                },
                "lamp": {
                    "type": "rectangle",
                    "to_world": lamp.scale([LAMP_HALF, LAMP_HALF, 1]),
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": LAMP_RADIANCE}},
                },
            }
        )

    @cached_property
    def _bare(self) -> Any:
        """Without light and as one mesh: Mitsuba needs long to tell which of many shapes was hit."""
        first = np.cumsum([0] + [len(mesh.vertices) for mesh in self._meshes])
        vertices = np.concatenate([mesh.vertices for mesh in self._meshes])
        faces = [mesh.faces + n for mesh, n in zip(self._meshes, first[:-1], strict=True)]
        uv = np.zeros((len(vertices), 2))
        merged = Mesh(vertices, np.concatenate(faces), uv, self._meshes[0].texture)
        return self._studio.mi.load_dict({"type": "scene", "mesh": self._studio.shape(merged)})

    def _pixels(self, seed: int) -> tuple[dict[str, Any], int]:
        return {"type": "multijitter", "sample_count": self._studio.spp}, seed

    def _render(
        self, scene: Any, integrator: Any, camera: Camera, samples: tuple[dict[str, Any], int]
    ) -> np.ndarray:
        mi, (sampler, seed) = self._studio.mi, samples
        sensor = mi.load_dict(perspective(mi, camera, sampler, "rgba"))
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, seed=seed))


def straight_srgb(linear: Float[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """Linear light multiplied with alpha, as a film collects it, to 8-bit sRGB beside its alpha."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    colour = np.where(alpha > 0, linear[..., :3] / np.maximum(alpha, 1e-6), 0)
    return (255 * np.concatenate([linear_to_srgb(colour) * (alpha > 0), alpha], -1)).round().astype(np.uint8)
