"""Runs one case after another for `fuzzing.py`, each in a fork of its own with all libraries imported.

A line of JSON comes in: `limit_s`, and either `arguments` of devrf-pipeline or `reader` and `path`. A line goes out:
`code` (below 0: the signal that ended it; None: over the limit), `seconds`, `worked_s`, `peak_mb`. What a case says
goes to the file `said`.
"""

import json
import os
import resource
import signal
import sys
import time
import traceback
from importlib import import_module

import cv2
from tests.faults.fuzz_readers import READERS

from devrf.capture.system.errors import DevrfError
from devrf.pipelines.cli import main as cli
from devrf.pipelines.stages import stage_names

FAILED = 1
MOST_BYTES = 12e9  # of address space: what a case asks for beyond must not take the machine down
POLL_S = 0.01
# what commands import when they need it: as much work as most cases are
LIBRARIES = "filelock matplotlib.pyplot PIL.ImageFile psutil rawpy rich.console rich.progress torch"
COMMANDS = "lab.bench.bench_command pipelines.check.check_command pipelines.init.init_command"
NEEDED_LATER = (
    *LIBRARIES.split(),
    *(f"devrf.{name}" for name in COMMANDS.split()),
    *(f"devrf.pipelines.stages.{name}" for name in (*stage_names(), "preflight")),
)


def case(job: dict) -> None:
    """What the user's process would do; does not come back."""
    os.setsid()
    said = os.open(job["said"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 1)
    os.dup2(said, 2)
    sys.stdout, sys.stderr = open(1, "w"), open(2, "w")  # noqa: SIM115 (for the whole process)
    resource.setrlimit(resource.RLIMIT_AS, (int(MOST_BYTES), int(MOST_BYTES)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    code: object = 0
    try:
        if "reader" in job:
            READERS[job["reader"]](job["path"])
        else:
            sys.argv = ["devrf-pipeline", *job["arguments"]]
            cli.main()
    except DevrfError as error:
        print(error, file=sys.stderr)
        code = FAILED
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
        code = FAILED
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else FAILED)


def serve() -> None:
    """Until the input ends."""
    for module in NEEDED_LATER:
        import_module(module)
    cv2.setNumThreads(1)
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        job = json.loads(line)
        start = time.monotonic()
        pid = os.fork()
        if pid == 0:
            case(job)
        answers.write(json.dumps(ended(pid, start, job["limit_s"])) + "\n")
        answers.flush()


def ended(pid: int, start: float, limit_s: float) -> dict:
    """Wait for a case; one over its limit is killed with all that it started."""
    late = False
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if not late and time.monotonic() - start > limit_s:
            late = True
            os.killpg(pid, signal.SIGKILL)
        time.sleep(POLL_S)
    try:
        os.killpg(pid, signal.SIGKILL)  # what it left behind
    except ProcessLookupError:
        pass
    code = None if late else os.waitstatus_to_exitcode(status)
    return {"code": code, "seconds": time.monotonic() - start, "peak_mb": usage.ru_maxrss / 1000,
            "worked_s": usage.ru_utime + usage.ru_stime}  # fmt: skip


if __name__ == "__main__":
    serve()
    os._exit(0)  # taking all those libraries apart takes seconds
