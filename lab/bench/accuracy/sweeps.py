"""Static poses of two public photo sets, by the stage's own entry point with production defaults.

`fox_static` (instant-ngp): poses and focal length against the set's COLMAP model. `sceaux_castle` (openMVG): focal
length against its K.txt, which is the EXIF focal length over the sensor's width, not a calibration.
"""

import json
import shutil
import time
from functools import partial
from pathlib import Path

import numpy as np

from devrf.calibration.sweep.static_poses import SweepModel, SweepOptions
from devrf.calibration.truth import Truth, compare_cameras
from devrf.capture.frames import SWEEP
from devrf.capture.ingest.ingest import write_frames
from devrf.capture.photos.photo_folders import list_pictures
from devrf.capture.session import CaptureSession
from devrf.lab.bench.accuracy.cases import Cases
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.config.scene import StaticPosesConfig
from devrf.pipelines.stages.static_poses import Swept, recover_sweep

FOX = "instant-ngp's COLMAP model of data/nerf/fox (transforms.json)"
SCEAUX = "openMVG ImageDataset_SceauxCastle, images/K.txt"
PICTURES = {"fox_static": 50, "sceaux_castle": 11}
ROTATION_DEG, FOCAL_PERCENT = 0.2, 2.0  # goals
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def sweeps(cases: Cases) -> list[Row]:
    """Registered pictures, rotation, focal length, time, pairs and mapper of both sets."""
    rows: list[Row] = []
    for name in PICTURES:
        rows += cases.measured(name, f"sweeps/{name}", "", partial(_set, cases))
    return rows


def _set(cases: Cases, at: str, folder: Path) -> list[Row]:
    model, seconds = _recover(cases.folder(at), folder / "images")
    report, pictures = model.report, PICTURES[folder.name]
    return [
        Row(f"{at}/registered", float(len(model.names)), f"of {pictures}").at_least(pictures),
        Row(f"{at}/reprojection error", report["mean_reprojection_px"], "px"),
        *(_fox if folder.name == "fox_static" else _sceaux)(at, folder, model),
        Row(f"{at}/time", seconds, "s"),
        Row(f"{at}/pairs matched", float(report["pairs"]["matched"]), ""),
        Row(f"{at}/mapper: {report['mapper']}", float(len(report["attempts"])), "tried"),
    ]


def _recover(out: Path, photos: Path) -> tuple[SweepModel, float]:
    """The model, and seconds."""
    shutil.rmtree(out)
    (out / "static_poses").mkdir(parents=True)
    frames = write_frames(CaptureSession(static=photos), {}, out / "ingest", out)
    options = SweepOptions(StaticPosesConfig().mapper)
    camera, start = frames.cameras[SWEEP], time.monotonic()
    model, _ = recover_sweep(Swept(out / "ingest", camera), out / "static_poses", options)
    return model, time.monotonic() - start


def _fox(at: str, folder: Path, model: SweepModel) -> list[Row]:
    truth = json.loads((folder / "transforms.json").read_text())
    reference = {
        Path(f["file_path"]).name: np.array(f["transform_matrix"]) @ OPENCV_FROM_OPENGL
        for f in truth["frames"]
    }
    photos = list_pictures(folder / "images")
    true = {n: reference[photos[int(Path(name).stem)].name] for n, name in enumerate(model.names)}
    errors = compare_cameras(Truth(true, {}, {}), dict(enumerate(model.cameras)), {}, np.zeros(3))
    middle, most = errors["pose_rotation_deg_median"], errors["pose_rotation_deg"]
    return [
        Row(f"{at}/rotation, median", middle, "deg", source=FOX).at_most(ROTATION_DEG),
        Row(f"{at}/rotation, largest", most, "deg", source=FOX),
        _focal(at, model, truth["fl_x"], FOX),
    ]


def _sceaux(at: str, folder: Path, model: SweepModel) -> list[Row]:
    true = float((folder / "images" / "K.txt").read_text().split()[0])
    focal = Row(f"{at}/focal", float(model.cameras[0].K[0, 0]), "px", anchor=true, source=SCEAUX)
    return [focal, _focal(at, model, true, SCEAUX)]


def _focal(at: str, model: SweepModel, true: float, source: str) -> Row:
    off = 100 * abs(float(model.cameras[0].K[0, 0]) / true - 1)
    return Row(f"{at}/focal, off by", off, "%", source=source).at_most(FOCAL_PERCENT)
