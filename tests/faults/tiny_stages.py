"""A pipeline of tiny stages, run by the real runner, stamps and parent process (tiny_server.py starts it).

`prepare` makes the folder. The stages take milliseconds and do what the real ones do: many files (`frames`), one that
is large (`big`), a folder of parts that outlives a killed run (`parts`), a chain of steps that goes on from its
checkpoint (`steps`), and a summary of them all (`last`). What they leave depends on their input alone, so any two runs
can be compared byte by byte. Settings name a fault (`fault`, a name in `FAULTS`, in `stage`; `at`, see tracing.py;
`room`, bytes of memory), say what to make again (`force`), or override keys of the configuration.
"""

import ctypes
import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from tests.faults.tracing import install

from devrf.capture.measure import Measure
from devrf.capture.system.durable import sync
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stamps.stamp import stamp_content
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import STOPPED

SCENE = """
name: tiny
output: run
preset: tiny
capture: {static: static.mp4, cameras: {cam0: cam0.mp4}}
"""
NAMES = ("frames", "big", "parts", "steps", "last")
FRAMES, BIG_BYTES, PARTS, STEPS = 12, 400_000, 8, 12
WORKING_BYTES = 30_000_000  # memory of the stage `steps`
STEP_S = 0.004  # a pause in every step, so that faults find the stages at work


