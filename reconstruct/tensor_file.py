"""A file of tensors (safetensors) with the rights that other files get: the library gives them to its user alone."""

from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import save_file
from torch import Tensor


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write contiguous tensors of main memory, and texts beside them."""
    path.touch()
    mode = path.stat().st_mode & 0o777  # as the user's umask, or the folder, has it
    save_file(dict(tensors), str(path), metadata=dict(metadata))
    path.chmod(mode)
