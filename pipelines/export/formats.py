"""All that can be exported: a writer is a file beside this one, and a line here."""

from devrf.calibration.formats import RIG_WRITERS
from devrf.capture.formats import WRITERS
from devrf.pipelines.export import calibrated, mesh, player, ply
from devrf.pipelines.export import splat_options as splats
from devrf.pipelines.export.request import Format

SHAPES = ("times", "device")  # what geometry of the model takes

FORMATS: dict[str, Format] = {
    **{name: Format(calibrated.write_scene, "data set", "scene") for name in WRITERS},
    "ply": Format(ply.write, "point clouds", "canonical", SHAPES),
    "glb": Format(mesh.write, "animated mesh", "canonical", (*SHAPES, "level"), ("skimage",)),
    "splat": Format(splats.write, "3D Gaussians", "canonical", (*SHAPES, "splats")),
    "player": Format(player.write, "page to play", "canonical", (*SHAPES, "splats")),
    **{name: Format(calibrated.write_cameras, "calibration", "rig") for name in RIG_WRITERS},
}
