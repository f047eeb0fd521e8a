"""Points of a COLMAP model against COLMAP's own writer; files that are cut off are in test_bad_datasets."""

import struct
import subprocess
import sys

import numpy as np
from tests.refused import refused

from devrf.capture.formats.colmap.colmap_model import read_points
from devrf.capture.system.errors import CaptureError


def _read(folder):
    points = read_points(folder).values()
    return np.array([point.xyz for point in points]), np.array([point.rgb for point in points])


def test_damaged_count_does_not_allocate(tmp_path):
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2**60) + b"\0" * 100)
    with refused("file-damaged", kind=CaptureError):
        read_points(tmp_path)


def test_missing_file_is_named(tmp_path):
    with refused("file-missing", "points3D.bin", kind=CaptureError):
        read_points(tmp_path)


def test_agrees_with_colmap(tmp_path):
    """The oracle: a model that COLMAP itself made and wrote (in its own process, it may abort one)."""
    script = (
        "import sys, zlib, pycolmap, numpy as np\n"
        "o = pycolmap.SyntheticDatasetOptions(); o.num_rigs = 1; o.num_frames_per_rig = 4\n"
        "o.num_points3D = 50; pycolmap.set_random_seed(0); r = pycolmap.synthesize_dataset(o)\n"
        "r.write_binary(sys.argv[1])\n"
        "p = [r.points3D[k] for k in r.points3D]\n"
        "np.savez(sys.argv[1] + '/truth.npz', xyz=[q.xyz for q in p], rgb=[q.color for q in p])\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr.decode()
    truth = np.load(tmp_path / "truth.npz")
    xyz, rgb = _read(tmp_path)
    order, order_truth = np.lexsort(xyz.T), np.lexsort(truth["xyz"].T)
    np.testing.assert_array_equal(xyz[order], truth["xyz"][order_truth])
    np.testing.assert_array_equal(rgb[order], truth["rgb"][order_truth])
