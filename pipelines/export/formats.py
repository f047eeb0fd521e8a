"""All that can be exported: a writer is a file beside this one, and a line here."""

from functools import partial

from devrf.calibration.formats import RIG_WRITERS
from devrf.capture.formats import DATASET_FORMATS
from devrf.pipelines.export import datasets, mesh, player, ply, rigs, splat, volumes
from devrf.pipelines.export.request import Format

SHAPES = ("times", "device")  # what geometry of the model takes

FORMATS: dict[str, Format] = {
    **{name: Format(partial(datasets.write, name), "data set", "scene") for name in DATASET_FORMATS},
    "ply": Format(ply.write, "point clouds", "canonical", SHAPES),
    "mesh": Format(mesh.write, "meshes", "canonical", (*SHAPES, "level"), ("skimage",)),
    "glb": Format(mesh.write_glb, "animated mesh", "canonical", (*SHAPES, "level"), ("skimage",)),
    "zarr": Format(volumes.write, "voxel grids", "canonical", SHAPES, ("zarr",)),
    "npz": Format(volumes.write, "voxel grids", "canonical", SHAPES),
    "splat": Format(splat.write, "3D Gaussians", "canonical", (*SHAPES, "splats")),
    "player": Format(player.write, "page to play", "canonical", (*SHAPES, "splats")),
    **{name: Format(rigs.write, "calibration", "rig") for name in RIG_WRITERS},
}
