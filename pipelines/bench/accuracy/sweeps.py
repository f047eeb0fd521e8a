"""Static poses of two public photo sets, by the stage's own entry point with production defaults.

`fox_static` (instant-ngp): poses and focal length against the set's COLMAP model. `sceaux_castle` (openMVG): focal
length against its K.txt, which is the EXIF focal length over the sensor's width, not a calibration.
"""

import json
import shutil
import time
from pathlib import Path

import numpy as np

from devrf.calibration.sweep.static_poses import SweepModel
from devrf.calibration.truth import Truth, compare_cameras
from devrf.capture.frames import SWEEP
from devrf.capture.ingest import write_frames
from devrf.capture.pictures import list_pictures
from devrf.capture.session import CaptureSession
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.rows import Row, with_goal
from devrf.pipelines.config.scene import StaticPosesConfig
from devrf.pipelines.stages.static_poses import recover_sweep

FOX = "instant-ngp's COLMAP model of data/nerf/fox (transforms.json)"
SCEAUX = "openMVG ImageDataset_SceauxCastle, images/K.txt"
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def sweeps(cases: Cases) -> list[Row]:
    """Registered pictures, rotation, focal length, time, pairs and mapper of both sets."""
    return _fox(cases) + _sceaux(cases)


def _fox(cases: Cases) -> list[Row]:
    folder = cases.real("fox_static")
    if folder is None:
        return [not_there("sweeps/fox_static", "", "fox_static")]
    model, photos, seconds = _recover(cases, folder)
    truth = json.loads((folder / "transforms.json").read_text())
    reference = {
        Path(f["file_path"]).name: np.array(f["transform_matrix"]) @ OPENCV_FROM_OPENGL
        for f in truth["frames"]
    }
    true = {n: reference[photos[int(Path(name).stem)]] for n, name in enumerate(model.names)}
    errors = compare_cameras(Truth(true, {}, {}), dict(enumerate(model.cameras)), {}, np.zeros(3))
    focal = 100 * float(model.cameras[0].K[0, 0] / truth["fl_x"] - 1)
    return [
        *_registered("fox_static", model, 50),
        with_goal(
            Row("sweeps/fox_static/rotation, median", errors["pose_rotation_deg_median"], "deg", source=FOX),
            0.2,
            low_is_good=True,
        ),
        Row("sweeps/fox_static/rotation, largest", errors["pose_rotation_deg"], "deg", source=FOX),
        with_goal(Row("sweeps/fox_static/focal, off by", abs(focal), "%", source=FOX), 2.0, low_is_good=True),
        *_cost("fox_static", model, seconds),
    ]


def _sceaux(cases: Cases) -> list[Row]:
    folder = cases.real("sceaux_castle")
    if folder is None:
        return [not_there("sweeps/sceaux_castle", "", "sceaux_castle")]
    model, _, seconds = _recover(cases, folder)
    true = float((folder / "images" / "K.txt").read_text().split()[0])
    camera = model.cameras[0]
    focal = 100 * float(camera.K[0, 0] / true - 1)
    return [
        *_registered("sceaux_castle", model, 11),
        Row("sweeps/sceaux_castle/focal", float(camera.K[0, 0]), "px", anchor=true, source=SCEAUX),
        with_goal(
            Row("sweeps/sceaux_castle/focal, off by", abs(focal), "%", source=SCEAUX), 2.0, low_is_good=True
        ),
        *_cost("sceaux_castle", model, seconds),
    ]


def _recover(cases: Cases, folder: Path) -> tuple[SweepModel, list[str], float]:
    """The model, the photos' own names by number, and seconds."""
    out = cases.out / "sweeps" / folder.name
    shutil.rmtree(out, ignore_errors=True)
    (out / "static_poses").mkdir(parents=True)
    photos = folder / "images"
    frames = write_frames(CaptureSession(static=photos), {}, out / "ingest", out)
    start = time.monotonic()
    model, _ = recover_sweep(
        out / "ingest", frames.cameras[SWEEP], out / "static_poses", StaticPosesConfig(), out, photos
    )
    return model, [photo.name for photo in list_pictures(photos)], time.monotonic() - start


def _registered(name: str, model: SweepModel, all_: int) -> list[Row]:
    return [
        with_goal(Row(f"sweeps/{name}/registered", float(len(model.names)), f"of {all_}"), float(all_)),
        Row(f"sweeps/{name}/reprojection error", model.report["mean_reprojection_px"], "px"),
    ]


def _cost(name: str, model: SweepModel, seconds: float) -> list[Row]:
    return [
        Row(f"sweeps/{name}/time", seconds, "s"),
        Row(f"sweeps/{name}/pairs matched", float(model.report["pairs"]["matched"]), ""),
        Row(f"sweeps/{name}/mapper: {model.report['mapper']}", float(len(model.report["attempts"])), "tried"),
    ]
