"""Readers of files that no quick command reaches, by name: what a stage calls, given one path."""

from collections.abc import Callable
from pathlib import Path


def _rest(path: str) -> None:
    from devrf.reconstruct.storage.model_io import load_rest

    load_rest(Path(path))


def _motion(path: str) -> None:
    from devrf.reconstruct.storage.model_io import load_motion

    load_motion(Path(path))


def _pair(path: str) -> None:
    from devrf.flow.store import read_checks, read_pair

    read_pair(Path(path))
    read_checks(Path(path))


def _flow(path: str) -> None:
    from devrf.capture.formats.parts.flow_files import read_flow_file

    read_flow_file(Path(path))


def _truth(path: str) -> None:
    from devrf.calibration.truth import read_truth

    read_truth(Path(path))


def _rig(path: str) -> None:
    from devrf.calibration.rigs.rig import read_rig

    read_rig(Path(path))


def _raft(path: str) -> None:
    from devrf.flow.raft.weights import load_raft

    load_raft(Path(path))


def _lpips(path: str) -> None:
    from devrf.reconstruct.evaluation.lpips_weights import load_weights

    load_weights("alex", Path(path).parent)


def _matte(path: str) -> None:
    from devrf.capture.mattes.given import read_given

    read_given(Path(path), 64, 48, inverted=False)


def _calibration(path: str) -> None:
    from devrf.calibration.formats import find_calibration

    find_calibration(Path(path))


def _checkpoint(path: str) -> None:
    from devrf.reconstruct.storage.checkpoint import Checkpoint
    from devrf.reconstruct.storage.training_log import TrainingLog

    checkpoint = Checkpoint(Path(path), "fuzz")
    checkpoint.begun()
    checkpoint.found(TrainingLog("cpu", 10))


READERS: dict[str, Callable[[str], None]] = {
    "rest": _rest,
    "motion": _motion,
    "pair": _pair,
    "flow": _flow,
    "truth": _truth,
    "rig": _rig,
    "raft": _raft,
    "lpips": _lpips,
    "matte": _matte,
    "calibration": _calibration,
    "checkpoint": _checkpoint,
}
