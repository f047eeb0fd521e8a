"""The runs that are compared: found by what the user named, read, and named so that they can be told apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from devrf.capture.errors import InputError
from devrf.pipelines.cli_options import configured
from devrf.pipelines.report.run import RunFolder, at
from devrf.pipelines.report.views import collect_views
from devrf.pipelines.runner.plan import last_error
from devrf.pipelines.stages import stage_names
from devrf.pipelines.stamps.stamp import read_stamp

METRICS = "evaluate/metrics.json"
SEED = "reconstruct.seed"

ViewKey = tuple[str, int]  # camera and frame


@dataclass(frozen=True)
class ComparedRun:
    """One finished run.

    Attributes:
        name: Short, and no other run's.
        folder: Its files.
    """

    name: str
    folder: RunFolder

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of evaluate/metrics.json."""
        return self.folder.object(METRICS)

    @cached_property
    def moving(self) -> dict[ViewKey, dict[str, Any]]:
        """Test views of the moving scene in their order, as they stand in `per_view`."""
        return {_key(view.row): view.row for view in collect_views(self.metrics)[0]}

    @cached_property
    def still(self) -> dict[ViewKey, dict[str, Any]]:
        """Held-out pictures of the scene at rest."""
        return {_key(view.row): view.row for view in collect_views(self.metrics)[1]}

    @cached_property
    def stamps(self) -> dict[str, dict[str, Any]]:
        """What made each stage, by its name."""
        found = {stage: read_stamp(self.folder.path / stage) for stage in self.folder.stages}
        return {stage: stamp for stage, stamp in found.items() if stamp is not None}

    @cached_property
    def config(self) -> dict[str, Any]:
        """Every key of the configuration that a stage depended on; files by their content."""
        merged: dict[str, Any] = {}
        for stamp in self.stamps.values():
            merged |= at(stamp, "identity.config") or {}
        return merged


def find_runs(named: Sequence[Path]) -> list[ComparedRun]:
    """The runs that the command line names.

    Args:
        named: Run folders, scene.yaml files or folders that hold one.
    Raises:
        InputError: There are fewer than two, one is named twice, is no run, is not finished or cannot be read.
    """
    if len(named) < 2:
        raise InputError(f"compare: {len(named)} run named, expected two or more run folders or scene.yaml")
    folders = [_run_folder(path) for path in named]
    for n, folder in enumerate(folders):
        if folder in folders[:n]:
            raise InputError(
                f"{named[n]}: is the same run as {named[folders.index(folder)]} ({folder}); name each run once"
            )
    return [_read(name, folder) for name, folder in zip(_names(folders), folders, strict=True)]


def _run_folder(path: Path) -> Path:
    if path.is_dir() and any((path / stage).is_dir() for stage in stage_names()):
        return path.resolve()
    if path.is_file() or (path / "scene.yaml").is_file():
        config, scene_dir = configured(path, None, None, check_files=False)
        return config.run_dir(scene_dir).resolve()
    what = "holds neither stages of a run nor a scene.yaml" if path.is_dir() else "not found"
    raise InputError(f"{path}: {what}; expected a run folder (output: in scene.yaml) or a scene.yaml")


def _read(name: str, path: Path) -> ComparedRun:
    errors = {stage: error for stage in stage_names() if (error := last_error(path, stage)) is not None}
    run = ComparedRun(name, RunFolder(path, stage_names(), {}, errors))
    if METRICS in run.folder.unreadable or (path / METRICS).is_file() and not run.metrics:
        why = run.folder.unreadable.get(METRICS, "it holds no object")
        raise InputError(
            f"{path / METRICS}: cannot be read ({why}); make it again: devrf-pipeline run SCENE --force evaluate"
        )
    if not run.metrics:
        done = [stage for stage in stage_names() if stage in run.stamps]
        state = f"its last finished stage is {done[-1]}" if done else "no stage is finished"
        failed = "".join(f"; {stage} failed: {error}" for stage, error in errors.items())
        raise InputError(
            f"{path}: is not finished: there is no {METRICS}, {state}{failed}; finish it with "
            "devrf-pipeline run first, or name the run folder itself where a run was given another output"
        )
    if not run.moving and not run.still:
        raise InputError(
            f"{path / METRICS}: lists no test views (per_view), so there is nothing to compare; a test camera "
            "(capture.test_cameras) or a sweep (evaluate.holdout_every) gives some"
        )
    return run


def _names(folders: Sequence[Path]) -> list[str]:
    """Of each path the last parts that tell them apart, without those that all of them end in."""
    parts = [folder.parts for folder in folders]
    while len({p[-1:] for p in parts}) == 1:
        parts = [p[:-1] for p in parts]
    count = next(n for n in range(1, 1 + max(map(len, parts))) if len({p[-n:] for p in parts}) == len(parts))
    return ["/".join(p[-count:]) for p in parts]


def _key(row: dict[str, Any]) -> ViewKey:
    index = row.get("index")
    return str(row.get("camera")), index if isinstance(index, int) else -1
