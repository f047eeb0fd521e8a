"""Flow on disk comes back as it was written, without pickle."""

import numpy as np
import pytest

from devrf.capture.errors import FlowError
from devrf.flow.store import CameraFlow, read_flows, write_flow


def _flow(camera: str, seed: int = 0) -> CameraFlow:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(scale=20, size=(3, 7, 13, 2)).astype(np.float16)  # 13: not a multiple of eight bits
    return CameraFlow(camera, np.array([2, 4, 7]), vectors, rng.random((3, 7, 13)) > 0.4)


def test_round_trip(tmp_path):
    written = {name: _flow(name, seed) for seed, name in enumerate(["cam0", "cam 1"])}
    for flow in written.values():
        write_flow(tmp_path, flow)
    read = read_flows(tmp_path)
    assert read.keys() == written.keys()
    for name, flow in written.items():
        np.testing.assert_array_equal(read[name].index, flow.index)
        np.testing.assert_array_equal(read[name].valid, flow.valid)
        np.testing.assert_array_equal(read[name].flow[flow.valid], flow.flow[flow.valid])
        assert not read[name].flow[~flow.valid].any()


def test_no_pickle_inside(tmp_path):
    path = write_flow(tmp_path, _flow("cam0"))
    with np.load(path, allow_pickle=False) as data:
        assert data["flow"].dtype == np.float16 and data["valid"].dtype == np.uint8
        assert data["valid"].shape == (3, 7, 2)


@pytest.mark.parametrize("damage", [b"not an archive", None])
def test_damaged_file_is_named(tmp_path, damage):
    path = write_flow(tmp_path, _flow("cam0"))
    path.write_bytes(damage if damage else path.read_bytes()[:200])
    with pytest.raises(FlowError, match="cam0.npz.*--force flow"):
        read_flows(tmp_path)
