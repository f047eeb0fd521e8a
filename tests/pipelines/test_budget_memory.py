"""What a run may hold of main memory, read from copies of what Linux tells."""

from pathlib import Path

import psutil
import pytest

from devrf.pipelines.budget import memory
from devrf.pipelines.budget.memory import allowed_bytes, left_bytes
from devrf.pipelines.config.scene import SceneConfig

GB = 10**9


class Machine:
    """Folders that look like /proc and the cgroups of a machine with 32 GB free."""

    def __init__(self, folder: Path) -> None:
        self.proc, self.root = folder / "proc", folder / "root"
        (self.proc / "self").mkdir(parents=True)
        others = ("Buffers", "Cached", "Shmem", "Active", "Inactive", "MemFree")
        (self.proc / "meminfo").write_text(
            "".join(f"{name}: 5 kB\n" for name in others)
            + "MemTotal:       64000000 kB\nMemAvailable:   31250000 kB\n"
        )
        self.mounts: list[str] = []
        self.lines: list[str] = []

    def mount(self, kind: str, at: str, root: str = "/", options: str = "rw") -> None:
        self.mounts.append(f"30 23 0:26 {root} {at} rw,nosuid shared:4 - {kind} {kind} {options}")
        (self.proc / "self/mountinfo").write_text(
            "\n".join(["22 1 8:1 / / rw - ext4 /dev/sda rw", *self.mounts])
        )

    def inside(self, line: str) -> None:
        self.lines.append(line)
        (self.proc / "self/cgroup").write_text("\n".join(self.lines) + "\n")

    def v1(self, group: str, limit: int, used: int, cache: int = 0) -> None:
        folder = self.root / group
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.limit_in_bytes").write_text(f"{limit}\n")
        (folder / "memory.usage_in_bytes").write_text(f"{used}\n")
        (folder / "memory.stat").write_text(f"cache 1\ninactive_file 7\ntotal_inactive_file {cache}\n")

    def v2(self, group: str, limit: int | str, used: int, cache: int = 0) -> None:
        folder = self.root / group
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text(f"{used}\n")
        (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cache}\n")

    @property
    def left(self) -> int:
        return left_bytes(self.proc, self.root)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(tmp_path / "proc"))
    return Machine(tmp_path)


def test_without_cgroups_the_machine_decides(machine: Machine) -> None:
    assert machine.left == 32 * GB


def test_every_cgroup_up_to_the_root_counts_version_2(machine: Machine) -> None:
    machine.mount("cgroup2", "/sys/fs/cgroup")
    machine.inside("0::/user.slice/job.scope")
    machine.v2("sys/fs/cgroup/user.slice/job.scope", "max", 2 * GB)
    assert machine.left == 32 * GB
    machine.v2("sys/fs/cgroup/user.slice", 8 * GB, 5 * GB, cache=GB)
    assert machine.left == 4 * GB
    machine.v2("sys/fs/cgroup/user.slice/job.scope", 3 * GB, 2 * GB)
    assert machine.left == GB
    machine.v2("sys/fs/cgroup/user.slice/job.scope", 3 * GB, 4 * GB)
    assert machine.left == 0


def test_every_cgroup_up_to_the_root_counts_version_1(machine: Machine) -> None:
    machine.mount("cgroup", "/sys/fs/cgroup/cpu", options="rw,cpu")
    machine.mount("cgroup", "/sys/fs/cgroup/memory", options="rw,memory")
    machine.inside("4:memory:/batch/one")
    machine.inside("1:cpu:/")
    machine.v1("sys/fs/cgroup/memory", 9223372036854771712, 20 * GB)
    machine.v1("sys/fs/cgroup/memory/batch/one", 9223372036854771712, GB)
    assert machine.left == 32 * GB
    machine.v1("sys/fs/cgroup/memory/batch", 6 * GB, 2 * GB, cache=GB)
    assert machine.left == 5 * GB


def test_a_container_sees_its_own_cgroup_at_the_root_of_the_mount(machine: Machine) -> None:
    machine.mount("cgroup", "/sys/fs/cgroup/memory", root="/docker/abc", options="rw,memory")
    machine.inside("9:memory:/docker/abc")
    machine.v1("sys/fs/cgroup/memory", 2 * GB, GB)
    assert machine.left == GB
    machine.inside("9:memory:/elsewhere")  # a path of the host that the container cannot see
    assert machine.left == GB


def config(**budget: float) -> SceneConfig:
    return SceneConfig.model_validate({"name": "x", "capture": {"static": "s.mp4"}, "budget": budget})


def test_the_budget_is_kept_and_never_more_than_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "left_bytes", lambda: 15 * GB)
    monkeypatch.setattr(memory, "memory_of", lambda pids: 5 * GB)
    assert allowed_bytes(config()) == 19 * GB
    assert allowed_bytes(config(memory_gb=4)) == 4 * GB
    assert allowed_bytes(config(memory_gb=100)) == 19 * GB
    monkeypatch.setattr(memory, "left_bytes", lambda: 0)
    monkeypatch.setattr(memory, "memory_of", lambda pids: GB)
    assert allowed_bytes(config()) == 900_000_000
