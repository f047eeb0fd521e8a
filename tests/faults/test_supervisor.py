"""The parent process of a run: what it says when the child dies, what it passes on, and that nothing is left behind."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from tests.faults.harness import Tiny, children_of, ends
from tests.waiting import wait_for

from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED


@pytest.mark.parametrize(
    ("fault", "code", "named"),
    [
        ("segfault", "library-crashed", "SIGSEGV"),
        ("exit", "library-ended-program", r"\(exit code 0\)"),
        ("abort", "library-crashed", "SIGABRT"),
        ("killed", "program-killed", r"SIGKILL.* 0\.\d GB"),
    ],
)
def test_a_death_is_explained(tiny: Tiny, fault: str, code: str, named: str) -> None:
    result = tiny.run(f"fault={fault}")
    assert result.returncode == FAILED
    assert "Traceback" not in result.stderr and result.stderr.endswith(f"[{code}]\n")
    remembered = json.loads((tiny.run_dir / ".failed-parts.json").read_text())
    assert (remembered["code"], remembered["error"]) == (FAILED, code)
    assert not [p.name for p in tiny.run_dir.iterdir() if p.name.startswith((".new", ".lock"))]
    log = (tiny.run_dir / "devrf.log").read_text()
    for said in (result.stderr, remembered["message"], log):
        assert re.search(rf"parts: .*{named}", said), said
    if fault not in ("killed", "exit"):
        assert "Fatal Python error" in log and "tiny_stages.py" in log  # where it crashed
    again = tiny.run()
    assert again.returncode == DONE
    assert "frames: skipped" in again.stdout and "parts: runs" in again.stdout


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_is_passed_on_once(tiny: Tiny, sign: signal.Signals) -> None:
    started = tiny.at_work("big", "fault=sleep")
    started.send_signal(sign)
    ended = started.end()
    assert ended.returncode == STOPPED
    assert ended.stderr.endswith("[stopped]\n") and ended.stderr.count("\n") == 1
    assert not list(tiny.run_dir.glob(".new-*"))


def ignores(pid: int, sign: signal.Signals) -> bool:
    """Whether a process does not let a signal through."""
    with open(f"/proc/{pid}/status") as file:
        mask = next(line.split()[1] for line in file if line.startswith("SigIgn:"))
    return bool(int(mask, 16) >> (sign - 1) & 1)


def test_one_that_hears_no_signal_is_killed_at_the_second(tiny: Tiny) -> None:
    started = tiny.at_work("big", "fault=deaf")
    (child,) = children_of(started.pid)
    wait_for(lambda: ignores(child, signal.SIGTERM))
    started.terminate()
    assert not ends(child, 0.5)
    started.terminate()
    ended = started.end(timeout=10)  # before the time to end by itself is over
    assert ended.returncode == STOPPED and ended.stderr.endswith("[stopped]\n")
    assert ends(child, 30)
    assert not list(tiny.run_dir.glob(".new-*")) and not (tiny.run_dir / ".lock").exists()


def test_ctrl_z_stops_the_child_too(tiny: Tiny) -> None:
    def state(pid: int) -> str:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0]

    def becomes(pid: int, states: str) -> None:
        wait_for(lambda: state(pid) in states)

    started = tiny.at_work("big", "fault=sleep")
    (child,) = children_of(started.pid)
    started.send_signal(signal.SIGTSTP)
    becomes(child, "T")
    becomes(started.pid, "T")
    started.send_signal(signal.SIGCONT)
    becomes(child, "RS")
    becomes(started.pid, "RS")
    started.terminate()
    assert started.end().returncode == STOPPED


def test_the_parent_may_sleep(tiny: Tiny) -> None:
    started = tiny.at_work("big", "fault=sleep")
    for _ in range(3):
        started.send_signal(signal.SIGSTOP)
        time.sleep(0.6)  # longer than it waits for a signal
        started.send_signal(signal.SIGCONT)
        assert not ends(started.pid, 0.3)
    started.terminate()
    assert started.end().returncode == STOPPED


def test_the_child_ends_with_its_parent(tiny: Tiny) -> None:
    started = tiny.at_work("big", "fault=deaf")
    (child,) = children_of(started.pid)
    started.kill()
    started.end()
    assert ends(child, 30)
    assert tiny.run().returncode == DONE


def test_what_the_child_started_ends_with_it(tiny: Tiny) -> None:
    started = tiny.at_work("big", "fault=orphan")
    note = tiny.folder / "orphan.pid"
    wait_for(lambda: note.exists() and note.read_text())
    (child,) = children_of(started.pid)
    os.kill(child, signal.SIGKILL)
    assert started.end().returncode == FAILED
    assert ends(int(note.read_text()), 30)


def test_more_memory_than_allowed_ends_the_run_before_the_system_does(tiny: Tiny) -> None:
    result = tiny.run("fault=eat", "budget.memory_gb=0.3")
    assert result.returncode == FAILED
    assert "budget.memory_gb" in result.stderr and "[no-memory]" in result.stderr
    used, allowed = map(float, re.findall(r"([\d.]+) GB", result.stderr))
    assert result.stderr.startswith("parts: ") and allowed == 0.3 <= used < 1
    assert json.loads((tiny.run_dir / ".failed-parts.json").read_text())["code"] == FAILED


def test_who_needs_longer_to_end_in_order_may_say_so() -> None:
    code = (
        "import signal, sys, time\n"
        "from devrf.pipelines.runner import supervise\n"
        "supervise.GRACE_S = 0.1\n"
        "def work():\n"
        "    def slowly(*_):\n"
        "        time.sleep(1)\n"
        "        sys.exit(7)\n"
        "    signal.signal(signal.SIGTERM, slowly)\n"
        "    supervise.tell(grace_s=60)\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
        "supervise.supervised(work)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None and started.stdout.readline() == "ready\n"
        started.terminate()
    assert started.returncode == 7


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_comes_as_python_leaves_changes_no_exit_code(sign: signal.Signals) -> None:
    """Sent by the parent to itself, when its modules are taken down and its handlers are gone."""
    code = (
        "import os, sys\n"
        "from devrf.pipelines.runner.supervise import supervised\n"
        "class Late:\n"
        "    def __init__(self, kill, pid): self.kill, self.pid = kill, pid\n"
        f"    def __del__(self): self.kill(self.pid, {int(sign)})\n"
        "late = Late(os.kill, os.getpid())\n"
        "supervised(lambda: os._exit(7))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (7, "")


def test_the_parent_is_small(tiny: Tiny) -> None:
    """When it forks, nothing heavy has been imported and there is one thread."""
    code = (
        "import devrf.pipelines.cli.main, os, sys;"
        "print(sorted({'torch', 'cv2', 'av', 'scipy', 'warp', 'pycolmap'} & sys.modules.keys()));"
        "from devrf.pipelines.runner.supervise import supervised;"
        "supervised(lambda: print(open(f'/proc/{os.getppid()}/status').read()))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.startswith("[]\n")
    assert "Threads:\t1\n" in said
    assert int(said.split("VmRSS:")[1].split()[0]) < 150_000  # kB, nearly all shared with the child
