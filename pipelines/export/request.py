"""What a writer of exports is given, and what it says of itself in the table of formats."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.formats.parts.export import new_folder
from devrf.capture.system.errors import CaptureError
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told

OF_SOME = ("times", "level", "splats", "device")  # options that only some formats take


@dataclass(frozen=True)
class ExportOptions:
    """What `export` is asked for; those of `OF_SOME` are None where they were not given.

    Attributes:
        format: One of `FORMATS`.
        out: Folder to write; None: `export/<format>` in the run folder.
        times: Which times, as in `times.chosen`.
        level: Opacity of the surface of the mesh.
        splats: How many Gaussians.
        device: auto, cpu or cuda.
    """

    format: str
    out: Path | None = None
    times: str | None = None
    level: float | None = None
    splats: int | None = None
    device: str | None = None

    def given(self) -> list[str]:
        """Names of those that only some formats take and that were given."""
        return [name for name in OF_SOME if getattr(self, name) is not None]


@dataclass
class Request:
    """One export.

    Attributes:
        talk: Where to speak.
        run_dir: The run folder.
        folder: Where the export is to be.
        options: What was asked for.
        title: Name of the scene.
        notes: What people should know of this export; printed, and to be written beside the files.
    """

    talk: Talk
    run_dir: Path
    folder: Path
    options: ExportOptions
    title: str
    notes: list[str]

    @property
    def name(self) -> str:
        """Of the format."""
        return self.options.format

    @contextmanager
    def new_folder(self) -> Iterator[Path]:
        """An empty folder to write into, which gets its name when it is whole.

        Raises:
            CaptureError: The disk is full or may not be written; nothing is left.
        """
        with self.disk_told(), new_folder(self.folder, self.name) as new:
            yield new

    def disk_told(self) -> AbstractContextManager[None]:
        """A disk that is full or may not be written, in words."""
        remedy = "nothing is left there; free space or name another folder with --out"
        return disk_told(self.folder, remedy, CaptureError)


@dataclass(frozen=True)
class Format:
    """One thing that can be exported.

    Attributes:
        write: Writes it.
        what: For people: what it is, in a few words.
        stage: What has to be finished.
        options: Which of `ExportOptions` it takes.
        modules: Libraries of the extra `export` that it imports.
    """

    write: Callable[[Request], None]
    what: str
    stage: str
    options: tuple[str, ...] = ()
    modules: tuple[str, ...] = ()
