"""Versions of code: what a benchmark has made by other code is made anew."""

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = (
    Path(__file__).resolve().parents[1]
)  # rooms lie beside one another in the tree and where they are installed


@cache
def code_of(*folders: str) -> str:
    """One digest of all sources below folders, such as `lab/simulate/scenes` or `reconstruct`."""
    digest = hashlib.blake2b(digest_size=16)
    for folder in folders:
        files = sorted((PACKAGE / folder).rglob("*.py"))
        assert files, folder
        for path in files:
            digest.update(f"{path.relative_to(PACKAGE).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()
