"""The parent of a command: it waits, passes signals on, watches memory, and says how the work ended.

`devrf-pipeline` forks before anything heavy is imported; the child does all the work, in a process group of its own.
The parent stays small and has one thread: whatever a native library does to the child (a crash, a signal handler that
dead-locks, all the memory), someone is left to end what the child started, to put the run folder right and to say
what happened. If the parent is killed, the kernel kills the child. Where a system cannot do this (macOS) the
work is done without a parent.
"""

import faulthandler
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from devrf.capture.system.amounts import GB
from devrf.capture.system.errors import DevrfError
from devrf.capture.system.processes import adopt_orphans, descendants, die_with_parent, memory_of
from devrf.pipelines.budget.memory import left_bytes
from devrf.pipelines.run_folder.outcomes import remember_error
from devrf.pipelines.run_folder.workspace import Workspace
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import FAILED, STOPPED
from devrf.pipelines.terminal.logs import LOG_FILE, Events, log_file

# between a signal that is passed on and SIGKILL; the worker of structure from motion takes 5 s
GRACE_S = 15.0
TICK_S = 0.25  # between two looks at the child's memory ...
# ... and where less than this is left, bytes: a core fills 4 GB in a second
SHORT_TICK_S, NEAR = 0.03, 1_000_000_000
LAST_BYTES = 150_000_000  # of the machine or its cgroup; the kernel starts to kill soon after
TREE_EVERY_S = 2.0  # between two searches for what the child has started (reads all of /proc)
CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL}

_link: int | None = None  # in the child: where it tells the parent what it does


def supervised(work: Callable[[], None]) -> None:
    """Do a command's work in a child process. Returns in the child only; the parent ends with the exit code."""
    if sys.platform != "linux":
        _hear_ctrl_c()
        return work()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # ignored, a child's exit code would be lost
    asked = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGTSTP)
    waited = {s for s in asked if signal.getsignal(s) is not signal.SIG_IGN} | {
        signal.SIGCHLD,
        signal.SIGCONT,
    }
    before = signal.pthread_sigmask(signal.SIG_BLOCK, waited)  # what comes before the parent waits is kept
    parent = os.getpid()
    read, write = os.pipe()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    child = os.fork()
    if child:
        os.close(write)
        os.setpgid(child, child)  # both do it: neither can know who is first
        code = _Supervisor(child, read, waited).exit_code()
        _hear_no_more()
        sys.exit(code)
    os.close(read)
    os.setpgid(0, 0)
    die_with_parent(parent)
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # a group in the background may print
    global _link
    _link = write
    try:
        _hear_ctrl_c()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # a Ctrl-C that came meanwhile is heard here
        work()
    except KeyboardInterrupt:
        sys.exit(STOPPED)
    finally:
        _hear_no_more()


def _hear_ctrl_c() -> None:
    """As Python does, which `devrf.__main__` has changed while it loads; not where it is to be ignored."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _hear_no_more() -> None:
    """Too late: the exit code is settled. As Python leaves, it would give handlers back, and die by the signal."""
    for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(sign, signal.SIG_IGN)


def tell(**facts: str | int | None) -> None:
    """Let the parent, if there is one, know what it needs when this process dies.

    Args:
        facts: `run_dir`, and `run`, its name; `memory_budget`, bytes, or None; `stage`, or None between two; `grace_s`,
            time it needs to end in order after a signal.
    """
    if _link is not None:
        os.write(_link, json.dumps(facts).encode() + b"\n")


@contextmanager
def crash_log(run_dir: Path) -> Iterator[None]:
    """Let a crash of native code leave the Python stack in the run's log."""
    if faulthandler.is_enabled():
        yield
        return
    try:
        file = (run_dir / LOG_FILE).open("a", encoding="utf-8")
    except OSError:
        yield
        return
    with file:
        faulthandler.enable(file)
        try:
            yield
        finally:
            faulthandler.disable()


