"""All that can be exported: a writer is a file beside this one, and a line here."""

from devrf.calibration.formats import RIG_WRITERS
from devrf.capture.formats import WRITERS
from devrf.pipelines.export import datasets, mesh, player, ply, rigs, splat
from devrf.pipelines.export.request import Format

SHAPES = ("times", "device")  # what geometry of the model takes

FORMATS: dict[str, Format] = {
    **{name: Format(datasets.write, "data set", "scene") for name in WRITERS},
    "ply": Format(ply.write, "point clouds", "canonical", SHAPES),
    "glb": Format(mesh.write, "animated mesh", "canonical", (*SHAPES, "level"), ("skimage",)),
    "splat": Format(splat.write, "3D Gaussians", "canonical", (*SHAPES, "splats")),
    "player": Format(player.write, "page to play", "canonical", (*SHAPES, "splats")),
    **{name: Format(rigs.write, "calibration", "rig") for name in RIG_WRITERS},
}
