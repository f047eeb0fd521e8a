"""Flow on disk: what comes back, how exact and how large it is, and what a damaged file says."""

import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.system.errors import FlowError
from devrf.flow.store import BEST, pair_path, read_checks, read_flows, read_pair, write_pair


def sample(height: int = 21, width: int = 37) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    flow = (20 * rng.normal(size=(height, width, 2))).astype(np.float32)
    return flow, rng.integers(0, BEST + 1, (height, width)).astype(np.uint8)


def test_round_trip_to_a_128th_of_a_pixel(tmp_path):
    flow, confidence = sample()
    write_pair(tmp_path / "x.npz", flow, confidence, {"pixels": 3})
    back, again = read_pair(tmp_path / "x.npz")
    np.testing.assert_array_equal(again, confidence)
    valid = confidence > 0
    # half a step of 1/64 px, and half precision, which has 11 bits: up to 128 px half a step of 1/16
    limit = 1 / 128 + np.abs(flow[valid]) * 2.0**-11
    assert (np.abs(back[valid].astype(np.float32) - flow[valid]) <= limit).all()
    assert not back[~valid].any()
    assert read_checks(tmp_path / "x.npz") == {"pixels": 3}


@pytest.mark.parametrize("far", [-600.0, 512.0, np.nan])
def test_what_does_not_fit_is_not_valid(tmp_path, far):
    flow, confidence = np.zeros((2, 4, 2), np.float32), np.full((2, 4), BEST, np.uint8)
    flow[0, 1, 0], flow[1, 3] = far, 510.0
    write_pair(tmp_path / "x.npz", flow, confidence, {})
    back, again = read_pair(tmp_path / "x.npz")
    assert again[0, 1] == 0 and (np.delete(again.ravel(), 1) == BEST).all()
    assert back[1, 3].tolist() == [510, 510] and not back[0].any()


def test_smooth_flow_takes_little_room(tmp_path):
    y, x = np.mgrid[:120, :160].astype(np.float32)
    rng = np.random.default_rng(0)
    flow = np.stack([np.sin(x / 20) * 5, np.cos(y / 15) * 3], axis=-1) + rng.normal(0, 0.05, (120, 160, 2))
    confidence = rng.integers(10, BEST + 1, (120, 160)).astype(np.uint8)
    write_pair(tmp_path / "x.npz", flow.astype(np.float32), confidence, {})
    assert (tmp_path / "x.npz").stat().st_size <= 2.5 * 120 * 160


def test_cameras_and_entries_come_in_order(tmp_path):
    flow, confidence = sample()
    for camera, index in (("b", 1_000_000), ("b", 9), ("a", 3)):
        write_pair(pair_path(tmp_path, camera, index), flow, confidence, {})
    flows = read_flows(tmp_path)
    assert list(flows) == ["a", "b"] and flows["b"].index.tolist() == [9, 1_000_000]
    assert flows["b"].flow.shape == (2, 21, 37, 2) and flows["b"].valid.dtype == bool
    np.testing.assert_array_equal(flows["b"].confidence, np.stack([confidence] * 2))


@pytest.mark.parametrize("content", [b"", b"nothing", b"PK\x03\x04 cut"])
def test_damaged_file_is_named(tmp_path, content):
    path = pair_path(tmp_path, "cam0", 4)
    path.parent.mkdir()
    path.write_bytes(content)
    with refused("file-damaged", "000004.npz", "--force flow", kind=FlowError):
        read_flows(tmp_path)


def test_a_flipped_byte_is_named_or_harmless(tmp_path):
    """Wherever it is: in zip's headers, zlib's stream or numpy's header."""
    flow, confidence = sample()
    path = tmp_path / "x.npz"
    write_pair(path, flow, confidence, {"pixels": 3})
    whole, (expected, _), rng = path.read_bytes(), read_pair(path), np.random.default_rng(0)
    named = 0
    for _ in range(400):
        damaged = bytearray(whole)
        damaged[rng.integers(len(damaged))] ^= rng.integers(1, 256)
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read_pair(path)[0], expected)
        except FlowError as error:
            assert error.code == "file-damaged" and "x.npz" in str(error)
            named += 1
    assert named > 300  # most bytes are compressed vectors
