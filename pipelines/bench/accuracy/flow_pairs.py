"""Optical flow by every method: error on pairs with truth, seconds per pair, bytes per pixel on disk.

`middlebury_flow`: RubberWhale and Venus, end-point error over all pixels whose truth is known. Speed: RubberWhale
enlarged to 960 x 540, one way, best of a few. Store: both pairs' flow with its confidence, as stage `flow` writes it.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from devrf.capture.picture_files import read_pixels
from devrf.flow.consistency import endpoint_error
from devrf.flow.estimator import FlowEstimator, create_estimator
from devrf.flow.pair import estimated, measured
from devrf.flow.store import pair_path, write_pair
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.rows import Row, with_goal

PAIRS, WEIGHTS = "middlebury_flow", "weights/raft-small.pth"
METHODS = ("dis medium", "raft small")
GOAL_PX = {
    ("RubberWhale", "dis medium"): 0.23,
    ("RubberWhale", "raft small"): 0.33,
    ("Venus", "dis medium"): 0.40,
    ("Venus", "raft small"): 0.38,
}
ANCHOR_PX = {
    ("RubberWhale", "dis medium"): 0.226,
    ("RubberWhale", "raft small"): 0.320,
    ("Venus", "dis medium"): 0.384,
    ("Venus", "raft small"): 0.373,
}
SOURCE = "OpenCV's DIS, and the authors' RAFT with the same weights, 20 steps, on the same pairs"
UNKNOWN = 1e9  # Middlebury marks pixels without truth by larger values
SIZE = (960, 540)
GOAL_S, GOAL_BYTES = 3.0, 2.5
REPEATS = 5

Pair = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]


def accuracy(cases: Cases) -> list[Row]:
    """End-point errors."""
    rows: list[Row] = []
    for name, folder in _pairs(cases):
        first, second = _pictures(folder)
        truth, known = _truth(folder / "flow10.flo")
        for method in METHODS:
            title, estimator = f"flow/{name}/{method}/end-point error", _estimator(cases, method)
            if estimator is None:
                rows.append(not_there(title, "px", WEIGHTS))
                continue
            error = float(endpoint_error(estimator.estimate(first, second)[known], truth[known]).mean())
            anchor = ANCHOR_PX.get((name, method))
            row = Row(title, error, "px", anchor=anchor, source=SOURCE if anchor else None)
            goal = GOAL_PX.get((name, method))
            rows.append(row if goal is None else with_goal(row, goal, low_is_good=True))
    return rows or [not_there("flow/end-point error", "px", PAIRS)]


def speed(cases: Cases) -> list[Row]:
    """Seconds per pair, on as many threads as torch and OpenCV take here."""
    found = dict(_pairs(cases)).get("RubberWhale")
    if found is None:
        return [not_there("flow/seconds", "s", PAIRS)]
    first, second = (cv2.resize(picture, SIZE, interpolation=cv2.INTER_CUBIC) for picture in _pictures(found))
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    cases.talk.say(f"flow: {torch.get_num_threads()} threads; the machine's load beforehand was {load:.1f}")
    rows: list[Row] = []
    for method in METHODS:
        title, estimator = f"flow/{SIZE[0]}x{SIZE[1]}/{method}/a pair", _estimator(cases, method)
        if estimator is None:
            rows.append(not_there(title, "s", WEIGHTS))
            continue
        taken = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            estimator.estimate(first, second)
            taken.append(time.perf_counter() - start)
        row = Row(title, min(taken), "s")  # the least: what the method takes, not what others took meanwhile
        rows.append(with_goal(row, GOAL_S, low_is_good=True) if method == "raft small" else row)
    return rows


def store(cases: Cases) -> list[Row]:
    """Bytes per pixel on disk, vectors and confidence."""
    rows: list[Row] = []
    for name, folder in _pairs(cases):
        pictures = _pictures(folder)[::-1]  # backward
        height, width = pictures[0].shape[:2]
        for method in ("dis medium", "raft small"):
            title, estimator = f"flow/{name}/{method}/on disk", _estimator(cases, method)
            if estimator is None:
                rows.append(not_there(title, "bytes per pixel", WEIGHTS))
                continue
            found = measured(estimated(estimator), 1, pictures.__getitem__, (width, height), False, 1)
            path = pair_path(cases.out / "flow", f"{name} {method}", 1)
            write_pair(path, found[0], found[1], {})
            row = Row(title, path.stat().st_size / (width * height), "bytes per pixel")
            rows.append(with_goal(row, GOAL_BYTES, low_is_good=True))
    return rows or [not_there("flow/on disk", "bytes per pixel", PAIRS)]


def _pairs(cases: Cases) -> Iterator[tuple[str, Path]]:
    folder = cases.real(PAIRS)
    if folder is not None:
        yield from ((name, folder / name) for name in ("RubberWhale", "Venus"))


def _estimator(cases: Cases, method: str) -> FlowEstimator | None:
    """None where its weights are not there."""
    if method == "dis medium":
        return create_estimator("dis")
    weights = None if cases.data is None else cases.data / WEIGHTS
    return create_estimator("raft", weights) if weights is not None and weights.is_file() else None


def _pictures(folder: Path) -> Pair:
    first, second = (read_pixels(folder / f"frame{n}.png") for n in (10, 11))
    return first, second


def _truth(path: Path) -> tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Middlebury's .flo: magic, width, height, then (u, v) row by row."""
    data = path.read_bytes()
    width, height = np.frombuffer(data, "<i4", 2, offset=4)
    flow = np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)
    return flow, np.abs(flow).max(-1) < UNKNOWN
