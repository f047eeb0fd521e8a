"""What movers could reach at most: the true motion of a simulated session's object in place of tracks.

    python -m benchmarks.ceiling SCENE RUN [--json FILE]

SCENE is a scene.yaml of `simulate`, RUN its run folder, finished up to `evaluate`. Each point of the surface at rest
goes as the true points around it, from `object_points.npz` beside the truth; the rest is the program's own: parts,
training together with what stands, and `test_moving` by the true masks. Clocks are those of the run.
"""

import json
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from benchmarks.script import arguments, centres, finish
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from devrf.calibration.truth import read_truth, similarity
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.flow.dis import DisFlow
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.run_folder.clocks import clocks_in_use
from devrf.pipelines.stages.evaluate import true_masks
from devrf.reconstruct.evaluation.evaluate import Known, LpipsNets, evaluate
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.sampling.retimed import as_trained
from devrf.reconstruct.storage.model_io import FILE, load_rest
from devrf.reconstruct.tracking.find import at_rest, parts_of
from devrf.reconstruct.tracking.follow import SurfaceTracks, moments
from devrf.reconstruct.tracking.rigid import motion_of
from devrf.reconstruct.tracking.solver.graph import Graph
from devrf.reconstruct.tracking.views.film import films
from devrf.reconstruct.training.train_movers import train_movers

NEAR = 2.5  # spacings of the surface: points farther from every true one stand
AROUND = 16  # true points around one
KEPT = 8  # of these, those that stay at their distances best: they say how it goes


def ceiling(scene_yaml: Path, run: Path) -> list[Row]:
    """Of one session: what its run reached, what it would with the true motion, and without any."""
    config = load_scene(scene_yaml)
    truth_file = config.truth_path(scene_yaml.parent)
    assert truth_file is not None, f"{scene_yaml} names no evaluate.truth"
    told = {
        name: json.loads((run / name / "metrics.json").read_text()) for name in ("deformation", "evaluate")
    }
    scene = as_trained(read_scene(run / "scene"), told["deformation"])
    rest = load_rest(run / "canonical" / FILE, "cpu")
    boxed = scene.in_box_frame()
    assert boxed.rest_time is not None
    seen = at_rest(boxed, rest)
    surface = seen.surface
    clips = films(boxed, DisFlow())
    times, _ = moments(clips, boxed.rest_time)
    late_s = late(run, scene, truth_file, told["deformation"].get("clock_offsets_s", {}))
    points = true_points(scene, truth_file, np.append(boxed.rest_time, times), late_s)
    moves, xyz = carried(surface.xyz, surface.spacing, points)
    never = np.zeros(xyz.shape[:2], dtype=bool)
    tracks = SurfaceTracks(times, xyz.astype(np.float32), never, np.zeros(len(clips)))
    found = parts_of(boxed, rest, seen, moves, Graph(surface.only(moves)), tracks)
    assert found is not None
    options = training_options(config, scene).motion
    trained = train_movers(MovingPictures(boxed, rest, "cpu"), found.stands, found.movers, options)
    model = DynamicModel.of_movers(rest, trained.stands, trained.movers, len(times), boxed.rest_time)
    with tempfile.TemporaryDirectory() as folder:
        known = Known(true_masks(truth_file, scene))
        score = evaluate(scene, partial(render_view, model), LpipsNets.load(None), Path(folder), known=known)
    name = f"ceiling/{config.name}"
    return [
        Row(f"{name}/nothing moves", told["evaluate"]["static_baseline"]["test_moving"]["psnr"], "dB"),
        Row(f"{name}/tracked", told["evaluate"]["test_moving"]["psnr"], "dB"),
        Row(f"{name}/true motion", score["test_moving"]["psnr"], "dB"),
        Row(f"{name}/true motion, parts", found.movers.parts, ""),
    ]


def late(run: Path, scene: Scene, truth_file: Path, offsets_s: Mapping[str, float]) -> float:
    """By how much the scene's clock is ahead of the truth's: the median of its training cameras, seconds.

    With the offsets that training gave them.
    """
    clocks, truth = clocks_in_use(run), read_truth(truth_file).clocks
    zero, ahead = truth[next(iter(clocks))], []
    for name in sorted({f.camera_name for f in scene.dynamic if f.split == "train"}):
        true = zero.file_time(truth[name].true_time(0.0))
        ahead.append(clocks[name].true_time(0.0) + offsets_s.get(name, 0.0) - true)
    return float(np.median(ahead))


def true_points(
    scene: Scene, truth_file: Path, times: Float[np.ndarray, " t"], late_s: float
) -> Float[np.ndarray, "t n 3"]:
    """Where the object's points are at times of the scene, in the box frame."""
    truth = read_truth(truth_file)
    recovered, true = centres(scene, truth)
    box_from_true = scene.box_from_world @ similarity(true, recovered)
    with np.load(truth_file.with_name("object_points.npz")) as file:
        known_s, points = file["times_s"], file["points_m"].astype(float)
    asked_s = scene.t0_s + (scene.t1_s - scene.t0_s) * times - late_s
    at = np.interp(asked_s, known_s, np.arange(len(known_s)))
    first = np.minimum(at.astype(int), len(known_s) - 2)
    share = (at - first)[:, None, None]
    there = (1 - share) * points[first] + share * points[first + 1]
    return there @ box_from_true[:3, :3].T + box_from_true[:3, 3]


def carried(
    xyz: Float[np.ndarray, "p 3"], spacing: float, true: Float[np.ndarray, "t n 3"]
) -> tuple[Bool[np.ndarray, " p"], Float[np.ndarray, "t m 3"]]:
    """Which points belong to the object, and where these go: as the true points around the nearest one, rigidly."""
    rest, true = true[0], true[1:]
    away, nearest = KDTree(rest).query(xyz)
    moves = away < NEAR * spacing
    _, around = map(np.asarray, KDTree(rest).query(rest, k=min(AROUND, len(rest))))
    out = np.empty((len(true), int(moves.sum()), 3))
    points, nearest = xyz[moves], nearest[moves]
    for n in np.unique(nearest).tolist():
        near = around[n]
        distances = np.linalg.norm(true[:, near] - true[:, [n]], axis=-1)
        stays = near[np.argsort(distances.std(0))[:KEPT]]
        rotations, shifts = motion_of(rest[stays], true[:, stays])
        mine = nearest == n
        out[:, mine] = points[mine] @ rotations.transpose(0, 2, 1) + shifts[:, None]
    return moves, out


if __name__ == "__main__":
    given = arguments(__doc__, "scene", "run")
    finish("What movers could reach", ceiling(given.scene, given.run), given.json)
