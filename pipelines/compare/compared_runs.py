"""The runs that are compared: found by what the user named, read, and whether they show the same pictures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from devrf.capture.system.errors import InputError
from devrf.capture.system.spread import spread
from devrf.pipelines.report.data_uris import read_picture
from devrf.pipelines.report.run_reader import METRICS, RunFolder, at
from devrf.pipelines.report.views_section import collect_views
from devrf.pipelines.run_folder.outcomes import last_error
from devrf.pipelines.stages import stage_names
from devrf.pipelines.stamps.stamp import read_stamp
from devrf.pipelines.terminal.shared_options import configured

LOOKED_AT = 3  # views whose true pictures are held against each other
OTHER_PICTURE = 12.0  # mean difference in grey levels from which two true pictures show something else
SAME_PICTURE = 0.5  # below: another decoder's rounding

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
    def views(self) -> dict[bool, dict[ViewKey, dict[str, Any]]]:
        """Test views as they stand in `per_view`; True: of the moving scene in their order, False: of it at rest."""
        moving, still = collect_views(self.metrics)
        return {
            is_moving: {_key(v.row): v.row for v in of} for is_moving, of in ((True, moving), (False, still))
        }

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

    def true_picture(self, key: ViewKey) -> np.ndarray | None:
        """What was filmed in a view, uint8 RGB [H, W, 3]; None where it is not there."""
        file = (self.views[True].get(key) or self.views[False].get(key) or {}).get("true")
        return read_picture(self.folder.path / "evaluate" / file) if isinstance(file, str) else None


def find_runs(named: Sequence[Path]) -> list[ComparedRun]:
    """The runs that the command line names.

    Args:
        named: Run folders, scene.yaml files or folders that hold one.
    Raises:
        InputError: There are fewer than two, one is named twice, is no run, is not finished or cannot be read.
    """
    if len(named) < 2:
        text = f"compare: {len(named)} run named, expected two or more run folders or scene.yaml"
        raise InputError("compare-one-run", text)
    folders = [_run_folder(path) for path in named]
    for n, folder in enumerate(folders):
        if folder in folders[:n]:
            wrong = f"{named[n]}: is the same run as {named[folders.index(folder)]} ({folder}); name each run once"
            raise InputError("compare-same-run", wrong)
    return [_read(name, folder) for name, folder in zip(_names(folders), folders, strict=True)]


def limits_of(base: ComparedRun, other: ComparedRun) -> tuple[str | None, list[str]]:
    """Why the measures of two runs cannot be held against each other (None: they can), and what limits it.

    Raises:
        InputError: They have no test view in common, or their test views show other scenes.
    """
    both = f"{base.name} and {other.name}"
    common = [
        key for moving in (True, False) for key in common_views(base.views[moving], other.views[moving])
    ]
    if not common:
        raise InputError(
            "compare-no-common-view",
            f"{both} have no test view in common ({_cameras(base)}; {_cameras(other)}): another scene, or other test "
            "cameras; compare runs of one scene with the same capture.test_cameras",
        )
    notes = []
    for moving, what in ((True, "test views"), (False, "held-out pictures")):
        a, b = base.views[moving], other.views[moving]
        if len(shared := common_views(a, b)) < max(len(a), len(b)):
            notes.append(
                f"{both}: {len(shared)} of {len(a)} and {len(b)} {what} are the same; only those are compared"
            )
    for key in spread(common, LOOKED_AT):
        a, b = base.true_picture(key), other.true_picture(key)
        if a is None or b is None:
            continue
        size = min(a.shape[1], b.shape[1]), min(a.shape[0], b.shape[0])
        small = [cv2.resize(p, size, interpolation=cv2.INTER_AREA).astype(np.float32) for p in (a, b)]
        apart = float(np.abs(small[0] - small[1]).mean())
        if apart > OTHER_PICTURE:
            raise InputError(
                "compare-other-scene",
                f"{both} show something else in {key[0]}, frame {key[1]}: the true pictures differ by {apart:.0f} grey "
                f"levels (expected at most {OTHER_PICTURE:g}); compare runs of one scene",
            )
        if a.shape != b.shape:
            return (
                f"{both} were measured on pictures {a.shape[1]} and {b.shape[1]} pixels wide "
                "(reconstruct.image_scale): smaller pictures are easier, so their measures cannot be compared"
            ), notes
        if apart > SAME_PICTURE:
            notes.append(
                f"{both}: the true pictures differ by {apart:.1f} grey levels (other colours or mattes), which is part "
                "of every difference"
            )
            break
    return None, notes


def common_views(a: Iterable[ViewKey], *others: Iterable[ViewKey]) -> list[ViewKey]:
    """Views that all share, in the order of the first."""
    return [key for key in a if all(key in other for other in others)]


def _run_folder(path: Path) -> Path:
    if path.is_dir() and any((path / stage).is_dir() for stage in stage_names()):
        return path.resolve()
    if path.is_file() or (path / "scene.yaml").is_file():
        config, scene_dir = configured(path, None, None, check_files=False)
        return config.run_dir(scene_dir).resolve()
    what = "holds neither stages of a run nor a scene.yaml" if path.is_dir() else "not found"
    text = f"{path}: {what}; expected a run folder (output: in scene.yaml) or a scene.yaml"
    raise InputError("run-missing", text)


def _read(name: str, path: Path) -> ComparedRun:
    errors = {stage: error for stage in stage_names() if (error := last_error(path, stage)) is not None}
    run = ComparedRun(name, RunFolder(path, stage_names(), {}, errors))
    if METRICS in run.folder.unreadable or (path / METRICS).is_file() and not run.metrics:
        why = run.folder.unreadable.get(METRICS, "it holds no object")
        text = f"{path / METRICS}: cannot be read ({why}); make it again: devrf-pipeline run SCENE --force evaluate"
        raise InputError("file-damaged", text)
    if not run.metrics:
        done = [stage for stage in stage_names() if stage in run.stamps]
        state = f"its last finished stage is {done[-1]}" if done else "no stage is finished"
        failed = "".join(f"; {stage} failed: {error}" for stage, error in errors.items())
        raise InputError(
            "run-unfinished",
            f"{path}: is not finished: there is no {METRICS}, {state}{failed}; finish it with "
            "devrf-pipeline run first, or name the run folder itself where a run was given another output",
        )
    if not any(run.views.values()):
        raise InputError(
            "metrics-without-views",
            f"{path / METRICS}: lists no test views (per_view), so there is nothing to compare; a test camera "
            "(capture.test_cameras) or a sweep (evaluate.holdout_every) gives some",
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


def _cameras(run: ComparedRun) -> str:
    return f"{run.name}: {', '.join(sorted({camera for views in run.views.values() for camera, _ in views}))}"
