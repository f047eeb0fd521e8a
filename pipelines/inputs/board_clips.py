"""The clips that show the board to the fixed cameras: each is searched once, and calibrates its camera once."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from devrf.calibration.boards.calibrate import BoardCalibration, LensChoice, calibrate_intrinsics
from devrf.calibration.boards.find import BoardSpec, BoardView, find_board
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress


@dataclass(frozen=True)
class BoardClip:
    """What a clip shows of the board.

    Attributes:
        camera: Its name.
        size: Width and height, pixels.
        views: Of the board.
        spec: The settled board.
        lens: Lens model of the calibration.
    """

    camera: str
    size: tuple[int, int]
    views: list[BoardView]
    spec: BoardSpec
    lens: LensChoice

    @cached_property
    def calibration(self) -> BoardCalibration:
        """Of the camera, by these views.

        Raises:
            HealthError: Too few views, or views that do not fit.
        """
        return calibrate_intrinsics(self.camera, self.views, self.spec, self.size, self.lens)


class BoardClips:
    """Searches clips of a capture for its board, and remembers what it found."""

    def __init__(self, run_dir: Path, frames: FrameSet, spec: BoardSpec, lens: LensChoice = "auto") -> None:
        """`spec` as it was told, `lens` of the calibrations that are made."""
        self.run_dir, self.frames, self.spec = run_dir, frames, spec
        self.lens: LensChoice = lens
        self._found: dict[str, BoardClip] = {}

    def own(self, camera: str) -> str | None:
        """The entry of the clip that shows the board to this camera alone."""
        entry = f"board_{camera}"
        return entry if entry in self.frames.cameras else None

    def search(
        self,
        camera: str,
        entry: str,
        spec: BoardSpec | None = None,
        progress: Progress = no_progress,
        required: bool = True,
    ) -> BoardClip:
        """The board in the clip `entry` of a camera.

        Args:
            spec: The board as another clip settled it; as it was told by default.
            required: Whether to refuse a clip in which the board is never seen.
        Raises:
            InputError: The clip is not of the size that the camera films.
            HealthError: As `find_board`.
        """
        clip, films = self.frames.cameras[entry], self.frames.cameras[camera]
        size = (clip.width, clip.height)
        if size != (films.width, films.height):
            raise InputError(
                "board-clip-size",
                f"board clip {clip.source} is {size[0]}x{size[1]}, camera '{camera}' films "
                f"{films.width}x{films.height}; film the board in the same mode as the scene",
            )
        found = self._found.get(entry)
        if found is not None and (spec is None or spec == replace(found.spec, corrections=spec.corrections)):
            return found  # a board that was settled is settled alike when it is told so
        label = f"{clip.source} of camera '{camera}'"
        files = files_of(self.run_dir, clip)
        views, settled = find_board(label, files, spec or self.spec, progress, required)
        found = BoardClip(camera, size, views, settled, self.lens)
        if views:  # else the next search may have to refuse it
            self._found[entry] = found
        return found


def files_of(run_dir: Path, camera: CameraFrames) -> list[Path]:
    """The pictures of a camera that ingest kept."""
    return [run_dir / "ingest" / frame.file for frame in camera.used if frame.file is not None]
