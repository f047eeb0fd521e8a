"""Throughput of a batch on a Ray cluster of two nodes on this machine against the local pool; tasks Ray begins.

    python -m benchmarks.batch [--scenes 16]     # from the repository's root; needs the extra `ray`

Both batches work on the same tiny scenes (tests/pipelines/tiny_scenes.py) at the same time, two jobs of one thread
each, so that whatever else the machine does hits both alike.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.pipelines.tiny_scenes import tiny_scene

from devrf.pipelines.batch.ray_cluster import LOOPBACK_ONLY, SILENT

TASKS = 400  # empty ones; Ray has started its workers after the first fifty
WARM = 50


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=16)
    scenes = parser.parse_args().scenes
    os.environ.update(LOOPBACK_ONLY | SILENT)
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            ray_engine = ("--engine", "ray", "--address", cluster.address)
            running = {
                "local": _start(Path(folder) / "local", scenes),
                "ray": _start(Path(folder) / "ray", scenes, *ray_engine),
            }
            for name, process in running.items():
                if process.wait():
                    raise SystemExit(f"{name}: exit code {process.returncode}")
            seconds = {name: _seconds(Path(folder) / name) for name in running}
        figures = {f"{name}_s": round(value, 1) for name, value in seconds.items()}
        figures["ray_of_local_throughput"] = round(seconds["local"] / seconds["ray"], 3)
        figures["ray_tasks_per_s"] = round(_tasks_per_s(cluster.address), 1)
        print(json.dumps({"scenes": scenes, **figures}))
    finally:
        cluster.shutdown()


def _start(folder: Path, scenes: int, *words: str) -> subprocess.Popen:
    paths = [str(tiny_scene(folder, f"scene{n:02d}").parent) for n in range(scenes)]
    command = [sys.executable, "-m", "devrf.pipelines.cli", "batch", *paths, "--device", "cpu", "--jobs", "2"]
    return subprocess.Popen([*command, "--out", str(folder / "out"), "--quiet", *words])


def _seconds(folder: Path) -> float:
    """From the first task's start to the last one's end."""
    return float(json.loads((folder / "out" / "batch.json").read_text())["seconds"])


def _tasks_per_s(address: str) -> float:
    """Empty tasks that are begun and end on warm workers, as a batch submits them."""
    import ray

    def empty(n: int):  # a generator, like the tasks of a batch
        yield n

    ray.init(address=address, log_to_driver=False)
    task = ray.remote(num_returns="streaming", max_retries=0)(empty)

    def rate(count: int) -> float:
        start = time.monotonic()
        streams = [task.options(num_cpus=1, scheduling_strategy="SPREAD").remote(n) for n in range(count)]
        for stream in streams:
            ray.get(next(stream))
        return count / (time.monotonic() - start)

    rate(WARM)
    warm = rate(TASKS)
    ray.shutdown()
    return warm


if __name__ == "__main__":
    main()
