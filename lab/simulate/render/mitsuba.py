"""Mitsuba's side of the simulator: the renderer itself, meshes as its shapes, and sRGB."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError
from devrf.lab.simulate.scenes.catalogue import Mesh


def load_mitsuba() -> Any:
    """The renderer, ready to use; it is an optional dependency and slow to import, so it is loaded late.

    Raises:
        InputError: It is not installed.
    """
    try:
        import mitsuba
    except ImportError as error:
        text = (
            "simulate needs the renderer mitsuba, which is not installed; install it with: "
            "python -m pip install 'devrf[simulate]' "
            "(in a clone: python -m pip install -c constraints.txt -e '.[simulate]')"
        )
        raise InputError("package-missing", text) from error
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


class ShapeMaker:
    """Turns meshes into Mitsuba's shapes; a texture becomes a surface once."""

    def __init__(self, mi: Any, ambient: float = 0.0, lit: bool = True) -> None:
        """With `ambient` above 0 every surface glows as if a white one sent back this much even light; if it is not
        `lit`, no other light."""
        self._mi, self._ambient, self._lit = mi, ambient, lit
        self._surfaces: dict[tuple[int, int], tuple[Mesh, Any, Any]] = {}

    def __call__(
        self,
        mesh: Mesh,
        vertices: Float[np.ndarray, "v 3"] | None = None,
        faces: np.ndarray | None = None,
        mirror: bool = False,
    ) -> Any:
        """One shape; `vertices` and `faces` take the place of the mesh's own, a mirror that of its texture."""
        mi = self._mi
        vertices = mesh.vertices if vertices is None else vertices
        faces = mesh.faces if faces is None else faces
        bsdf, glow = (self._mirror(), None) if mirror else self._surface(mesh)
        props = mi.Properties()
        props["bsdf"] = bsdf
        if glow is not None:  # never sampled beside a lamp
            weight = 0.0 if self._lit else 1.0
            props["emitter"] = mi.load_dict({"type": "area", "radiance": glow, "sampling_weight": weight})
        shape = mi.Mesh(
            "mesh",
            len(vertices),
            len(faces),
            has_vertex_normals=mesh.smooth,
            has_vertex_texcoords=True,
            props=props,
        )
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
        parameters["faces"] = np.ravel(faces).astype(np.uint32)
        parameters["vertex_texcoords"] = np.ravel(mesh.uv).astype(np.float32)
        parameters.update()
        return shape

    def _mirror(self) -> Any:
        return self._mi.load_dict({"type": "conductor", "material": "none"})

    def _surface(self, mesh: Mesh) -> tuple[Any, Any]:
        key = id(mesh.texture), id(mesh.light)
        if key not in self._surfaces:  # the mesh is kept with it, so that no other picture gets its number
            mi = self._mi
            linear = srgb_to_linear(mesh.texture)

            def bitmap(values: np.ndarray) -> Any:
                picture = mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32))
                return mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"})

            bsdf = mi.load_dict({"type": "diffuse", "reflectance": bitmap(linear * self._lit)})
            light = self._ambient
            if mesh.light is not None:
                light = cv2.resize(mesh.light, linear.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            glow = bitmap(light * linear) if self._ambient else None
            self._surfaces[key] = (mesh, bsdf, glow)
        return self._surfaces[key][1:]


def perspective(mi: Any, camera: Camera, sampler: dict[str, Any], pixel_format: str) -> dict[str, Any]:
    """A sensor for `load_dict`: an ideal pinhole with the principal point in the picture's middle."""
    to_world = camera.world_from_cam @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba: x left, y up
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0]))),
        "fov_axis": "x",
        "near_clip": 0.01,
        "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": pixel_format,
            "component_format": "float32",
        },
        "sampler": sampler,
    }


def srgb_to_linear(picture: UInt8[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """8-bit sRGB to linear light in [0, 1] (IEC 61966-2-1)."""
    x = picture.astype(np.float32) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Linear light, clipped to [0, 1], to sRGB in [0, 1]."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
