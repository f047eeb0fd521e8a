"""Where a run trains, and that a GPU's memory is bounded when asked for."""

from types import SimpleNamespace

import pytest
import torch
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.pipelines.inputs.device import resolve_device


@pytest.fixture
def shares(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """As if there were a GPU of 80 GB; the shares of its memory that are asked for."""
    asked: list[float] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(total_memory=80e9))
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", asked.append)
    return asked


def test_a_gpu_is_taken_as_far_as_the_budget_goes(shares: list[float]) -> None:
    assert resolve_device("auto") == "cuda" and not shares
    assert resolve_device("cuda", 2.0) == "cuda" and resolve_device("auto", 500.0) == "cuda"
    assert shares == [pytest.approx(2 / 80), 1.0]
    assert resolve_device("cpu", 2.0) == "cpu" and len(shares) == 2


def test_a_device_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto", 2.0) == "cpu"
    with refused("gpu-missing", "--device cuda", kind=InputError):
        resolve_device("cuda")
    with refused("option-unknown-value", "--device tpu", "cuda", kind=InputError):
        resolve_device("tpu")
