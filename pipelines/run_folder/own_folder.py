"""Whether a folder can be a run folder: nothing in it that a run would replace is anybody else's, or lies elsewhere.

Runs write, replace and remove under names of their own. In a folder in which no run has worked yet none of these may be
taken; from the first run on they are the runs'.
"""

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from devrf.capture.system.errors import InputError
from devrf.pipelines.run_folder.lock import LOCK, is_lock
from devrf.pipelines.stamps.digests import DIGESTS
from devrf.pipelines.stamps.stamp import HEALTH, STAMP
from devrf.pipelines.terminal.logs import EVENTS_FILE, LOG_FILE, OLD_LOGS

PAGE = "index.html"  # a report about an unfinished run carries no stamp
# what runs write beside the folders of stages and hidden files
OTHERS = (LOG_FILE, EVENTS_FILE, OLD_LOGS, "export", "films")
OF_RUNS = re.compile(
    rf"{OLD_LOGS}|{re.escape(EVENTS_FILE)}|\.flow|\.(failed|forced)-\w+(\.json)?|\.\w+(\..+)?\.safetensors"
)
"""What runs replace or remove beside the folders of stages: their state, and that of stages that have not ended."""


def check_run_folder(run_dir: Path, stages: Iterable[str]) -> None:
    """Refuse a folder in which a run would write over what no run has made, or through a link.

    Args:
        run_dir: It may be missing.
        stages: Names of the stages, whose folders are replaced.
    Raises:
        InputError: Says what is in the way.
    """
    stages = tuple(stages)
    for path in _written(run_dir, stages):
        if path.is_symlink():
            text = f"output: {path} is a link to {os.readlink(path)}, and a run would write there; remove the link"
            raise InputError("folder-holds-link", text)
    known = is_run_folder(run_dir)
    for path in sorted(run_dir.iterdir()) if run_dir.is_dir() else []:
        if not (_is_of_a_stage(path, known) if path.name in stages else known or _is_free(path)):
            what = "a folder" if path.is_dir() else "a file"
            raise InputError(
                "folder-exists",
                f"output: {run_dir}: holds {what} {path.name} that no run has made, and a run would replace it; name "
                "another folder (output: in scene.yaml), or move it away",
            )


def is_run_folder(folder: Path) -> bool:
    """Whether a run has worked in a folder."""
    return any((folder / mark).is_file() for mark in (LOG_FILE, DIGESTS)) or any(folder.glob(f"*/{STAMP}"))


def _is_of_a_stage(folder: Path, known: bool) -> bool:
    if not folder.is_dir():
        return False
    names = os.listdir(folder)
    return not names or STAMP in names or HEALTH in names or (known and names == [PAGE])


def _is_free(path: Path) -> bool:
    """Whether runs leave a path alone in a folder that they come to for the first time."""
    if path.name == LOCK:
        return is_lock(path)
    return not OF_RUNS.fullmatch(path.name) or (path.is_dir() and not any(path.iterdir()))


def _written(run_dir: Path, stages: tuple[str, ...]) -> Iterator[Path]:
    """What runs write by name: finished stages whole, all below hidden folders."""
    if not run_dir.is_dir():
        return
    for path in run_dir.iterdir():
        if path.name.startswith("."):
            yield path
            for root, folders, files in os.walk(path):
                yield from (Path(root) / name for name in (*folders, *files))
        elif path.name in stages or path.name in OTHERS:
            yield path