def prepare(folder: Path) -> None:
    """Write scene.yaml and its raw files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "static.mp4").write_bytes(b"sweep")
    (folder / "cam0.mp4").write_bytes(b"clip")
    (folder / "scene.yaml").write_text(SCENE)


def frames(context: StageContext) -> None:
    """Many small files."""
    for n in range(FRAMES):
        file = context.out / "frames" / f"{n:03d}.bin"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(_noise(f"frame {n}", 3000 + 500 * n))
        _pause(context, n / FRAMES)


def big(context: StageContext) -> None:
    """One large file, written piece by piece."""
    with (context.out / "big.bin").open("wb") as file:
        for n in range(8):
            file.write(_noise(f"big {n}", BIG_BYTES // 8))
            _pause(context, n / 8)


def parts(context: StageContext) -> None:
    """Parts in a folder beside the stages, as `flow` does: a run that was killed finds those it has."""
    unfinished = context.run_dir / ".parts"
    mark, made_of = unfinished / "made_of", stamp_content(context.run_dir / "frames") or ""
    if not (mark.is_file() and mark.read_text() == made_of):
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        mark.write_text(made_of)
    for n in range(PARTS):
        part = unfinished / f"{n}.bin"
        if not part.is_file():
            source = (context.run_dir / "frames" / "frames" / f"{n:03d}.bin").read_bytes()
            _whole(part, _noise(f"part {n} {hashlib.sha256(source).hexdigest()}", 20_000))
        _pause(context, n / PARTS)
    for n in range(PARTS):
        (unfinished / f"{n}.bin").rename(context.out / f"{n}.bin")
    shutil.rmtree(unfinished)


def steps(context: StageContext) -> None:
    """A chain in which each step needs the one before, with a checkpoint, as training does."""
    checkpoint = context.run_dir / ".steps.json"
    made_of = stamp_content(context.run_dir / "parts")
    try:
        state = json.loads(checkpoint.read_text())
    except (OSError, ValueError):
        state = {}
    if state.get("made_of") != made_of:
        state = {"made_of": made_of, "step": 0, "value": _content(context.run_dir / "parts")}
    working_memory = bytearray(WORKING_BYTES)
    while state["step"] < STEPS:
        working_memory[state["step"]] = 1
        state["step"] += 1
        state["value"] = hashlib.sha256(state["value"].encode()).hexdigest()
        if state["step"] % 3 == 0:
            _whole(checkpoint, json.dumps(state).encode())
        _pause(context, state["step"] / STEPS)
    (context.out / "model.txt").write_text(state["value"])
    checkpoint.unlink(missing_ok=True)


def last(context: StageContext) -> None:
    """Digests of all that the others left."""
    found = {name: _content(context.run_dir / name) for name in NAMES[:-1]}
    (context.out / "summary.json").write_text(json.dumps(found))
    context.measures.append(Measure("sweep-registered", 1.0))


def stages() -> tuple[Stage, ...]:
    """The pipeline."""
    return (
        Stage("frames", (), ("capture.static",), _always, frames),
        Stage("big", (), ("capture.cameras",), _always, big),
        Stage("parts", ("frames",), (), _always, parts),
        Stage("steps", ("parts",), ("reconstruct.seed",), _always, steps),
        Stage("last", NAMES[:-1], (), _always, last),
    )


def fault_in(name: str, fault: Callable[[], None]) -> tuple[Stage, ...]:
    """The pipeline with a stage that does half of its work and then what `fault` does."""

    def broken(context: StageContext) -> None:
        (context.out / "half.bin").write_bytes(b"half")
        (context.out / "native.log").write_text("what the library said last\n")
        fault()

    return tuple(replace(stage, run=broken) if stage.name == name else stage for stage in stages())


def segfault() -> None:
    """Crash as a native library does."""
    ctypes.string_at(0)


def deaf() -> None:
    """Hang and hear no signal, as native code in a dead lock."""
    for sign in (signal.SIGINT, signal.SIGTERM):  # SIGTERM last: a test waits for it
        signal.signal(sign, signal.SIG_IGN)
    time.sleep(600)


def eat() -> None:
    """Take more and more memory."""
    kept = []
    while True:
        kept.append(bytearray(os.urandom(1)) * 20_000_000)
        time.sleep(0.02)


def orphan() -> None:
    """Start a program that goes on whatever happens, and wait for it."""
    program = subprocess.Popen(["sleep", "600"], start_new_session=True)
    (Path(sys.argv[1]) / "orphan.pid").write_text(str(program.pid))
    program.wait()


FAULTS: dict[str, Callable[[], None]] = {
    "sleep": lambda: time.sleep(600),
    "orphan": orphan,
    "segfault": segfault,
    "abort": os.abort,
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "exit": lambda: os._exit(0),  # as C's exit() does
    "deaf": deaf,
    "eat": eat,
}


def main(folder: Path, settings: dict[str, str]) -> int:
    """Run the pipeline in `folder`; the exit code."""
    if "at" in settings:
        at, victims, sign = (
            int(settings.pop("at")),
            settings.pop("victims", "both"),
            settings.pop("sign", "SIGKILL"),
        )
        on_disk = settings.pop("on_disk", None)
        install(folder / "run", at, victims, sign, None if on_disk is None else Path(on_disk))
    if "room" in settings:
        _leave_room(int(settings.pop("room")))
    fault = settings.pop("fault", None)
    pipeline = stages() if fault is None else fault_in(settings.pop("stage", "parts"), FAULTS[fault])
    choice = Choice(force=tuple(filter(None, settings.pop("force", "").split(","))))
    try:
        config = load_scene(folder / "scene.yaml", [f"{key}={value}" for key, value in settings.items()])
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return execute(Run(config, folder, pipeline, choice, Talk()))


def program() -> None:
    """What a process that runs the pipeline does: `sys.argv` is a folder and settings, NAME=VALUE."""
    try:
        sys.exit(main(Path(sys.argv[1]), dict(word.split("=", 1) for word in sys.argv[2:])))
    except KeyboardInterrupt:
        sys.exit(STOPPED)


def _leave_room(more: int) -> None:
    """Let this process take only so many more bytes of memory."""
    kilobytes = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmData")
    )
    most = int(kilobytes.split()[1]) * 1024 + more
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def _always(config: object) -> None:
    return None


def _noise(seed: str, size: int) -> bytes:
    """The same bytes for the same seed, of any length."""
    return hashlib.shake_128(seed.encode()).digest(size)


def _content(folder: Path) -> str:
    """Digest of what a stage left, without what names this making of it."""
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        if file.name not in ("stamp.json", "health.json"):
            digest.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def _whole(file: Path, content: bytes) -> None:
    new = file.with_name(f".{file.name}.tmp")
    new.write_bytes(content)
    sync(new)
    os.replace(new, file)


def _pause(context: StageContext, share: float) -> None:
    context.progress(share, "at work")
    time.sleep(STEP_S)
