"""Batches on a real Ray cluster of two nodes on this machine, one of which is killed."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
from tests.conftest import Figures
from tests.pipelines.tiny_scenes import tiny_scene
from tests.refused import refused
from tests.waiting import wait_for

import devrf
from devrf.capture.system.errors import InputError
from devrf.pipelines.batch import ray_cluster
from devrf.pipelines.batch.ray_cluster import RayCluster
from devrf.pipelines.batch.scene_rows import STOPPED_MESSAGE
from devrf.pipelines.batch.task import Task
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED

pytest.importorskip("ray")
SCENES = {"small": 4, "full": 16}
ENVIRONMENT = {**os.environ, **ray_cluster.LOOPBACK_ONLY, **ray_cluster.SILENT}
NODES = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
other = cluster.add_node(num_cpus=1)
print(cluster.address, flush=True)
for line in sys.stdin:
    if line == "kill\\n":
        cluster.remove_node(other, allow_graceful=False)
        print("killed", flush=True)
cluster.shutdown()
"""


class Nodes:
    """Two nodes with a core each, in a process of their own."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", NODES],
            env=ENVIRONMENT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()

    def kill_the_other(self) -> None:
        """SIGKILL to one node; its scheduler, and with it all that it began, is gone."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write("kill\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "killed\n"

    def close(self) -> None:
        """End both."""
        self._process.communicate(timeout=60)


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    cluster = Nodes()
    yield cluster
    cluster.close()


def start_batch(folder: Path, nodes: Nodes, names: list[str], iterations: int) -> subprocess.Popen:
    scenes = [str(tiny_scene(folder, name, iterations).parent) for name in names]
    words = [
        "-m",
        "devrf.pipelines.cli.main",
        "batch",
        *scenes,
        "--engine",
        "ray",
        "--address",
        nodes.address,
    ]
    options = ["--device", "cpu", "--jobs", "2", "--out", str(folder / "out")]
    return subprocess.Popen(
        [sys.executable, *words, *options],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def rows(folder: Path) -> list[dict[str, Any]]:
    try:
        return json.loads((folder / "out/batch.json").read_text())["scenes"]
    except OSError:
        return []


@pytest.mark.full
def test_terminated_it_ends_what_runs_on_the_nodes(nodes: Nodes, tmp_path: Path) -> None:
    batch = start_batch(tmp_path, nodes, ["a", "b", "c"], 100_000)
    wait_for(lambda: len(list(tmp_path.glob("*/run/.new-canonical*"))) == 2, process=batch)
    runs = [json.loads(lock.read_text())["pid"] for lock in tmp_path.glob("*/run/.lock")]
    parents = [int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1]) for pid in runs]
    for parent in parents:  # they hear the signal, but take their time
        os.kill(parent, signal.SIGSTOP)
    batch.send_signal(signal.SIGTERM)
    for parent in parents:  # one after the other
        with pytest.raises(subprocess.TimeoutExpired):
            batch.communicate(timeout=3)
        os.kill(parent, signal.SIGCONT)
    said, _ = batch.communicate(timeout=90)
    assert batch.returncode == STOPPED, said
    assert {row["state"] for row in rows(tmp_path)} == {"stopped"}
    assert all(row["message"] == STOPPED_MESSAGE for row in rows(tmp_path))
    assert sorted(row["seconds"] > 0 for row in rows(tmp_path)) == [False, True, True]
    assert not list(tmp_path.glob("*/run/.lock")) and not list(tmp_path.glob("*/run/.new-*"))


@pytest.mark.full
def test_all_scenes_finish_though_a_node_is_killed(
    nodes: Nodes, tmp_path: Path, faults: Literal["small", "full"], figures: Figures
) -> None:
    names = [f"scene{n}" for n in range(SCENES[faults])]
    batch = start_batch(tmp_path, nodes, names, 400)

    def in_training() -> bool:
        """Whether both nodes train, once a quarter of all is done."""
        done = sum(row["code"] == DONE for row in rows(tmp_path))
        return done >= len(names) // 4 and len(list(tmp_path.glob("*/run/.new-canonical*"))) == 2

    wait_for(in_training, process=batch)
    training = {path.parents[1].name for path in tmp_path.glob("*/run/.new-canonical*")}
    nodes.kill_the_other()
    said, _ = batch.communicate(timeout=1800)
    assert batch.returncode == DONE, said
    found = {row["name"]: row for row in rows(tmp_path)}
    assert {row["state"] for row in found.values()} == {"done"}
    (lost,) = (name for name, row in found.items() if row["lost"])
    assert lost in training and found[lost]["lost"] == 1, said
    assert all(len(row["nodes"]) == 1 for row in found.values())  # where it came to its end
    for name in names:
        assert (tmp_path / name / "run/report/stamp.json").is_file()
        assert not list((tmp_path / name / "run").glob(".new-*"))
    figures(batch_scenes=len(names), done=sum(row["code"] == DONE for row in found.values()), lost=1)
    assert "begun anew" in said and "raylet" not in said


class Nothing:
    """What stands for the module `ray`, connected to these nodes."""

    def __init__(self, *resources: dict[str, float]) -> None:
        self._resources = resources

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": resources} for resources in self._resources]

    def remote(self, **options: object) -> Callable[[object], object]:
        return lambda work: work

    def shutdown(self) -> None: ...


def test_shares_follow_the_nodes_that_can_work(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = (
        {"CPU": 4.0, "memory": 16e9, "GPU": 1.0},
        {"CPU": 8.0, "memory": 24e9},
        {"CPU": 2.0},
        {"memory": 4e9, "GPU": 1.0},
    )
    monkeypatch.setattr(ray_cluster, "_connected", lambda address: Nothing(*nodes))
    cluster = RayCluster("auto", None, 2, "auto")
    assert (cluster.threads, cluster.memory_gb, cluster.gpus) == (4, 16.0, 1)  # of the node with a GPU
    cluster = RayCluster("auto", None, 2, "cpu")
    assert (cluster.threads, cluster.memory_gb, cluster.gpus) == (2, 6.0, 0)
    assert RayCluster("auto", 3, 2, "cpu").threads == 4
    monkeypatch.setattr(ray_cluster, "_connected", lambda address: Nothing(*nodes[2:]))
    with refused("cluster-without-memory", "--address auto", kind=InputError):
        RayCluster("auto", None, 2, "auto")


def test_a_node_that_does_not_see_the_scene_says_what_is_required(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a")
    task = Task(scene, tmp_path / "a/run", ("scene",), (), 1, False)
    for there in (task, replace(task, path=tmp_path / "none.yaml", run_dir=tmp_path)):
        ended = ray_cluster._carry_out(there, devrf.__version__)
        assert ended.code == BAD_INPUT and "must lie on a disk that all machines share" in str(ended.message)
    ended = ray_cluster._carry_out(task, "0.0.1")
    assert ended.code == FAILED and "install one everywhere" in str(ended.message)


def test_without_ray_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with refused("package-missing", "pip install 'devrf[ray]'", kind=InputError):
        RayCluster(None, None, 1, "cpu")


@pytest.mark.parametrize("address", ["127.0.0.1:9", "here"])
def test_an_address_where_nothing_answers(address: str) -> None:
    with refused("cluster-unreachable", f"--address {address}", kind=InputError):
        RayCluster(address, None, 1, "cpu")
