"""Whether a folder can be a run folder: nothing in it that a run would replace is anybody else's, or lies elsewhere."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from devrf.capture.errors import InputError
from devrf.pipelines.logs import EVENTS_FILE, LOG_FILE, OLD_LOGS
from devrf.pipelines.stamps.stamp import HEALTH, STAMP

PAGE = "index.html"  # a report about an unfinished run carries no stamp
OTHERS = (
    LOG_FILE,
    EVENTS_FILE,
    OLD_LOGS,
    "export",
    "films",
)  # what runs write beside the folders of stages and hidden files


def check_run_folder(run_dir: Path, stages: Iterable[str]) -> None:
    """Refuse a folder in which a run would write over what no run has made, or through a link.

    Args:
        run_dir: It may be missing.
        stages: Names of the stages, whose folders are replaced.
    Raises:
        InputError: Says what is in the way.
    """
    stages = tuple(stages)
    for name in stages:
        folder = run_dir / name
        if folder.is_dir() and not folder.is_symlink() and not _is_of_a_run(folder):
            raise InputError(
                "folder-exists",
                f"output: {run_dir}: holds a folder {name} that no run has made, and a run would replace it; name "
                "another folder (output: in scene.yaml), or move it away",
            )
    for path in _written(run_dir, stages):
        if path.is_symlink():
            raise InputError(
                "folder-holds-link",
                f"output: {path} is a link to {os.readlink(path)}, and a run would write there; remove the link",
            )


def _is_of_a_run(folder: Path) -> bool:
    names = os.listdir(folder)
    return not names or STAMP in names or HEALTH in names or names == [PAGE]


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
