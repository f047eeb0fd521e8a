"""Light and lens of the simulated camera: what comes in at every pixel of a sensor.

A picture is rendered by Mitsuba (`scalar_rgb`) through an ideal pinhole camera at twice the resolution, then
every sensor pixel gathers `SUBPIXELS`² samples of it along exactly distorted rays. Light is the sum of an
even ambient light, or of what `daylight` found on each surface, and a large lamp with soft shadows; all surfaces
are diffuse, so colours do not depend on the direction of view, unless the object has a `Finish`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.lab.simulate.render.mitsuba import ShapeMaker, load_mitsuba, perspective
from devrf.lab.simulate.scenes.catalogue import Mesh

FINE = 2  # rendered pixels per sensor pixel, each way
SUBPIXELS = 2  # lens samples per sensor pixel, each way
AMBIENT = 0.7  # radiance of a white surface without the lamp
EVEN = 0.9  # the same of what is mirrored: the room in even light, as bright as with the lamp


@dataclass(frozen=True)
class Light:
    """What lights the room.

    Attributes:
        position: Of the middle of a square lamp, metres.
        target: What it faces.
        half_m: Half its side.
        radiance: Of the lamp, RGB.
        ambient: Radiance of a white surface without the lamp, where the mesh has no light of its own.
    """

    position: tuple[float, float, float] = (0.5, 0.3, 3.6)
    target: tuple[float, float, float] = (0.5, 0.3, 0.0)
    half_m: float = 0.7
    radiance: tuple[float, float, float] = (3.6, 3.6, 3.6)
    ambient: float = AMBIENT

    def lamp(self, mi: Any, shift_m: float = 0.0) -> dict[str, Any]:
        """The lamp for `load_dict`, so far along y from its place."""
        along_y = np.array([0.0, shift_m, 0.0])
        up = [0, 1, 0] if self.position[:2] == self.target[:2] else [0, 0, 1]
        facing = mi.ScalarTransform4f().look_at(
            (self.position + along_y).tolist(), (self.target + along_y).tolist(), up
        )
        return {
            "type": "rectangle",
            "to_world": facing.scale([self.half_m, self.half_m, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(self.radiance)}},
        }


@dataclass(frozen=True)
class Finish:
    """What an object does with light beside sending it back evenly.

    Attributes:
        gloss: Share that it mirrors; the mirror shows the room in even light.
        clear: Share of the light from behind that it lets through.
    """

    gloss: float = 0.0
    clear: float = 0.0


class Renderer:
    """Renders a room that does not change and meshes that do."""

    def __init__(
        self, still: list[Mesh], spp: int, finish: Finish | None = None, light: Light | None = None
    ) -> None:
        """`finish` is that of the object."""
        self._mi = load_mitsuba()
        self._light = light or Light()
        self._spp = spp
        self._finish = finish or Finish()
        self._lit = ShapeMaker(self._mi, self._light.ambient)
        self._even = ShapeMaker(self._mi, EVEN, lit=False)
        self._still = self._shapes(self._lit, still)
        self._still_even = self._shapes(self._even, still) if self._finish.gloss else []
        self._lenses: dict[tuple[object, ...], Lens] = {}

    def __call__(
        self,
        camera: Camera,
        thing: list[Mesh],
        seed: int,
        *,
        beside: Sequence[Mesh] = (),
        lamp_shift_m: float = 0.0,
        moments: int = 1,
    ) -> Float[np.ndarray, "h w 3"]:
        """Linear radiance [H, W, 3] of the scene; a white surface in even light is about 0.9.

        Args:
            camera: Lens and pose.
            thing: The object, which has the finish.
            seed: Of the light paths.
            beside: What else is not in the same place in all pictures.
            lamp_shift_m: How far along y the lamp is from its place.
            moments: Of how many the mean is taken: they share the light paths, and with several of them each is
                rendered at the sensor's own resolution.
        """
        mi, finish = self._mi, self._finish
        lamp = self._light.lamp(mi, lamp_shift_m)
        by_lamp = {"lamp": lamp, "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}}
        around = [*self._still, *self._shapes(self._lit, beside)]
        picture = self._picture(camera, [*around, *self._shapes(self._lit, thing)], seed, by_lamp, moments)
        if finish.gloss:  # what is mirrored, in place of what is painted: both in even light
            even = {"integrator": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}}
            room = [*self._still_even, *self._shapes(self._even, beside)]
            mirrored, painted = (
                self._picture(camera, [*room, *self._shapes(self._even, thing, mirror)], seed, even, moments)
                for mirror in (True, False)
            )
            picture = (picture + finish.gloss * (mirrored - painted)).clip(0)
        if finish.clear:
            behind = self._picture(camera, around, seed, by_lamp, moments)
            picture = (1 - finish.clear) * picture + finish.clear * behind
        return picture

    def _picture(
        self, camera: Camera, shapes: list[Any], seed: int, light: dict[str, Any], moments: int
    ) -> np.ndarray:
        mi, fine = self._mi, FINE if moments == 1 else 1
        lens = self._lens(camera, fine)
        fine_camera = lens.pinhole(camera)
        samples = {"type": "independent", "sample_count": max(1, round(self._spp / fine**2 / moments))}
        scene = mi.load_dict(
            {
                "type": "scene",
                **light,
                "sensor": perspective(mi, fine_camera, samples, "rgb"),
                **{f"shape{i}": shape for i, shape in enumerate(shapes)},
            }
        )
        return lens.gathered(np.array(mi.render(scene, seed=seed), dtype=np.float32))

    def _shapes(self, maker: ShapeMaker, meshes: Sequence[Mesh], mirror: bool = False) -> list[Any]:
        shapes = []
        for mesh in meshes:
            shapes.append(maker(mesh, mirror=mirror))
            if mesh.thickness_m:
                behind = mesh.vertices - mesh.thickness_m * _vertex_normals(mesh.vertices, mesh.faces)
                shapes.append(maker(mesh, behind, mesh.faces[:, ::-1], mirror))
        return shapes

    def _lens(self, camera: Camera, fine: int) -> "Lens":
        if (camera.lens, fine) not in self._lenses:
            self._lenses[camera.lens, fine] = lens_of(camera, fine)
        return self._lenses[camera.lens, fine]


@dataclass(frozen=True)
class Lens:
    """An ideal fine picture that covers a camera's view, and where each subpixel looks it up."""

    width: int
    height: int
    focal: float
    maps: np.ndarray  # [SUBPIXELS H, SUBPIXELS W, 2], OpenCV's pixel convention, float32

    def pinhole(self, camera: Camera) -> Camera:
        """The ideal camera where `camera` stands."""
        K = np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1.0]])
        return Camera(self.width, self.height, K, camera.cam_from_world)

    def gathered(self, fine: Float[np.ndarray, "fine_h fine_w c"]) -> Float[np.ndarray, "h w c"]:
        """The sensor's picture of what the ideal camera sees."""
        return _gather(fine, self.maps, SUBPIXELS)


