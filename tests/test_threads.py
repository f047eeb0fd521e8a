"""Threads of OpenMP sleep while they wait, however the program is started."""

import os
import subprocess
import sys

import pytest


def policy_of_torch(module: str, **environment: str) -> str:
    """What OpenMP says its policy is when torch comes after a module of ours, in a process of its own."""
    clean = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, "-c", f"import {module}, torch"],
        env={**clean, **environment, "OMP_DISPLAY_ENV": "true"},
        capture_output=True,
        text=True,
        check=True,
    )
    (line,) = {line.strip() for line in result.stderr.splitlines() if "OMP_WAIT_POLICY" in line}
    return line.split("=")[1].strip(" '")


@pytest.mark.parametrize(
    "module",
    [
        "devrf",
        *(
            pytest.param(module, marks=pytest.mark.full)
            for module in ("devrf.pipelines.cli.main", "devrf.calibration.sweep.sfm_worker")
        ),
    ],
)
def test_threads_sleep_while_they_wait(module: str) -> None:
    assert policy_of_torch(module) == "PASSIVE"


def test_a_policy_that_is_set_stands() -> None:
    assert policy_of_torch("devrf", OMP_WAIT_POLICY="ACTIVE") == "ACTIVE"
