"""Exported geometry of a simulated session against its true surfaces, and the picture of docs/export.md.

    devrf-pipeline export SCENE --format ply --times 0,0.5     # and --format glb, without --times
    python -m benchmarks.geometry SESSION RUN                  # from the repository's root; a minute

SESSION holds `ground_truth.json`, RUN the run with `export/ply` and `export/glb`. Distances are from exported points
to the nearest of dense samples of the true surfaces, after the similarity that `evaluate.truth` fits on the camera
centres.
"""

import json
import sys
from pathlib import Path

import numpy as np
from benchmarks.script import centres, finish
from PIL import Image
from plyfile import PlyData
from scipy.spatial import KDTree
from tests.make.glb import read_glb

from devrf.calibration.truth import read_truth, similarity
from devrf.capture.camera import Camera
from devrf.capture.formats import read_scene
from devrf.capture.scene import Scene
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.scenes.catalogue import Mesh
from devrf.lab.simulate.scenes.objects import make_object
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.session.simulate_session import room_of, standing_board

RESULT, PICTURE = Path("benchmarks/results/geometry-cpu.json"), Path("docs/export.jpg")
SPACING_M = 0.0015  # of the samples of the true surfaces
FAR_M = 0.05
PER_FACE = 12  # points drawn in each
SHOWN = (0.2, 0.56, 0.8)  # of the clip


def main() -> None:
    """Print and write the rows, and draw the picture."""
    session, run = map(Path, sys.argv[1:3])
    scene, rows = read_scene(run / "scene"), []
    truth = _Truth(session, scene)
    folder = run / "export/ply"
    for entry in json.loads((folder / "export.json").read_text())["files"]:
        vertex = PlyData.read(str(folder / entry["file"]))["vertex"]
        away = truth.distances(np.stack([vertex[axis] for axis in "xyz"], axis=1), entry["time_s"])
        case = f"geometry/ply/{entry['time']:.2f}"
        rows += [
            Row(f"{case}/median", 1e3 * float(np.median(away)), "mm"),
            Row(f"{case}/percentile 99", 1e3 * float(np.quantile(away, 0.99)), "mm"),
            Row(f"{case}/beyond 50 mm", 100 * float((away > FAR_M).mean()), "%"),
        ]
    facts = json.loads((run / "export/glb/export.json").read_text())["forward_motion"]
    for part in ("median", "percentile_95"):
        rows.append(Row(f"geometry/glb/forward motion, worst key/{part}", 1e3 * max(facts[part]), "mm"))
    rows.append(Row("geometry/voxel", 1e3 * facts["voxel"], "mm"))
    finish("geometry", rows, RESULT, session=session.name, device="cpu")
    _draw(run, scene)


class _Truth:
    """True surfaces of a session, as they were simulated."""

    def __init__(self, session: Path, scene: Scene) -> None:
        file = session / "ground_truth.json"
        truth, made = read_truth(file), json.loads(file.read_text())
        options = SessionOptions(**made["made_by"]["options"])
        seeds = np.random.default_rng(made["made_by"]["seed"]).spawn(6)
        around = room_of(seeds[0], options)
        self.thing = make_object(made["made_by"]["scene"], seeds[1], options)
        self.still = [*around.still, *around.behind, *self.thing.stand, *standing_board(seeds[2], options)]
        self.rest_until_s = made["object"]["rest_until_s"]
        self.true_from_world = similarity(*centres(scene, truth))

    def distances(self, points: np.ndarray, time_s: float) -> np.ndarray:
        """Metres from points of our world to the nearest true surface at a time on cam0's clock."""
        moving = Mesh(
            self.thing.vertices_at(time_s - self.rest_until_s),
            self.thing.rest.faces,
            self.thing.rest.uv,
            self.thing.rest.texture,
        )
        matrix = self.true_from_world
        there = points @ matrix[:3, :3].T + matrix[:3, 3]
        lo, hi = there.min(0) - 0.2, there.max(0) + 0.2
        samples = np.concatenate([_samples(mesh.vertices, mesh.faces) for mesh in (*self.still, moving)])
        return KDTree(samples[((samples > lo) & (samples < hi)).all(1)]).query(there)[0]


def _samples(vertices: np.ndarray, faces: np.ndarray, count: int | None = None) -> np.ndarray:
    """Points spread over a mesh, at random; columns beyond x, y, z are blended alike."""
    rng, (a, b, c) = np.random.default_rng(0), (vertices[faces[:, n]] for n in range(3))
    area = 0.5 * np.linalg.norm(np.cross((b - a)[:, :3], (c - a)[:, :3]), axis=1)
    n = count or int(area.sum() / SPACING_M**2) + 1
    face = rng.choice(len(faces), n, p=area / area.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), n)
    return (vertices[faces[face]] * weights[..., None]).sum(1)


def _draw(run: Path, scene: Scene) -> None:
    """The animated mesh above what the test camera saw, at a few times."""
    mesh = read_glb(run / "export/glb/scene.glb")
    facts = json.loads((run / "export/glb/export.json").read_text())
    seen = [f for f in scene.dynamic if f.split == "test"]
    columns = []
    for share in SHOWN:
        key = int(share * (len(mesh.shapes) - 1))
        frame = min(seen, key=lambda f: abs((f.time_s or 0.0) - facts["key_times_s"][key]))
        both = np.concatenate([mesh.shapes[key], mesh.rgb], axis=1)  # colours come along
        points = _samples(both, mesh.faces, PER_FACE * len(mesh.faces))
        true = np.asarray(Image.open(frame.path).convert("RGB"))
        columns.append(np.vstack([_picture(frame.camera, points[:, :3], points[:, 3:]), true]))
    whole = Image.fromarray(np.hstack(columns))
    whole.resize((1020, round(1020 * whole.height / whole.width))).save(PICTURE, quality=80)


def _picture(camera: Camera, points: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Points on white, the nearest in each pixel, three pixels wide."""
    picture = np.full((camera.height, camera.width, 3), 255, np.uint8)
    order = np.argsort(-np.linalg.norm(points - camera.centre, axis=1))
    colours = np.round(255 * rgb[order].clip(0, 1)).astype(np.uint8)
    middle = camera.project(points[order])
    nearest = np.full((camera.height, camera.width), -1)
    for shift in np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2):
        u, v = np.nan_to_num(middle + shift, nan=-1.0).astype(int).T
        inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height))
        np.maximum.at(nearest, (v[inside], u[inside]), inside)
    picture[nearest >= 0] = colours[nearest[nearest >= 0]]
    return picture


if __name__ == "__main__":
    main()
