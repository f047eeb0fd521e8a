"""The scenes of a batch, each looked at before anything starts: what is wrong with it, and what it still needs."""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.writable import check_folder
from devrf.pipelines.runner.run_state import Run, check_choice
from devrf.pipelines.runner.standing import Choice, Standing
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.preflight import check_inputs
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.shared_options import configured


@dataclass(frozen=True)
class BatchOptions:
    """What a batch is asked for: with what every scene is run, as by the options of `run`, and where.

    Attributes:
        preset: In place of the scenes' own.
        overrides: Texts `dotted.key=value`.
        until: Last stage.
        allow_unhealthy: Go on where a stage's own check refuses its result.
        engine: local or ray.
        address: Of a Ray cluster; None starts one on this machine.
        jobs: Scenes at once; None: as there is room.
        device: auto, cpu or cuda.
        out: Folder of the summary.
    """

    preset: str | None = None
    overrides: tuple[str, ...] = ()
    until: str | None = None
    allow_unhealthy: bool = False
    engine: str = "local"
    address: str | None = None
    jobs: int | None = None
    device: str = "auto"
    out: Path = Path("batch")

    def arguments(self) -> list[str]:
        """What `devrf-pipeline run` is told of the scene's configuration."""
        preset = [] if self.preset is None else ["--preset", self.preset]
        overrides = [word for text in self.overrides for word in ("--set", text)]
        return [*preset, *overrides, *(["--allow-unhealthy"] if self.allow_unhealthy else [])]


@dataclass
class BatchScene:
    """One scene.

    Attributes:
        path: Its scene.yaml.
        run: What it asks for; None where it cannot be used.
        problem: Why it cannot be used.
        standing: Where its stages that belong to the batch stand.
    """

    path: Path
    run: Run | None = None
    problem: str | None = None
    standing: list[Standing] = field(default_factory=list)

    @property
    def name(self) -> str:
        """As its scene.yaml says, else as the file or its folder is called."""
        if self.run is not None:
            return self.run.config.name
        return self.path.parent.name if self.path.stem == "scene" else self.path.stem

    @property
    def run_dir(self) -> Path | None:
        """The run folder."""
        return None if self.run is None else self.run.run_dir

    @property
    def stages(self) -> list[str]:
        """Stages that belong to the batch."""
        return [now.stage.name for now in self.standing]

    @property
    def to_do(self) -> list[str]:
        """Stages that are to be made, and those behind the first of them, which cost nothing to pass."""
        first = next((n for n, now in enumerate(self.standing) if now.to_make), len(self.standing))
        return self.stages[first:]


def look(paths: Sequence[Path], options: BatchOptions) -> list[BatchScene]:
    """Read and check every scene; what is wrong with one stands in its `problem`.

    Args:
        paths: scene.yaml files, or the folders that hold them.
        options: What they are to be run with.
    """
    scenes = [_read(path, options) for path in paths]
    _refuse_twice(scenes, "the same scene", "name it once", lambda scene: scene.path)
    _refuse_twice(
        scenes, "the same run folder", "give each its own output", lambda scene: scene.run_dir or scene.path
    )
    return scenes


def stand(scene: BatchScene) -> None:
    """Find out what a scene still needs, and whether its files are fit for that: sets `standing` and `problem`."""
    run = scene.run
    if run is None or scene.problem is not None:
        return
    found = run.standings()
    scene.standing = [now for now in found if run.chosen(now.stage.name) and now.state != "not applicable"]
    if to_make := [now.stage.name for now in scene.standing if now.to_make]:
        try:
            check_folder(run.run_dir, "output:")
            check_inputs(run.config, run.scene_dir, to_make)
            with contextlib.suppress(OSError):  # its run will say so
                run.run_dir.mkdir(parents=True, exist_ok=True)  # its run finds the digests there
        except InputError as error:
            scene.problem = str(error)
    run.digests.save()


def _read(path: Path, options: BatchOptions) -> BatchScene:
    scene = BatchScene((path / "scene.yaml" if path.is_dir() else path).resolve())
    try:
        config, scene_dir = configured(scene.path, options.preset, options.overrides)
        run = Run(config, scene_dir, STAGES, Choice(last=options.until), Talk("quiet"))
        check_choice(run)
        scene.run = run
    except DevrfError as error:
        scene.problem = str(error)
    return scene


def _refuse_twice(
    scenes: list[BatchScene], what: str, remedy: str, key: Callable[[BatchScene], object]
) -> None:
    """Neither of two scenes that cannot both run is run: nobody can know which was meant."""
    by_key: dict[object, list[BatchScene]] = defaultdict(list)
    for scene in scenes:
        if scene.problem is None:
            by_key[key(scene)].append(scene)
    for same in by_key.values():
        for scene in same:
            others = sorted(str(other.path) for other in same if other is not scene)
            if others:
                scene.problem = f"{scene.path}: {what} as {', '.join(others)} ({key(scene)}); {remedy}"
