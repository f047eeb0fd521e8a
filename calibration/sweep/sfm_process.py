"""Run one job of the structure-from-motion worker in its own process and survive whatever happens to it."""

import contextlib
import json
import os
import re
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

from devrf.capture.system.errors import CalibrationError
from devrf.capture.system.processes import run_module
from devrf.capture.system.progress import Progress, no_progress

GRACE_S = 5.0  # pycolmap's SIGTERM handler can dead-lock after a heap fault: then SIGKILL
LOG_LINES = 12
STEP = re.compile(r"\[(\d+)/(\d+)\]")  # COLMAP counts its work like this: Processed file [3/50]
PHASES = {"Processed file": (0.02, 0.33), "Processing image pair": (0.35, 0.35), "Matching": (0.35, 0.35)}


def run_job(
    job: dict[str, Any],
    work: Path,
    log: Path,
    progress: Progress = no_progress,
    timeout_s: float | None = None,
    command: list[str] | None = None,
) -> dict[str, Any]:
    """Run `job` in a subprocess and give back its result.

    A worker may leave a result and go on to a better one: if it is stopped or crashes then, that result counts,
    and its `stopped` says how it ended (None otherwise).

    Args:
        job: For `sfm_worker.main`; must be JSON.
        work: Existing folder for job.json, result.json and the database.
        log: Where COLMAP's own log is kept.
        progress: Called with what the worker reports.
        timeout_s: The worker is stopped after this time; None waits for ever.
        command: What to run instead of the worker (tests).
    Raises:
        CalibrationError: The worker crashed, was stopped or left no result; carries the last log lines.
    """
    job_file = work / "job.json"
    job_file.write_text(json.dumps(job | {"parent": os.getpid()}))
    command = command or run_module("devrf.calibration.sweep.sfm_worker", str(job_file))
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w", buffering=1) as log_file:  # line by line: what was said last is what counts
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        readers = [
            threading.Thread(target=_follow_stdout, args=(process, progress), daemon=True),
            threading.Thread(target=_follow_log, args=(process, log_file, progress), daemon=True),
        ]
        for reader in readers:
            reader.start()
        try:
            process.wait(None if deadline is None else max(0.0, deadline - time.monotonic()))
        except BaseException as stopped:  # also KeyboardInterrupt: never leave the worker behind
            _stop(process)
            if not isinstance(stopped, subprocess.TimeoutExpired):
                raise
        for reader in readers:
            reader.join(timeout=GRACE_S)
    result = work / "result.json"
    late = deadline is not None and time.monotonic() >= deadline
    ended = _how_it_ended(process.returncode, timeout_s if late else None)
    if not result.is_file():
        text = (
            f"structure from motion (pycolmap) {ended}; the last lines of its log ({log.name}):\n{_tail(log)}"
        )
        raise CalibrationError("sfm-timed-out" if late else "sfm-failed", text)
    return json.loads(result.read_text()) | {"stopped": None if process.returncode == 0 else ended}


def _follow_stdout(process: subprocess.Popen[str], progress: Progress) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        word, _, rest = line.partition(" ")
        fraction, _, message = rest.strip().partition(" ")
        if word == "PROGRESS":
            progress(float(fraction), message)


def _follow_log(process: subprocess.Popen[str], log_file: Any, progress: Progress) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        with contextlib.suppress(OSError):  # a full disk; the worker must not wait for its output to be read
            log_file.write(line)
        step = STEP.search(line)
        phase = next((p for word, p in PHASES.items() if word in line), None)
        if step and phase:
            done, total = int(step[1]), int(step[2])
            what = "features" if phase[0] < 0.1 else "matching"
            progress(phase[0] + phase[1] * done / max(total, 1), f"{what}: {done} of {total}")


def _stop(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _how_it_ended(returncode: int, timeout_s: float | None) -> str:
    if timeout_s is not None:
        return f"was stopped after {timeout_s:.0f} s; use fewer or smaller pictures"
    if returncode < 0 or returncode >= 128:
        return f"crashed (signal {-returncode if returncode < 0 else returncode - 128})"
    return f"failed (exit code {returncode})"


def _tail(log: Path) -> str:
    lines = [line.rstrip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return "\n".join(f"  {line}" for line in lines[-LOG_LINES:])
