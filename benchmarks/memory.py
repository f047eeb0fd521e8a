"""Memory that trainings take against what is predicted of them: the table of docs/reliability.md.

    python -m benchmarks.memory          # from the repository's root; a quarter of an hour

Each training is a process of its own on the CPU, a few iterations through all resolutions on pictures of a ball
(tests/reconstruct/conftest.py), with a checkpoint after each, and its peak is what the kernel says (VmHWM).
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.script import finish
from tests.make.scenes import UNIT_BOX, scene_of
from tests.reconstruct import conftest as ball

from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.processes import memory_of
from devrf.flow.store import CameraFlow
from devrf.lab.bench.bench_rows import Row
from devrf.reconstruct import recipe
from devrf.reconstruct.adapt.footprint import footprint
from devrf.reconstruct.adapt.memory_fit import UNSURE
from devrf.reconstruct.options import CanonicalOptions, MotionOptions, Overrides, preset
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.storage.model_io import load_rest, save_rest
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical

RESULT = Path("benchmarks/results/memory-cpu.json")
SMALL, LARGE = (48, 40), (960, 800)
FEW_RAYS = {"rays": 2000}
ROOM = {"preset": "tiny", "plain": False}
CASES: tuple[dict[str, Any], ...] = (
    {"R": 32},
    *({"R": R, "rest": FEW_RAYS} for R in (96, 128, 160, 192)),
    *({**ROOM, "R": 32, "rest": {"shell_resolution": n, "coarse_size": 32}} for n in (128, 192, 256)),
    {**ROOM, "R": 32, "rest": {"shell_resolution": 32, "coarse_size": 192}},
    {**ROOM, "R": 112, "size": LARGE, "still": 40},
    *({"R": 32, "size": LARGE, "still": n, "rest": FEW_RAYS} for n in (10, 40)),
    {"preset": "reference", "R": 64, "rest": {"box_search": "silhouettes", "samples": 200_000}},
    {"R": 32, "times": 6},
    {"R": 96, "times": 6},
    {"R": 96, "times": 24},
    {"R": 96, "times": 6, "tuning": 4},
    *({"R": 32, "times": times, "size": LARGE} for times in (4, 16)),
    {"R": 32, "times": 16, "size": LARGE, "flow": True},
)


def main() -> None:
    """Print the table and write its rows; with a case in JSON, be the process that trains it."""
    if len(sys.argv) > 1:
        print(json.dumps(_train(json.loads(sys.argv[1]))))
        return
    rows = []
    for case in CASES:
        command = [sys.executable, "-m", "benchmarks.memory", json.dumps(case)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        predicted, measured = (count / 1e6 for count in json.loads(said.splitlines()[-1]))
        words = ", ".join(f"{key} {value}" for key, value in case.items())
        limit = round((1 + UNSURE) * predicted)  # what limits are held to
        rows.append(Row(f"memory/{words}", round(measured), "MB").at_most(limit))
        rows.append(Row(f"memory/{words}, predicted", round(predicted), "MB"))
    finish("memory", rows, RESULT)


def _train(case: dict[str, Any]) -> tuple[int, int]:
    """Predicted and measured peak, bytes."""
    with tempfile.TemporaryDirectory() as folder:
        scene = _scene(Path(folder), case)
        run = TrainingRun(checkpoint=Checkpoint(Path(folder) / "state", every_s=0.0))
        options = preset(case.get("preset", "fast"), Overrides(resolution=case["R"], adapt=False))
        rest, motion = _few_iterations(case, options.canonical, options.motion)
        if not scene.dynamic:
            held = _forget_peak()
            predicted = footprint(scene, rest, held=held).main_bytes
            train_canonical(scene, rest, run)
            return predicted, _peak()
        model = Path(folder) / "rest.safetensors"
        at_rest = train_canonical(scene, replace(rest, rays=500))
        save_rest(model, at_rest)
        del at_rest
        held = _forget_peak()
        trained = load_rest(model)
        predicted = footprint(scene, motion, held=held).main_bytes
        recipe.motion(scene, trained, _flows(scene) if case.get("flow") else {}, motion, run)
        return predicted, _peak()


def _few_iterations(
    case: dict[str, Any], rest: CanonicalOptions, motion: MotionOptions
) -> tuple[CanonicalOptions, MotionOptions]:
    few = {"iterations": 8, "coarse_iterations": 4, "scale_at": (0.2, 0.4, 0.6, 0.7), "occupancy_every": 1}
    times, tuning = case.get("times", 2), case.get("tuning", 0)
    each = tuple([1] * len(motion.levels))
    flow = motion.flow if case.get("flow") else 0.0
    motion = replace(
        motion, iterations=each, fine_tuning=tuning, fine_tuning_given=True, most_keys=times, flow=flow
    )
    return replace(rest, **few, **case.get("rest", {})), motion


def _scene(folder: Path, case: dict[str, Any]) -> Scene:
    """Pictures of the ball: still ones from around, and where there are times three cameras that see it move."""
    plain, times = case.get("plain", True), case.get("times", 0)
    width, height = case.get("size", SMALL)
    ball.FOCAL *= width / ball.WIDTH

    def frame(name: str, index: int, eye: np.ndarray, time: float | None) -> PosedFrame:
        camera = ball.look_at(eye, width, height)
        picture = ball.ball_picture(camera, (time or 0.0) * ball.TRAVEL)[..., [2, 1, 0, 3]]
        path = folder / f"{name}_{index}.png"
        cv2.imwrite(str(path), picture if plain else np.ascontiguousarray(picture[..., :3]))
        return PosedFrame(path, camera, name, index, time, time, "train")

    still = [
        frame("static", n, eye, None) for n, eye in enumerate(ball.around(case.get("still", 6), 0.0, 0.3))
    ]
    moving = [
        frame(f"cam{c}", n, eye, n / (times - 1))
        for c, eye in enumerate(ball.around(3, 0.5, 0.5))
        for n in range(times)
    ]
    side = 1.0 if plain else 0.7
    behind = "white" if plain else "shell"
    return scene_of(still, moving, aabb=side * UNIT_BOX, near=0.5, far=6.0, background=behind)


def _flows(scene: Scene) -> dict[str, CameraFlow]:
    """A flow of a quarter of a pixel everywhere."""
    found = {}
    for name in {frame.camera_name for frame in scene.dynamic}:
        frames = [frame for frame in scene.dynamic if frame.camera_name == name]
        shape = (len(frames) - 1, frames[0].camera.height, frames[0].camera.width)
        flow, valid = np.full((*shape, 2), 0.25, np.float16), np.ones(shape, bool)
        indices = np.arange(1, len(frames), dtype=np.int32)
        found[name] = CameraFlow(name, indices, flow, valid, valid.astype(np.uint8))
    return found


def _peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


def _forget_peak() -> int:
    """Making pictures, and the scene at rest that is needed first, must not be counted; bytes held now."""
    Path("/proc/self/clear_refs").write_text("5")
    return memory_of([os.getpid()])


if __name__ == "__main__":
    main()