class _Supervisor:
    """Waits for the child.

    Args:
        child: Its process number, which is its group's too.
        link: Where it tells what it does.
        waited: Signals to wait for; blocked until now.
    """

    def __init__(self, child: int, link: int, waited: set[signal.Signals]) -> None:
        self._child, self._link = child, link
        self._facts: dict[str, str | int | None] = {}
        self._heard = b""
        self._kill_at: float | None = None  # when the time to end by itself is over
        self._too_much: str | None = None  # why it was ended for its memory
        self._tree, self._tree_at = [child], 0.0
        self._peak, self._left = 0, sys.maxsize  # bytes
        self._came, wake = os.pipe()  # numbers of signals
        for end in (link, self._came, wake):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(wake)
        for sign in waited:
            signal.signal(sign, lambda number, frame: None)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, waited)
        adopt_orphans()

    def exit_code(self) -> int:
        """Wait until the child has ended, and say what it could not say itself."""
        while True:
            signals = self._signals(SHORT_TICK_S if self._left < NEAR else TICK_S)
            self._listen()
            for sign in signals:
                self._pass_on(sign)
            if os.waitid(os.P_PID, self._child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
                break
            if self._kill_at is not None and time.monotonic() > self._kill_at:
                self._kill()
            elif self._too_much is None:
                self._watch_memory()
        _, status = os.waitpid(self._child, 0)
        self._listen()
        if os.WIFEXITED(status) and not self._facts.get("stage"):
            return os.WEXITSTATUS(status)
        self._kill_what_is_left()
        return self._say_how_it_died(status)

    def _signals(self, timeout_s: float) -> list[signal.Signals]:
        """What has come; waits at most so long for the first.

        Not by `sigtimedwait`: where this process was stopped for longer (SIGSTOP, a container that is paused), Python's
        returns what happens to stand in memory.
        """
        select.select([self._came], [], [], timeout_s)
        with suppress(BlockingIOError):
            return [signal.Signals(number) for number in os.read(self._came, 4096)]
        return []

    def _listen(self) -> None:
        try:
            while some := os.read(self._link, 65536):
                self._heard += some
        except BlockingIOError:
            pass
        *lines, self._heard = self._heard.split(b"\n")
        for line in lines:
            self._facts |= json.loads(line)

    def _pass_on(self, sign: signal.Signals) -> None:
        """Ask the child to end, at the second time end it; stop and go on with it."""
        if sign == signal.SIGTSTP:  # Ctrl-Z reaches the group in the foreground only
            os.killpg(self._child, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGSTOP)
        elif sign == signal.SIGCONT:
            os.killpg(self._child, signal.SIGCONT)
        elif sign != signal.SIGCHLD:
            if self._kill_at is not None:
                return self._kill()
            grace_s = self._facts.get("grace_s")
            self._kill_at = time.monotonic() + (grace_s if isinstance(grace_s, int) else GRACE_S)
            os.kill(self._child, signal.SIGINT if sign == signal.SIGINT else signal.SIGTERM)
            os.killpg(self._child, signal.SIGCONT)  # what sleeps hears nothing

    def _watch_memory(self) -> None:
        """End the run before it takes more than it may, or so much that the system would end something."""
        if not self._facts.get("run_dir"):
            return
        now = time.monotonic()
        if now - self._tree_at > TREE_EVERY_S:
            self._tree, self._tree_at = [self._child, *descendants(self._child)], now
        budget = self._facts.get("memory_budget")
        limit = budget if isinstance(budget, int) else sys.maxsize
        used, left = memory_of(self._tree), left_bytes()
        if used > limit or left < LAST_BYTES:
            used = memory_of(self._tree, shared_once=True)
        self._peak, self._left = max(self._peak, used), min(left, limit - used)
        if used > limit:
            why = f"more than budget.memory_gb allows ({limit / GB:g} GB); raise it"
        elif left < LAST_BYTES and used > left:
            why = f"and the machine has only {left / GB:.2f} GB left; close other programs"
        else:
            return
        self._too_much = (
            f"uses {used / GB:.2f} GB of memory, {why}, or lower reconstruct.image_scale, reconstruct.rays or "
            "reconstruct.resolution"
        )
        self._kill()

    def _kill(self) -> None:
        for pid in (self._child, *descendants(self._child)):
            _kill(pid)

    def _kill_what_is_left(self) -> None:
        """What the child had started has become this process's."""
        while left := descendants(os.getpid()):
            for pid in left:
                _kill(pid)
            try:
                os.waitpid(-1, 0)
            except ChildProcessError:
                break

    def _say_how_it_died(self, status: int) -> int:
        stage, run_dir = self._facts.get("stage"), self._facts.get("run_dir")
        log = f"; log: {run_dir}/{LOG_FILE}" if run_dir else ""
        code = FAILED
        if self._too_much is not None:
            of_error, message = "no-memory", f"{self._too_much}; finished stages are kept"
        elif self._kill_at is not None:
            code, of_error, message = STOPPED, "stopped", "stopped"
            if run_dir:
                message += "; finished stages are kept, the next run goes on from there"
        elif os.WIFEXITED(status):  # not by Python, which would have left the stage first
            left, of_error = os.WEXITSTATUS(status), "library-ended-program"
            message = f"a library ended the program (exit code {left}); finished stages are kept{log}"
        else:
            sign = signal.Signals(os.WTERMSIG(status))
            of_error = "library-crashed" if sign in CRASHES else "program-killed"
            why = "a native library crashed" if sign in CRASHES else "someone ended it"
            if sign == signal.SIGKILL:
                why = f"out of memory, or someone killed it; it had taken {self._peak / GB:.1f} GB"
            message = f"the program was ended by {sign.name} ({why}); finished stages are kept{log}"
        if stage and code == FAILED:
            message = f"{stage}: {message}"
        talk = Talk()
        talk.err.show_cursor()  # a bar had hidden it
        if not run_dir:
            talk.error(message, of_error)
            return code
        folder = Path(str(run_dir))
        try:
            with Workspace(folder), log_file(folder):  # entering it clears away what is half made
                talk.events = Events(folder, str(self._facts.get("run")))
                talk.error(message, of_error)
                talk.event("run_finished", code=code)
                if stage and code == FAILED:
                    remember_error(folder, str(stage), message, code, of_error)
        except DevrfError:
            talk.error(message, of_error)
        return code


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
