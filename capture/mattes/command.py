"""Mattes by a program of the user's: one command that turns a picture into a matte.

The command is a list of arguments in which `{image}` and `{matte}` stand for two files. It runs without a shell, in
the folder of scene.yaml, several at a time. Exit code 0 and a readable matte of the picture's shape mean success. A
finished matte is kept under a name made of the command and the picture, so that an interrupted run goes on.
"""

import hashlib
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.cores import usable_cores
from devrf.capture.durable import sync
from devrf.capture.errors import CaptureError
from devrf.capture.mattes.given import read_given
from devrf.capture.picture_files import read_pixels
from devrf.capture.progress import Progress, no_progress

IMAGE, MATTE = "{image}", "{matte}"
LAST_LINES = 5  # of what a failed program said
GRACE_S = 2.0  # between asking a program to end and ending it


@dataclass(frozen=True)
class MatteCommand:
    """The program.

    Attributes:
        arguments: With `{image}` and `{matte}` in them.
        folder: To run it in.
        timeout_s: Longest time for one picture.
    """

    arguments: tuple[str, ...]
    folder: Path
    timeout_s: float

    def problem(self) -> str | None:
        """What keeps it from being run, or None."""
        for word in (IMAGE, MATTE):
            if not any(word in argument for argument in self.arguments):
                return (
                    f"{list(self.arguments)}: {word} is missing; it stands for the file to read or to write"
                )
        program = self.arguments[0]
        here = self.folder / program
        if shutil.which(program) is None and not (os.sep in program and os.access(here, os.X_OK)):
            return f"{program!r}: no such program; install it, or give its path relative to scene.yaml"
        return None

    def files(self) -> list[Path]:
        """Files among its arguments (a script, weights): the mattes depend on them. An installed program is none."""
        paths = (self.folder / a for n, a in enumerate(self.arguments) if n or not os.path.isabs(a))
        return [path for path in paths if os.path.isfile(path)]  # not Path's: a long argument is no error


def run_on_pictures(
    command: MatteCommand, pictures: Sequence[Path], kept: Path, progress: Progress = no_progress
) -> list[Path]:
    """Make the matte of every picture, or take the one that was made.

    Args:
        command: The program.
        pictures: Files.
        kept: Folder for the mattes; made where it is missing.
        progress: Told after every picture.
    Returns:
        A file per picture, in `kept`.
    Raises:
        CaptureError: The program failed, ran too long, or left no matte of the picture's shape; the mattes made so
            far are kept.
    """
    kept.mkdir(parents=True, exist_ok=True)
    made_by = hashlib.blake2b(repr(command.arguments).encode(), digest_size=16)
    for file in command.files():
        made_by.update(file.read_bytes())
    names = [kept / f"{_digest(made_by, picture)}.png" for picture in pictures]
    todo = {name: picture for name, picture in zip(names, pictures, strict=True) if not name.is_file()}
    running: set[subprocess.Popen] = set()
    pool = ThreadPoolExecutor(usable_cores())
    try:
        jobs = [pool.submit(_run, command, picture, name, running) for name, picture in todo.items()]
        for done, job in enumerate(as_completed(jobs), len(pictures) - len(todo) + 1):
            job.result()
            progress(done / len(pictures), f"{command.arguments[0]}: matte {done} of {len(pictures)}")
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list(running):
            _end(process)
        pool.shutdown()
    return names


def _run(command: MatteCommand, picture: Path, name: Path, running: set[subprocess.Popen]) -> None:
    """One picture; the matte gets its name when it is whole."""
    new = name.with_name(f".new-{name.name}")
    new.unlink(missing_ok=True)
    image, matte = (str(path.absolute()) for path in (picture, new))  # so that no name looks like an option
    arguments = [a.replace(IMAGE, image).replace(MATTE, matte) for a in command.arguments]
    try:
        process = subprocess.Popen(
            arguments, cwd=command.folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True,
        )  # fmt: skip
    except OSError as error:
        text = f"{_named(command)}: cannot be started ({error}); check capture.mattes"
        raise CaptureError("command-unstartable", text) from None
    running.add(process)
    late = False
    try:
        said, _ = process.communicate(timeout=command.timeout_s)
    except subprocess.TimeoutExpired as expired:
        late, said = True, (expired.output or b"").decode(errors="replace")  # bytes, whatever was asked for
        _end(process)
    finally:
        running.discard(process)
    with (name.parent / "command.log").open("a", encoding="utf-8") as log:
        log.write(
            f"{picture}: {'ended after its time' if late else f'exit code {process.returncode}'}\n{said}"
        )
    last = "\n".join(said.strip().splitlines()[-LAST_LINES:]) or "it said nothing"
    last = f"what it said last:\n{last}"
    if late:
        wrong = f"{_named(command)}: not done with {picture} after {command.timeout_s:g} s"
        remedy = "allow more (capture.mattes.timeout_s), or give it a smaller model"
        raise CaptureError("command-timed-out", f"{wrong}; {last}\n{remedy}")
    if process.returncode != 0:
        wrong = f"{_named(command)}: exit code {process.returncode} for {picture}"
        remedy = "run it by hand on this picture, then again; finished mattes are kept"
        raise CaptureError("command-failed", f"{wrong}; {last}\n{remedy}")
    if not new.is_file():
        wrong = f"{_named(command)}: ended well but left no file at {MATTE} for {picture}"
        raise CaptureError("command-without-output", f"{wrong}; {last}")
    height, width = read_pixels(picture).shape[:2]
    try:
        read_given(new, width, height, inverted=False)
    except CaptureError as error:
        raise CaptureError(error.code, f"{_named(command)}: no matte of {picture}: {error}") from None
    sync(new)  # or a power cut could leave an empty file under a name that counts
    new.replace(name)


def _end(process: subprocess.Popen) -> None:
    """End a program and what it started, also what would outlive it."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _digest(made_by: "hashlib.blake2b", picture: Path) -> str:
    digest = made_by.copy()
    digest.update(picture.read_bytes())
    return digest.hexdigest()


def _named(command: MatteCommand) -> str:
    return f"capture.mattes: command {command.arguments[0]!r}"
