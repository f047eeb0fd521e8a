"""Exports of voxel grids, as zarr or npz: density and colour at rest and per time, and the motion at its key times."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import Trained

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.geometry.field import Field

TIMES = "10"
CHUNK = 64  # voxels along each axis
AXES = (
    "arrays are indexed [x, y, z] along the axes of the scene's box; the first and last vertex of an axis lie on the "
    "box. A vertex is at box_min + index / (count - 1) * (box_max - box_min) in the box frame (moving and motion: "
    "motion_box_min and so on), and world_from_box times that in the world of the calibration, which is that of the "
    "data set exports of this run."
)
NDC_AXES = (
    " The grids of this scene fill the frustum of a reference camera: what stands above is in its normalised device "
    "coordinates, and z = 2 / (1 - z'), x = x' z tan_x, y = y' z tan_y are in the box frame."
)
FILES = {
    "zarr": "scene.zarr: rest/density, rest/rgb; moving/density, moving/rgb (first axis: time); motion/backward, "
    "motion/forward (first axis: key time). Attributes are on the group.",
    "npz": "rest.npz (density, rgb), moving_0000.npz and so on (density, rgb; one per time), motion.npz (backward, "
    "forward; first axis: key time). `attributes` in each is JSON.",
}

PARTS = (
    " What moves is parts: parts has labels (on the grid of rest, from 1; 0 stands), rotations, stretches and shifts "
    "(first axes: moment, part; in the box frame): what rests at x is at R S x + t; S of a rigid part is the identity."
)

Volume = dict[str, np.ndarray]


def write(request: Request) -> None:
    """Write `scene.zarr`, or the .npz files, whichever the format's name says."""
    trained = Trained(request, TIMES)
    from devrf.reconstruct.geometry.field import field_at

    field = field_at(trained.model, None)
    attributes = _attributes(trained, field)
    with request.new_folder() as new, request.talk.progress(f"export {request.name}") as progress:
        put = _Zarr(new / "scene.zarr", attributes) if request.name == "zarr" else _Npz(new, attributes)
        count = len(trained.moments) + 2 + (trained.model.movers is not None)
        for n, (name, place, volume) in enumerate(_volumes(trained)):
            put.volume(name, place, volume)
            progress((n + 1) / count, f"{name} {'' if place is None else place[0] + 1}")
        trained.describe(
            new,
            files=f"{FILES[request.name]} Density is how much light is absorbed per unit of length (1 - exp(-density * "
            "length) is the opacity of a layer), rgb the 8-bit sRGB colour that the training cameras see on average, 0 "
            "where it is empty. Motion is in units of the box frame: a point seen at x at a time rests at x + "
            "backward; what rests at x is then at x + forward. Between key times both are blended."
            + ("" if trained.model.movers is None else PARTS),
            axes=attributes["axes"],
            facts={"volumes": attributes},
        )


def _volumes(trained: Trained) -> Iterator[tuple[str, tuple[int, int] | None, Volume]]:
    """Name, place among so many (None: alone) and arrays of each."""
    from devrf.reconstruct.geometry.field import field_at
    from devrf.reconstruct.geometry.seen import poses
    from devrf.reconstruct.geometry.volume import density_and_colour

    model, cameras = trained.model, poses(trained.boxed)

    def at(time: float | None) -> Volume:
        density, rgb = density_and_colour(field_at(model, time), cameras)
        return {"density": density / np.float32(trained.scale), "rgb": rgb}

    yield "rest", None, at(None)
    if model.motion is None:
        return
    for n, moment in enumerate(trained.moments):
        yield "moving", (n, len(trained.moments)), at(moment.time)
    motion, movers = model.motion, model.movers
    yield "motion", None, {"backward": motion.backward.cpu().numpy(), "forward": motion.forward.cpu().numpy()}
    if movers is not None:
        courses = {
            "rotations": movers.rotations.numpy(),
            "stretches": movers.stretched().numpy(),
            "shifts": movers.shifts.numpy(),
        }
        yield "parts", None, {"labels": movers.labels.cpu().numpy(), **courses}


def _attributes(trained: Trained, field: "Field") -> dict[str, Any]:
    ndc = field.canonical.ndc
    unit = "metre" if trained.scene.metric else "unit of arbitrary scale"
    value: dict[str, Any] = {
        "axes": AXES + ("" if ndc is None else NDC_AXES),
        "box_min": field.aabb[0].tolist(),
        "box_max": field.aabb[1].tolist(),
        "world_from_box": trained.world_from_box.tolist(),
        "world_unit": unit,
        "world_units_per_box_unit": trained.scale,
        "density_unit": f"1 / {unit}",
        "ndc": None if ndc is None else {"tan_x": ndc.tan_x, "tan_y": ndc.tan_y},
    }
    motion = trained.model.motion
    if motion is not None:
        span = trained.scene.t1_s - trained.scene.t0_s
        value |= {
            "motion_box_min": motion.aabb[0].tolist(),
            "motion_box_max": motion.aabb[1].tolist(),
            "moving_times_s": [moment.time_s for moment in trained.moments],
            "motion_key_times_s": [trained.scene.t0_s + span * time for time in motion.key_times],
        }
        if trained.model.movers is not None:
            moments = trained.model.movers.times.tolist()
            value["parts_times_s"] = [trained.scene.t0_s + span * time for time in moments]
    return value


class _Zarr:
    """One group with an array for each kind of volume; times are put in one by one."""

    def __init__(self, path: Path, attributes: dict[str, Any]) -> None:
        import zarr

        self.path, self.arrays = path, {}
        zarr.open_group(str(path), mode="w").attrs.update(attributes)

    def volume(self, name: str, place: tuple[int, int] | None, volume: Volume) -> None:
        import zarr

        zarr.open_group(str(self.path / name), mode="a")
        for part, values in volume.items():
            at = f"{name}/{part}"
            if place is None:
                times = (1,) * (values.ndim - 3 - (values.shape[-1] == 3))
                self._new(at, values.shape, times, values.dtype)[:] = values
                continue
            n, count = place
            if n == 0:
                self.arrays[at] = self._new(at, (count, *values.shape), (1,), values.dtype)
            self.arrays[at][n] = values

    def _new(self, at: str, shape: tuple[int, ...], first: tuple[int, ...], dtype: np.dtype) -> Any:
        import zarr

        chunks = (*first, *(min(CHUNK, n) for n in shape[len(first) :]))
        return zarr.open_array(str(self.path / at), mode="w", shape=shape, chunks=chunks, dtype=dtype)


class _Npz:
    """A file for each volume."""

    def __init__(self, folder: Path, attributes: dict[str, Any]) -> None:
        self.folder, self.attributes = folder, json.dumps(attributes)

    def volume(self, name: str, place: tuple[int, int] | None, volume: Volume) -> None:
        stem = name if place is None else f"{name}_{place[0]:04d}"
        values: dict[str, Any] = {**volume, "attributes": np.array(self.attributes)}
        np.savez_compressed(self.folder / f"{stem}.npz", **values)
