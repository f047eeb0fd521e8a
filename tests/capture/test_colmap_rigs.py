"""Rigs and frames of COLMAP's models, as pycolmap reads them; in a process of its own, as everywhere."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from devrf.capture.formats import read_dataset, write_dataset
from devrf.capture.formats.colmap.colmap_rigs import simultaneous
from devrf.capture.scene import Scene

READ = """
import json, sys, pycolmap
out = []
for place in sys.argv[2:]:
    model = pycolmap.Reconstruction(place)
    points = json.loads(sys.argv[1])
    images = {
        i.name: {"camera": i.camera_id, "frame": i.frame_id, "seen": [i.project_point(p).tolist() for p in points]}
        for i in model.images.values()
    }
    frames = {n: sorted(d.id for d in f.data_ids) for n, f in model.frames.items()}
    rigs = [
        [r.ref_sensor_id.id, {s.id: r.sensor_from_rig(s).matrix().tolist() for s in r.non_ref_sensors}]
        for r in model.rigs.values()
    ]
    out.append({"images": images, "frames": frames, "rigs": rigs})
print(json.dumps(out))
"""
GRID = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))


def opened(*places: Path) -> list[dict]:
    command = [sys.executable, "-c", READ, json.dumps(GRID.tolist()), *map(str, places)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


def test_pycolmap_opens_the_sweep_and_the_rig(odd_scene: Scene, tmp_path: Path) -> None:
    write_dataset("colmap", odd_scene, tmp_path / "out")
    moved = replace(odd_scene.dynamic[3].camera, cam_from_world=odd_scene.static[0].camera.cam_from_world)
    carried = (*odd_scene.dynamic[:3], replace(odd_scene.dynamic[3], camera=moved), *odd_scene.dynamic[4:])
    write_dataset("colmap", replace(odd_scene, dynamic=carried), tmp_path / "carried")
    places = ("out/sparse/0", "out/motion/sparse/0", "carried/motion/sparse/0")
    still, motion, free = opened(*(tmp_path / place for place in places))
    assert len(still["rigs"]) == 1 and len(still["frames"]) == len(odd_scene.static)

    ((reference, others),) = motion["rigs"]  # one rig of three cameras
    names = ["cam0", "cam1", "witness"]
    assert len(others) == 2 and len(motion["frames"]) == 5
    assert all(len(images) == 3 for images in motion["frames"].values())
    cameras = {f.camera_name: f.camera for f in odd_scene.dynamic}
    ids = {name: motion["images"][f"{name}/000000.png"]["camera"] for name in names}
    first = next(cameras[name] for name in names if ids[name] == reference)
    for name in names:
        if ids[name] != reference:
            expected = cameras[name].cam_from_world @ first.world_from_cam
            np.testing.assert_allclose(others[str(ids[name])], expected, atol=1e-9)
    for frame in odd_scene.dynamic:
        image = motion["images"][f"{frame.camera_name}/{frame.index:06d}.png"]
        np.testing.assert_allclose(image["seen"], frame.camera.project(GRID), atol=1e-6)

    assert len(free["rigs"]) == 3 and len(free["frames"]) == 15  # a camera that moves belongs to no rig


def test_times_stand_beside_the_motion(odd_scene: Scene, tmp_path: Path) -> None:
    write_dataset("colmap", odd_scene, tmp_path / "out")
    with (tmp_path / "out/motion/times.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = {(f.camera_name, f"{f.time_s:.6f}", f.split) for f in odd_scene.dynamic}
    assert {(row["camera"], row["time_s"], row["split"]) for row in rows} == expected
    again = read_dataset("colmap", tmp_path / "out" / "motion")
    assert {f.split for f in again.static if "witness" in str(f.path)} == {"test"}
    of_frame: dict[str, list[float]] = {}
    for row in rows:
        of_frame.setdefault(row["frame"], []).append(float(row["time_s"]))
    assert all(max(times) - min(times) < 0.2 for times in of_frame.values())  # pictures are 0.75 s apart


def test_pictures_taken_at_about_the_same_time() -> None:
    fast = [("a", 0.1 * n) for n in range(5)]
    late = [("b", 0.04), ("b", 0.14), ("b", 0.24)]
    assert simultaneous(fast + late) == [[0, 5], [1, 6], [2, 7], [3], [4]]
    twice = [("b", 0.1), ("b", 0.11), ("b", 3.0)]  # the nearer one, and what is near nothing
    assert simultaneous(fast + twice) == [[0], [1, 5], [2], [3], [4], [6], [7]]
    assert simultaneous([("a", 1.0), ("b", 9.0)]) == [[0, 1]]
