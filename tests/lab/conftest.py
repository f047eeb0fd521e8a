"""A data set for benchmarks."""

from pathlib import Path

import pytest

from devrf.lab.simulate.protocol.dataset_options import DatasetOptions
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.scenes.simulation import Simulation

SMALL = {
    "resolution": 16, "rays": 128, "canonical_iterations": 60, "motion_iterations": 10, "image_scale": 1.0,
}  # fmt: skip
SETTINGS = [part for key, value in SMALL.items() for part in ("--set", f"reconstruct.{key}={value}")]


@pytest.fixture(scope="session")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of 32 x 32 pictures for benchmarks; SETTINGS are quick on it."""
    folder = tmp_path_factory.mktemp("arm")
    options = DatasetOptions(
        static_views=14, static_test_views=1, times=3, test_views_per_time=1, spp=4, motion_scale=0.3
    )
    simulate_dataset(folder, Simulation("arm", 2, 0, (32, 32), options))
    return folder
