"""Optical flow by every method: error on pairs with truth, seconds per pair, bytes per pixel on disk.

`middlebury_flow`: RubberWhale and Venus, end-point error over all pixels whose truth is known. Speed: RubberWhale
enlarged to 960 x 540, one way, best of a few. Store: both pairs' flow with its confidence, as stage `flow` writes it.
"""

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from devrf.capture.photos.picture_files import read_pixels
from devrf.flow.consistency import endpoint_error
from devrf.flow.estimator import FlowEstimator, create_estimator
from devrf.flow.pair import estimated, measured
from devrf.flow.store import pair_path, write_pair
from devrf.lab.bench.accuracy.cases import Cases, not_there
from devrf.lab.bench.bench_rows import Row

PAIRS, WEIGHTS = "middlebury_flow", "weights/raft-small.pth"
METHODS = ("dis medium", "raft small")
PUBLISHED_PX = {
    "RubberWhale": {"dis medium": (0.226, 0.23), "raft small": (0.320, 0.33)},
    "Venus": {"dis medium": (0.384, 0.40), "raft small": (0.373, 0.38)},
}
"""By pair and method: what others reach, and the goal."""
SOURCE = "OpenCV's DIS, and the authors' RAFT with the same weights, 20 steps, on the same pairs"
UNKNOWN = 1e9  # Middlebury marks pixels without truth by larger values
SIZE = (960, 540)
GOAL_S, GOAL_BYTES = 3.0, 2.5
REPEATS = 5

Pair = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]


def accuracy(cases: Cases) -> list[Row]:
    """End-point errors."""
    rows: list[Row] = []
    for folder, (first, second), method, estimator in _estimators(cases, METHODS):
        name = folder.name
        title = f"flow/{name}/{method}/end-point error"
        if estimator is None:
            rows.append(not_there(title, "px", WEIGHTS))
            continue
        truth, known = _truth(folder / "flow10.flo")
        error = float(endpoint_error(estimator.estimate(first, second)[known], truth[known]).mean())
        anchor, goal = PUBLISHED_PX[name].get(method, (None, None))
        rows.append(Row(title, error, "px", anchor=anchor, source=SOURCE if anchor else None).at_most(goal))
    return rows or [not_there("flow/end-point error", "px", PAIRS)]


def speed(cases: Cases) -> list[Row]:
    """Seconds per pair, on as many threads as torch and OpenCV take here."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    cases.talk.say(f"flow: {torch.get_num_threads()} threads; the machine's load beforehand was {load:.1f}")
    rows: list[Row] = []
    for _, pair, method, estimator in _estimators(cases, METHODS, ("RubberWhale",)):
        title = f"flow/{SIZE[0]}x{SIZE[1]}/{method}/a pair"
        if estimator is None:
            rows.append(not_there(title, "s", WEIGHTS))
            continue
        first, second = (cv2.resize(picture, SIZE, interpolation=cv2.INTER_CUBIC) for picture in pair)
        taken = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            estimator.estimate(first, second)
            taken.append(time.perf_counter() - start)
        # The least: what the method takes, not what others took meanwhile.
        rows.append(Row(title, min(taken), "s").at_most(GOAL_S if method == "raft small" else None))
    return rows or [not_there("flow/seconds", "s", PAIRS)]


def store(cases: Cases) -> list[Row]:
    """Bytes per pixel on disk, vectors and confidence."""
    rows: list[Row] = []
    for folder, pair, method, estimator in _estimators(cases, ("dis medium", "raft small")):
        title, unit = f"flow/{folder.name}/{method}/on disk", "bytes per pixel"
        if estimator is None:
            rows.append(not_there(title, unit, WEIGHTS))
            continue
        height, width = pair[0].shape[:2]
        found = measured(estimated(estimator), 1, pair[::-1].__getitem__, (width, height), False, 1)
        path = pair_path(cases.out / "flow", f"{folder.name} {method}", 1)  # of the second picture: backward
        write_pair(path, found[0], found[1], {})
        rows.append(Row(title, path.stat().st_size / (width * height), unit).at_most(GOAL_BYTES))
    return rows or [not_there("flow/on disk", "bytes per pixel", PAIRS)]


def _estimators(
    cases: Cases, methods: Sequence[str], names: Iterable[str] = PUBLISHED_PX
) -> Iterator[tuple[Path, Pair, str, FlowEstimator | None]]:
    """Every pair of pictures with every method; nothing without pairs, no estimator without its weights."""
    pairs = cases.real(PAIRS)
    weights = None if cases.data is None else cases.data / WEIGHTS
    for folder in () if pairs is None else (pairs / name for name in names):
        first, second = (read_pixels(folder / f"frame{n}.png") for n in (10, 11))
        for method in methods:
            estimator = None
            if method == "dis medium":
                estimator = create_estimator("dis")
            elif weights is not None and weights.is_file():
                estimator = create_estimator("raft", weights)
            yield folder, (first, second), method, estimator


def _truth(path: Path) -> tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Middlebury's .flo: magic, width, height, then (u, v) row by row."""
    data = path.read_bytes()
    width, height = np.frombuffer(data, "<i4", 2, offset=4)
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)
    return flow, np.abs(flow).max(-1) < UNKNOWN
