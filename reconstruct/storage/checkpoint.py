"""The middle of a training on disk, so that one that was killed goes on where it was, bit for bit.

Data only (safetensors): tensors, and numbers as JSON in the file's metadata. A checkpoint carries a fingerprint of
all that was asked for, what was chosen within that, and digests: of its numbers, which are read first, and of all its
content. One of something else, and one that is not as it was written (cut off, with a hole after a power cut), is not
taken up: the training begins anew.
"""

import glob
import hashlib
import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from devrf.capture.system.durable import sync, whole
from devrf.capture.system.errors import OutOfTime, ReconstructError
from devrf.reconstruct.storage.tensor_file import save_tensors
from devrf.reconstruct.storage.training_log import TrainingLog

FIRST_S = 5.0  # of training before the first checkpoint
SHARE = 0.05  # of the time that writing may take: the largest fields take many seconds, small ones none
SLOW_DISK = 200e6  # bytes per second, taken for granted until the first checkpoint has been timed

State = tuple[dict[str, Tensor], dict[str, Any]]
"""Tensors and numbers that all that follows depends on."""

logger = logging.getLogger(__name__)


class Saved(NamedTuple):
    """What a checkpoint holds: the state after `done` steps."""

    done: int
    tensors: dict[str, Tensor]
    numbers: dict[str, Any]


class Begun(NamedTuple):
    """A training that has not ended: steps that were done of the phase written last, and what was chosen for it."""

    done: int
    chosen: Any


