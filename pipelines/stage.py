"""What a stage is, and what it is given. Files in, files out; no hidden state; no stage calls another."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from devrf.capture.measure import Measure
from devrf.capture.system.progress import Progress
from devrf.pipelines.health.judge import HealthRow, judge

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig


@dataclass(frozen=True)
class Allowance:
    """What one stage may use; None everywhere: as much as there is.

    Attributes:
        memory: Main memory of the stage with the process around it, bytes.
        gpu: Memory of the GPU that a training may take, bytes.
        until: When it should be done, on the clock of `time.monotonic`, seconds.
    """

    memory: int | None = None
    gpu: int | None = None
    until: float | None = None

    @property
    def left_s(self) -> float | None:
        """Seconds it has left; None: as long as it takes."""
        return None if self.until is None else max(0.0, self.until - time.monotonic())


@dataclass
class StageContext:
    """What one run of one stage sees.

    Attributes:
        config: The whole, checked configuration.
        scene_dir: Folder of scene.yaml; paths of the configuration are relative to it.
        run_dir: Where finished stages' folders lie (`run_dir / "ingest"`, ...).
        out: Empty folder to write into; the runner gives it its name when the stage has succeeded.
        progress: To be called with (fraction done, short text).
        device: "cpu" or "cuda".
        measures: What the stage adds about its own result; judged at its end.
        say: Tells the user one line that stays, such as what was decided and why.
        made_from: All that the result depends on, as its stamp will say.
        referred: Files that its result refers to instead of holding them, where the stage says so (`refers`).
        afterwards: What is left to do once the folder has its name, such as to remove what a killed run goes on from.
        allowance: Memory and time that it may use.
    """

    config: "SceneConfig"
    scene_dir: Path
    run_dir: Path
    out: Path
    progress: Progress
    device: str
    measures: list[Measure] = field(default_factory=list)
    say: Callable[[str], None] = lambda text: None
    made_from: dict[str, Any] = field(default_factory=dict)
    referred: list[Path] = field(default_factory=list)
    afterwards: list[Callable[[], None]] = field(default_factory=list)
    allowance: Allowance = field(default_factory=Allowance)

    @property
    def health(self) -> list[HealthRow]:
        """What the stage measured of its own result, judged."""
        return judge(self.measures)


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: The word in the run folder, in `--from` and in messages.
        reads: Names of the stages whose folders it reads.
        config_keys: Dotted keys of scene.yaml that its result depends on.
        applies: None where the stage applies to a configuration, else the reason why it does not.
        run: Does the work.
        inputs: What to call them -> raw files of the user's that it reads and no key of `config_keys` names. Their
            content is part of the stamp.
        refers: Its result refers to files of what it was made from instead of holding them: the content of those that
            it names (`StageContext.referred`) counts as its own.
        places: What to call them -> files of the user's among those, which may lie elsewhere one day.
        rooms: Rooms, or parts of them ("pipelines/report"), that it may import, beside what all share in `pipelines`.
            Any change of their code makes it stale.
        plug_ins: Modules of other people's that it loads by their names.
        quotes_stamps: Its result tells when and how long the stages it reads were made: made again, they are others,
            even with the same content.
    """

    name: str
    reads: tuple[str, ...]
    config_keys: tuple[str, ...]
    applies: "Callable[[SceneConfig], str | None]"
    run: Callable[[StageContext], None]
    inputs: "Callable[[SceneConfig, Path], dict[str, Path]]" = lambda config, scene_dir: {}
    refers: bool = False
    places: "Callable[[SceneConfig, Path], dict[str, Path]]" = lambda config, scene_dir: {}
    rooms: tuple[str, ...] = ()
    plug_ins: "Callable[[SceneConfig], tuple[str, ...]]" = lambda config: ()
    quotes_stamps: bool = False
