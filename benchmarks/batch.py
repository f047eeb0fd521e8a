"""A batch on a Ray cluster of two nodes on this machine against the local pool; what tasks and looks cost.

    python -m benchmarks.batch [--scenes 16] [--json FILE]     # from the repository's root; needs the extra `ray`

Both batches work on the same tiny scenes (tests/pipelines/tiny_scenes.py) at the same time, two jobs of one thread
each, so that whatever else the machine does hits both alike.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from benchmarks.script import arguments, finish
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.batch.ray_cluster import LOOPBACK_ONLY, SILENT
from devrf.pipelines.batch.scenes import BatchOptions, look, stand

GOAL = 0.9  # of the local pool's throughput
TASKS = 400  # empty ones; Ray has started its workers after the first fifty
WARM = 50


def main() -> None:
    """Print the rows, and write them where asked."""
    asked = arguments(__doc__, scenes=16)
    os.environ.update(LOOPBACK_ONLY | SILENT)
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            local, ray = Path(folder) / "local", Path(folder) / "ray"
            running = [
                _start(local, asked.scenes),
                _start(ray, asked.scenes, "--engine", "ray", "--address", cluster.address),
            ]
            for process in running:
                if process.wait():
                    raise SystemExit(f"{process.args}: exit code {process.returncode}")
            local_s, ray_s, look_s = _seconds(local), _seconds(ray), _look_s(local)
        rate = _tasks_per_s(cluster.address)
    finally:
        cluster.shutdown()
    name = f"batch/{asked.scenes} scenes"
    rows = [
        Row(f"{name}, local pool", local_s, "s"),
        Row(f"{name}, Ray cluster of two nodes", ray_s, "s"),
        Row(f"{name}, throughput on Ray of that of the local pool", local_s / ray_s, "").at_least(GOAL),
        Row("batch/empty tasks that Ray begins and ends", rate, "1/s"),
        Row("batch/looking at a scene that is fresh, processor time", look_s, "s"),
    ]
    finish("batch", rows, asked.json, ray=version("ray"))


def _start(folder: Path, scenes: int, *words: str) -> subprocess.Popen:
    paths = [str(tiny_scene(folder, f"scene{n:02d}").parent) for n in range(scenes)]
    command = [
        sys.executable,
        "-m",
        "devrf.pipelines.cli.main",
        "batch",
        *paths,
        "--device",
        "cpu",
        "--jobs",
        "2",
    ]
    return subprocess.Popen([*command, "--out", str(folder / "out"), "--quiet", *words])


def _seconds(folder: Path) -> float:
    """From the first task's start to the last one's end."""
    return float(json.loads((folder / "out" / "batch.json").read_text())["seconds"])


def _look_s(folder: Path) -> float:
    """What a batch does for a scene of which nothing is to be made, the first one left out: it pays for the imports."""
    first, *others = sorted(folder.glob("*/scene.yaml"))
    _stand([first])
    start = time.process_time()
    _stand(others)
    return (time.process_time() - start) / len(others)


def _stand(paths: list[Path]) -> None:
    for scene in look(paths, BatchOptions()):
        stand(scene)
        if not scene.stages or scene.to_do:
            raise SystemExit(f"{scene.path}: {', '.join(scene.to_do)} would be made again")


def _tasks_per_s(address: str) -> float:
    """Empty tasks that are begun and end on warm workers, as a batch submits them."""
    import ray

    def empty(n: int) -> int:
        return n

    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    task = ray.remote(max_retries=0)(empty)

    def rate(count: int) -> float:
        start = time.monotonic()
        ray.get([task.options(num_cpus=1, scheduling_strategy="SPREAD").remote(n) for n in range(count)])
        return count / (time.monotonic() - start)

    rate(WARM)
    warm = rate(TASKS)
    ray.shutdown()
    return warm


if __name__ == "__main__":
    main()
