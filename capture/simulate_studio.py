"""A studio without walls: pictures with alpha of meshes under even light and a soft lamp, and what each pixel sees.

Pictures are 8-bit sRGB with straight alpha; where nothing is, all four values are 0. The light is a
uniform sky, darker in corners, and a large square lamp above and in front; all surfaces are diffuse, and
light is not passed on between them, so the same point has the same colour from everywhere.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.capture.camera import Camera
from devrf.capture.simulate_mitsuba import ShapeMaker, linear_to_srgb, load_mitsuba, perspective
from devrf.capture.simulate_scenes import Mesh

SKY = 0.6  # radiance; with the lamp at its best a white surface stays just below 1
LAMP_RADIANCE, LAMP_HALF = 14.0, 1.2
LAMP_POSITION = (4.5, -4.0, 7.0)  # above and behind the cameras, which are 4 units from the origin


class Studio:
    """Renders what stands in it."""

    def __init__(self, spp: int, lamp_position: Sequence[float] = LAMP_POSITION) -> None:
        self._mi = load_mitsuba()
        self._spp = spp
        self._lamp_position = list(lamp_position)
        self._shape = ShapeMaker(self._mi)
        self._integrator = self._mi.load_dict({"type": "direct", "hide_emitters": True})
        self._coverage = self._mi.load_dict({"type": "depth"})
        self._ids = self._mi.load_dict({"type": "aov", "aovs": "prim:prim_index,shape:shape_index"})

    def stage(self, meshes: Sequence[Mesh]) -> "Stage":
        """Set the scene; every picture of it is taken by the stage."""
        mi = self._mi
        lamp = mi.ScalarTransform4f().look_at(self._lamp_position, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        shapes = [self._shape(mesh) for mesh in meshes]
        scene = mi.load_dict(
            {
                "type": "scene",
                # The order is the meshes': shape numbers are counted in it.
                **{f"mesh{i:04d}": shape for i, shape in enumerate(shapes)},
                "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
                "zlamp": {
                    "type": "rectangle",
                    "to_world": lamp.scale([LAMP_HALF, LAMP_HALF, 1]),
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": LAMP_RADIANCE}},
                },
            }
        )
        return Stage(self, scene, [len(mesh.faces) for mesh in meshes])


class Stage:
    """One moment of the scene."""

    def __init__(self, studio: Studio, scene: Any, faces: list[int]) -> None:
        self._studio, self._scene = studio, scene
        self._first = np.concatenate([[0], np.cumsum(faces)])

    def picture(self, camera: Camera, seed: int) -> UInt8[np.ndarray, "h w 4"]:
        """sRGB and straight alpha [H, W, 4]."""
        return straight_srgb(self._render(self._studio._integrator, camera, seed, "rgba"))

    def coverage(self, camera: Camera, seed: int) -> Float[np.ndarray, "h w"]:
        """Share of each pixel that shows something [H, W], as in `picture` with the same seed."""
        return self._render(self._studio._coverage, camera, seed, "rgba")[..., 3]

    def triangles(self, camera: Camera) -> Int[np.ndarray, "h w"]:
        """The triangle at each pixel's centre [H, W], counted over all meshes in order; -1 for none."""
        studio = self._studio
        centre = {"type": "stratified", "sample_count": 1, "jitter": False}
        sensor = studio._mi.load_dict(perspective(studio._mi, camera, centre, "rgb"))
        image = studio._mi.render(self._scene, sensor=sensor, integrator=studio._ids, seed=0)
        prim, shape = np.moveaxis(np.rint(np.array(image)).astype(np.int64), -1, 0)[-2:]
        seen = (shape > 0) & (shape < len(self._first))  # shapes are counted from 1; the last is the lamp
        return np.where(seen, self._first[np.where(seen, shape - 1, 0)] + prim, -1)

    def _render(self, integrator: Any, camera: Camera, seed: int, pixel_format: str) -> np.ndarray:
        mi = self._studio._mi
        sampler = {"type": "multijitter", "sample_count": self._studio._spp}
        sensor = mi.load_dict(perspective(mi, camera, sampler, pixel_format))
        return np.array(mi.render(self._scene, sensor=sensor, integrator=integrator, seed=seed))


def straight_srgb(linear: Float[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """Linear light multiplied with alpha, as a film collects it, to 8-bit sRGB beside its alpha."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    colour = np.where(alpha > 0, linear[..., :3] / np.maximum(alpha, 1e-6), 0)
    return (255 * np.concatenate([linear_to_srgb(colour) * (alpha > 0), alpha], -1)).round().astype(np.uint8)
