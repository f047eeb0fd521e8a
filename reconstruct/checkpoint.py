"""The middle of a training on disk, so that one that was killed goes on where it was, bit for bit.

Data only (safetensors): tensors, and numbers as JSON in the file's metadata. A checkpoint carries a fingerprint of
everything the training depends on; one with another fingerprint is not taken up.
"""

import json
import os
import time
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

FIRST_S = 5.0  # of training before the first checkpoint
SHARE = 0.05  # of the time that writing may take: the largest fields take many seconds, small ones none


class Checkpoint:
    """A place for one training's state.

    Args:
        path: The file.
        fingerprint: Of everything the training depends on.
        every_s: Seconds between two writings; 0 writes whenever asked; None: as often as costs little.
    """

    def __init__(self, path: Path, fingerprint: str, every_s: float | None = None) -> None:
        self.path, self.fingerprint, self.every_s = path, fingerprint, every_s
        self._gap_s = FIRST_S  # where `every_s` leaves it open
        self._written = time.monotonic()

    def due(self) -> bool:
        """Whether it is time to write."""
        gap_s = self._gap_s if self.every_s is None else self.every_s
        return time.monotonic() - self._written >= gap_s

    def write(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
        """Replace the file, whole or not at all."""
        start = time.monotonic()
        new = self.path.with_name(f".{self.path.name.lstrip('.')}.tmp")
        ready = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        save_file(ready, str(new), metadata={"devrf": json.dumps(numbers | {"of": self.fingerprint})})
        os.replace(new, self.path)
        self._written = time.monotonic()
        self._gap_s = max(FIRST_S, (self._written - start) / SHARE)

    def read(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """What was written last; None where nothing was, for something else, or what cannot be read."""
        try:
            with safe_open(str(self.path), framework="pt", device="cpu") as file:
                numbers = json.loads((file.metadata() or {}).get("devrf", "{}"))
                if numbers.pop("of", None) != self.fingerprint:
                    return None
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        except (OSError, SafetensorError, json.JSONDecodeError):
            return None
        return tensors, numbers

    def remove(self) -> None:
        """The training is done."""
        self.path.unlink(missing_ok=True)