def lens_of(camera: Camera, fine: int = FINE) -> Lens:
    """The lens of a camera; `fine` rendered pixels per sensor pixel, each way."""
    ideal = ideal_coordinates(camera, SUBPIXELS)
    focal = fine * float(camera.K[0, 0])
    half = np.ceil(np.abs(ideal).reshape(-1, 2).max(axis=0) * focal) + 2
    maps = ideal * focal + half - 0.5  # OpenCV's remap has pixel centres at whole numbers
    return Lens(2 * int(half[0]), 2 * int(half[1]), focal, maps.astype(np.float32))


def ideal_coordinates(camera: Camera, subpixels: int) -> np.ndarray:
    """Ideal normalised coordinates [n H, n W, 2] of a regular grid of samples within every pixel."""
    x = (np.arange(camera.width * subpixels) + 0.5) / subpixels
    y = (np.arange(camera.height * subpixels) + 0.5) / subpixels
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    identity = replace(camera, cam_from_world=np.eye(3, 4))
    rays = identity.directions(pixels)
    return rays[..., :2] / rays[..., 2:]


def _gather(fine: np.ndarray, maps: np.ndarray, subpixels: int) -> np.ndarray:
    samples = cv2.remap(fine, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    h, w = samples.shape[0] // subpixels, samples.shape[1] // subpixels
    return samples.reshape(h, subpixels, w, subpixels, -1).mean(axis=(1, 3), dtype=np.float32)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    of_faces = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], of_faces)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
