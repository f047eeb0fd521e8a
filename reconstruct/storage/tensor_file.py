"""A file of tensors (safetensors) with the rights that other files get: the library gives them to its user alone."""

import os
import re
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write contiguous tensors of main memory, and texts beside them.

    Raises:
        OSError: The system does not take them.
    """
    path.touch()
    mode = path.stat().st_mode & 0o777  # as the user's umask, or the folder, has it
    try:
        save_file(dict(tensors), str(path), metadata=dict(metadata))
    except SafetensorError as error:  # it tells of the system's in words: `I/O error: ... (os error 27)`
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from None
    path.chmod(mode)
