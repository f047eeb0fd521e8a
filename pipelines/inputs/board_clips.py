"""The clips that show the board to the fixed cameras: each is searched once, and calibrates its camera once.

People hold a camera otherwise before the board than on its tripod. What was seen is turned into the camera's pictures:
it is the same sensor, and both files say how they were turned.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from devrf.calibration.boards.calibrate import BoardCalibration, LensChoice, calibrate_intrinsics
from devrf.calibration.boards.find import BoardSpec, BoardView, find_board
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.orientation import Upright
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress


@dataclass(frozen=True)
class BoardClip:
    """What a clip shows of the board, as the camera's own pictures would show it.

    Attributes:
        camera: Its name.
        size: Width and height of the camera's pictures.
        views: Of the board.
        spec: The settled board.
        lens: Lens model of the calibration.
        pixel_aspect: Width of a pixel over its height.
    """

    camera: str
    size: tuple[int, int]
    views: list[BoardView]
    spec: BoardSpec
    lens: LensChoice
    pixel_aspect: float = 1.0

    @cached_property
    def calibration(self) -> BoardCalibration:
        """Of the camera, by these views.

        Raises:
            HealthError: Too few views, or views that do not fit.
        """
        return calibrate_intrinsics(
            self.camera, self.views, self.spec, self.size, self.lens, pixel_aspect=self.pixel_aspect
        )


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
            InputError: The clip is not of the size that the camera films, as both are stored.
            HealthError: As `find_board`.
        """
        clip, films = self.frames.cameras[entry], self.frames.cameras[camera]
        turn = turn_between(clip, films)
        if turn is None:
            stored = [c.upright.size(c.width, c.height) for c in (clip, films)]
            wrong = f"board clip {clip.source} is {clip.width}x{clip.height}, camera '{camera}' films"
            remedy = "film the board in the same mode as the scene (size, aspect, lens, zoom)"
            if stored[0] == stored[1][::-1]:
                remedy = "one is turned and its file does not say how: film the board with the camera held as it films"
            raise InputError("board-clip-size", f"{wrong} {films.width}x{films.height}; {remedy}")
        size = (films.width, films.height)
        found = self._found.get(entry)
        if found is not None and (spec is None or spec == replace(found.spec, corrections=spec.corrections)):
            return found  # a board that was settled is settled alike when it is told so
        label = f"{clip.source} of camera '{camera}'"
        files = files_of(self.run_dir, clip)
        views, settled = find_board(label, files, spec or self.spec, progress, required)
        views = [replace(view, xy=turn.points(view.xy, clip.width, clip.height)) for view in views]
        found = BoardClip(camera, size, views, settled, self.lens, films.pixel_aspect)
        if views:  # else the next search may have to refuse it
            self._found[entry] = found
        return found


def turn_between(one: CameraFrames, other: CameraFrames) -> Upright | None:
    """From the pictures of one clip to those of another of its camera; None where they are stored in other ways."""
    stored = [(*c.upright.size(c.width, c.height), _stored_aspect(c)) for c in (one, other)]
    return one.upright.inverse.then(other.upright) if stored[0] == stored[1] else None


def _stored_aspect(clip: CameraFrames) -> float:
    return round(1 / clip.pixel_aspect if clip.upright.quarters % 2 else clip.pixel_aspect, 3)


def files_of(run_dir: Path, camera: CameraFrames) -> list[Path]:
    """The pictures of a camera that ingest kept."""
    return [run_dir / "ingest" / frame.file for frame in camera.used if frame.file is not None]