class Checkpoint:
    """A place for one training's state.

    Args:
        path: The file; None: nothing is kept.
        fingerprint: Of everything the training depends on that was asked for.
        every_s: Seconds between two writings; 0 writes after every step; None: as often as costs little.
        chosen: What else it depends on, such as options that fit into the memory of that moment, as JSON has it.
        until: When the training has to end, done or not, on the clock of `time.monotonic`, seconds.
    """

    def __init__(
        self,
        path: Path | None,
        fingerprint: str = "",
        every_s: float | None = None,
        chosen: Any = None,
        until: float | None = None,
    ) -> None:
        self.path, self.fingerprint, self.every_s, self.chosen = path, fingerprint, every_s, chosen
        self.until = until
        self._gap_s = FIRST_S  # where `every_s` leaves it open
        self._timed = every_s is not None
        self._written = time.monotonic()

    def part(self, name: str) -> "Checkpoint":
        """The place for one phase of the training, which begins now and is removed with the whole."""
        if self.path is None:
            return self
        path = self.path.with_name(f"{self.path.stem}.{name}{self.path.suffix}")
        return type(self)(path, self.fingerprint, self.every_s, self.chosen, self.until)

    def begun(self) -> Begun | None:
        """Of a training of this fingerprint that has not ended; None where there is none."""
        newest_first = sorted(self._files(), key=lambda path: path.stat().st_mtime_ns, reverse=True)
        found = (self._numbers(path) for path in newest_first)
        return next((Begun(saved.done, saved.numbers.get("chosen")) for saved in found if saved), None)

    def keep(self, done: int, of: int, log: TrainingLog, state: Callable[[], State]) -> None:
        """Write the state after `done` of all steps and the log, if it is time to.

        Raises:
            OutOfTime: The training has to end before its last step; the state is written.
        """
        if self.path is None:
            return
        if self.until is not None and time.monotonic() >= self.until and done < of:
            tensors, numbers = state()
            kept = self.write(Saved(done, tensors, numbers | {"log": log.state()}))
            but = "" if kept else ", which could not be kept (devrf.log says why)"
            raise OutOfTime("out-of-time", f"its time is over after step {done} of {of}{but}")
        gap_s = self._gap_s if self.every_s is None else self.every_s
        if time.monotonic() - self._written < gap_s:
            return
        tensors, numbers = state()
        likely_s = sum(tensor.nbytes for tensor in tensors.values()) / SLOW_DISK
        if not self._timed and likely_s > SHARE * gap_s:
            self._gap_s, self._timed = likely_s / SHARE, True
            return
        self.write(Saved(done, tensors, numbers | {"log": log.state()}))

    def write(self, saved: Saved) -> bool:
        """Replace the file, whole or not at all, even if the power goes; where that fails, say so and go on.

        Returns:
            Whether it was written; not where nothing is kept.
        """
        if self.path is None:
            return False
        start, written = time.monotonic(), False
        ready = {name: tensor.detach().cpu().contiguous() for name, tensor in saved.tensors.items()}
        numbers = json.dumps(
            saved.numbers | {"done": saved.done, "of": self.fingerprint, "chosen": self.chosen}
        )
        try:
            with whole(self.path, alone=True) as new:
                proof = {"head": _digest(numbers, {}), "digest": _digest(numbers, ready)}
                save_tensors(new, ready, {"devrf": numbers} | proof)
            sync(self.path.parent)
            written = True
        except (OSError, SafetensorError) as error:
            # a full disk: the one before stays, training need not end
            logger.warning("%s: the checkpoint cannot be written (%s)", self.path, error)
        self._written = time.monotonic()
        self._gap_s, self._timed = max(FIRST_S, (self._written - start) / SHARE), True
        return written

    def found(self, log: TrainingLog) -> Saved | None:
        """What was written last, the log taken up; None where nothing was, for something else, or not whole."""
        saved = None if self.path is None else self._read(self.path)
        if saved is None:
            return None
        if saved.numbers.pop("chosen", None) != self.chosen:
            logger.info("%s: begun otherwise than is possible now; training begins anew", self.path)
            return None
        log.take_up(saved.numbers.pop("log"))
        logger.info("training goes on after step %d, from %s", saved.done, self.path)
        return saved

    def remove(self) -> None:
        """The training is done, and its result is safe."""
        for path in self._files():
            path.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        """That of the whole and those of its parts, where they are there."""
        if self.path is None:
            return []
        parts = self.path.parent.glob(f"{glob.escape(self.path.stem)}.*{self.path.suffix}")
        return [path for path in (self.path, *parts) if path.exists()]

    def _numbers(self, path: Path) -> Saved | None:
        """A checkpoint of this training, read without its tensors."""
        try:
            saved = look_at(path, "cpu", lambda name: False)
        except ReconstructError:
            return None
        return saved if saved.numbers["of"] == self.fingerprint else None

    def _read(self, path: Path) -> Saved | None:
        if not path.exists():
            return None
        try:
            with safe_open(str(path), framework="pt", device="cpu") as file:
                meta = file.metadata() or {}
                head = _proven_head(meta)
                numbers = json.loads(head)
                if numbers.pop("of") != self.fingerprint:
                    logger.info("%s: of another training; this one begins anew", path)
                    return None
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            if _digest(head, tensors) != meta.get("digest"):
                raise ValueError("its content is not what was written")
        except (OSError, SafetensorError, ValueError) as error:
            logger.warning("%s: damaged (%s); training begins anew", path, error)
            return None
        return Saved(numbers.pop("done"), tensors, numbers)


def look_at(path: Path, device: str, wanted: Callable[[str], bool]) -> Saved:
    """The newest state of a training that goes on in another process, to be looked at and not taken up.

    Files are replaced whole, so what is read belongs together; the digest of all content is not asked for.

    Args:
        path: A checkpoint of any training.
        device: Where the tensors are wanted.
        wanted: Which of them, by name.
    Raises:
        ReconstructError: It is not there any more, or no checkpoint.
    """
    try:
        with safe_open(str(path), framework="pt", device=device) as file:
            numbers = json.loads(_proven_head(file.metadata() or {}))
            tensors = {n: file.get_tensor(n) for n in file.keys() if wanted(n)}  # noqa: SIM118 (not a dict)
    except (OSError, SafetensorError, ValueError) as error:
        raise ReconstructError("file-unreadable", f"{path}: not a readable checkpoint ({error})") from None
    return Saved(numbers.pop("done"), tensors, numbers)


NOWHERE = Checkpoint(None)
"""Keeps nothing."""


def _proven_head(meta: dict[str, str]) -> str:
    """The numbers' JSON, as it was written.

    Raises:
        ValueError: It is not, or the file is no checkpoint.
    """
    head = meta.get("devrf", "")
    if _digest(head, {}) != meta.get("head"):
        raise ValueError("its head is not what was written")
    return head


def _digest(numbers: str, tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256(numbers.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        if tensor.numel():  # the stride of what is empty may be 0
            digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
