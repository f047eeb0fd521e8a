"""Structure from motion of rendered pictures with known poses; the worker process when things go wrong."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.sweep import sfm_process
from devrf.calibration.sweep.devices import device_groups
from devrf.calibration.sweep.sfm_process import run_job
from devrf.calibration.sweep.static_poses import (
    SweepOptions,
    SweepPictures,
    read_static_poses,
    recover_static_poses,
)
from devrf.calibration.truth import rotation_angle_deg, similarity
from devrf.capture.system.errors import CalibrationError, HealthError
from devrf.pipelines.health.judge import entries

FOCAL = 300.0  # what the corner is drawn with
VIEWS = 9


def test_every_view_is_registered_where_it_was(corner):
    truth, model = corner.corner.truth, corner.model
    assert list(model.names) == sorted(truth)
    ours = np.array([c.centre for c in model.cameras])
    true = np.array([truth[n][:3, 3] for n in model.names])
    true_from_ours = similarity(ours, true)
    turn = true_from_ours[:3, :3] / np.cbrt(np.linalg.det(true_from_ours[:3, :3]))
    for camera, name in zip(model.cameras, model.names, strict=True):
        assert rotation_angle_deg(turn @ camera.cam_from_world[:, :3].T, truth[name][:3, :3]) < 0.5
    moved = ours @ true_from_ours[:3, :3].T + true_from_ours[:3, 3]
    assert np.linalg.norm(moved - true, axis=1).max() < 0.03  # metres, at a distance of 4
    assert model.cameras[0].K[0, 0] == pytest.approx(FOCAL, rel=0.02)


def test_what_is_left_on_disk(corner):
    out, model = corner.out, corner.model
    report = json.loads((out / "static_poses.json").read_text())
    assert report["registered"] == report["given"] == VIEWS
    assert report["unregistered"] == [] and report["models"] == [VIEWS]
    assert report["mean_reprojection_px"] < 1.0
    assert report["median_triangulation_angle_deg"] > 3.0
    assert {p.name for p in (out / "colmap").iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}
    again = read_static_poses(out)
    assert again.names == model.names and len(again.xyz) == report["points"]
    projected = again.cameras[0].project(again.xyz[again.obs_point[again.obs_image == 0]])
    error = np.linalg.norm(projected - again.obs_xy[again.obs_image == 0], axis=1)
    assert np.median(error) < 0.7  # our camera projects as COLMAP's does
    assert not list(out.glob("work-*"))


@pytest.mark.full
@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_the_same_pictures_give_the_same_model(corner, tmp_path, mapper):
    """On all cores as on one: how pairs fall to threads decides nothing."""
    options, cores = SweepOptions(mapper=mapper), os.sched_getaffinity(0)
    pictures = replace(corner.corner, exif={})  # focal lengths are found from pairs
    one = pictures.recover(tmp_path / "all", options)
    os.sched_setaffinity(0, {min(cores)})
    try:
        other = pictures.recover(tmp_path / "one", options)
    finally:
        os.sched_setaffinity(0, cores)
    for a, b in zip(one.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)


def test_blank_walls_are_refused_with_counts(tmp_path):
    (tmp_path / "static").mkdir()
    names = [f"static/{n:06d}.png" for n in range(4)]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.full((120, 160), 140, dtype=np.uint8))
    out = tmp_path / "out"
    out.mkdir()
    with refused("sweep-unregistered", "0 of 4 pictures", "best pair: 0 inliers", kind=HealthError):
        groups = device_groups(dict.fromkeys(names, (160, 120)), {}, None)
        recover_static_poses(SweepPictures(tmp_path, groups), out)


def test_two_pictures_are_no_sweep(tmp_path):
    sizes = {"a.png": (160, 120), "b.png": (160, 120)}
    with refused("sweep-too-short", "2 pictures", "3", kind=CalibrationError):
        recover_static_poses(SweepPictures(tmp_path, device_groups(sizes, {}, None)), tmp_path)


def test_a_crash_of_the_worker_is_an_error_with_its_last_words(tmp_path):
    code = "import os, sys; print('F2026 fatal check failed', file=sys.stderr, flush=True); os.abort()"
    with refused("sfm-failed", "signal 6", "fatal check failed", kind=CalibrationError):
        run_job({}, tmp_path, tmp_path / "colmap.log", command=[sys.executable, "-c", code])


def test_a_worker_that_ignores_sigterm_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(sfm_process, "GRACE_S", 0.5)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
    start = time.monotonic()
    with refused("sfm-timed-out", "2 s", kind=CalibrationError):
        run_job({}, tmp_path, tmp_path / "colmap.log", timeout_s=2.0, command=[sys.executable, "-c", code])
    assert time.monotonic() - start < 60


def test_what_a_stopped_worker_left_counts(tmp_path):
    code = (
        "import json, pathlib, time\n"
        f"pathlib.Path({str(tmp_path)!r}, 'result.json').write_text(json.dumps({{'given': 3}}))\n"
        "time.sleep(600)"
    )
    result = run_job(
        {}, tmp_path, tmp_path / "colmap.log", timeout_s=2.0, command=[sys.executable, "-c", code]
    )
    assert result["given"] == 3 and "was stopped after 2 s" in result["stopped"]


def test_a_worker_without_a_result_is_an_error(tmp_path):
    with refused("sfm-failed", "exit code 0", kind=CalibrationError):
        run_job({}, tmp_path, tmp_path / "colmap.log", command=[sys.executable, "-c", "pass"])


def test_importing_pycolmap_first_through_the_package_does_not_corrupt_zlib():
    """The wheel embeds zlib; loaded first it breaks PNG and npz writing (double free)."""
    code = (
        "import devrf.calibration.sweep.sfm_worker, io, zlib, cv2, numpy as np\n"
        "x = np.random.default_rng(0).integers(0, 255, (300, 300, 3)).astype(np.uint8)\n"
        "for _ in range(5):\n"
        "    ok, png = cv2.imencode('.png', x); assert ok\n"
        "    assert (cv2.imdecode(png, 1) == x).all()\n"
        "    f = io.BytesIO(); np.savez_compressed(f, x=x); f.seek(0); assert (np.load(f)['x'] == x).all()\n"
        "print('fine')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.strip() == "fine", done.stderr


LENSES = """
import json, sys
import devrf.calibration.sweep.sfm_worker as worker
import pycolmap
found = {}
for name, fy, p1, p2 in (("plain", 800, 0.0, 0.0), ("tangential", 800, 0.004, -0.003), ("oblong", 830, 0.0, 0.0)):
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 24, 400
    options.camera_width, options.camera_height = 640, 480
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = [800, fy, 330, 236, -0.06, 0.01, p1, p2]
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.4
    pycolmap.synthesize_noise(noise, model)
    for camera in model.cameras.values():
        camera.params = [810, 810, 320, 240, 0, 0, 0, 0]
    model, adjusted = worker._polish(model, 20, set())
    (camera,) = model.cameras.values()
    found[name] = [adjusted["plain_lens"], *map(float, camera.params)]
print(json.dumps(found))
"""


MADE = """
import json
import devrf.calibration.sweep.sfm_worker as worker
import numpy as np, pycolmap
pycolmap.set_random_seed(1)
options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 24, 400
options.camera_width, options.camera_height = 640, 480
options.camera_model_id = pycolmap.CameraModelId.OPENCV
options.camera_params = PARAMS
model = pycolmap.synthesize_dataset(options)
noise = pycolmap.SyntheticNoiseOptions()
noise.point2D_stddev = 0.4
pycolmap.synthesize_noise(noise, model)
"""


HALVES = (
    MADE.replace("PARAMS", "[800, 800, 320, 240, 0, 0, 0, 0]")
    + """
none = worker._zoomed(model, True)
images = sorted((i for i in model.images.values()), key=lambda i: i.name)
for image in images[10:]:
    for point in image.points2D:
        point.xy = (point.xy - [320, 240]) * 1.15 + [320, 240]
model, adjusted = worker._polish(model, 20, set())
found = worker._zoomed(model, False)
for n, point in enumerate(images[3].points2D):
    if point.has_point3D() and images[3].num_points3D > 20:
        model.delete_observation(images[3].image_id, n)
poor, weak = images[3].name, worker._without_weak(model)
left = sorted(i.name for i in model.images.values() if i.has_pose)
print(json.dumps([worker.LEAST_POINTS, none, found, images[10].name, weak, poor, len(left)]))
"""
)


CROPS = (
    MADE.replace("PARAMS", "[500, 500, 330, 236, -0.06, 0.01, 0, 0]")
    + """
found = []
for shift_px in (0, 20):
    for n, image in enumerate(sorted(model.images.values(), key=lambda i: i.name)):
        for point in image.points2D:
            point.xy = point.xy + [shift_px * np.sin(2 * n), shift_px * np.cos(3 * n)]
    model, _ = worker._polish(model, 20, set())
    found.append(worker._crops(model))
print(json.dumps(found))
"""
)


def test_principal_points_that_move_are_told_from_one_that_stays():
    done = subprocess.run([sys.executable, "-c", CROPS], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    stays, moves = json.loads(done.stdout.splitlines()[-1])
    assert stays["error"] > 0.99 and moves["error"] < 0.97  # the noise of 0.4 px stays
    assert moves["apart"] == pytest.approx(20 / 640, rel=0.3)


@pytest.mark.full
def test_a_zoom_in_mid_film_is_found_and_a_picture_of_few_points_left_out():
    done = subprocess.run([sys.executable, "-c", HALVES], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    least, none, found, first, weak, poor, left = json.loads(done.stdout.splitlines()[-1])
    assert none is None and least == (entries()["sweep-points"].low or (None, None))[1]
    assert found["from"] == first and found["focal_px"][1] / found["focal_px"][0] == pytest.approx(
        1.15, abs=0.02
    )
    assert weak == [poor] and left == 23


def test_a_lens_has_tangential_distortion_and_oblong_pixels_only_where_residuals_need_them():
    done = subprocess.run([sys.executable, "-c", LENSES], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    plain, fx, fy, cx, cy, _, _, p1, p2 = found["plain"]
    assert plain and fx == fy == pytest.approx(800, abs=1) and p1 == p2 == 0.0
    assert (cx, cy) == pytest.approx((330, 236), abs=1.5)
    plain, *_, p1, p2 = found["tangential"]
    assert not plain and (p1, p2) == pytest.approx((0.004, -0.003), abs=1e-3)
    plain, fx, fy, *_ = found["oblong"]
    assert not plain and (fx, fy) == pytest.approx((800, 830), abs=1)
