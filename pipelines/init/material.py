"""What `init` has seen and guessed; the page and scene.yaml are made of it."""

from dataclasses import dataclass, field

from devrf.calibration.boards.guess import BoardGuess
from devrf.calibration.preview.stability import Steadiness
from devrf.capture.ingest.survey import Footage
from devrf.pipelines.init.names import called, roles_called


@dataclass(frozen=True)
class FootageContent:
    """A clip or folder and what its pictures show."""

    look: Footage
    name: str
    steady: Steadiness
    board_share: float

    @property
    def called(self) -> str:
        """What its name says it is; empty where it says nothing."""
        return called(self.name)

    @property
    def called_board(self) -> bool:
        """Whether its name says that it shows a board; of photos any part of it, `intrinsics/cam0` holds no clip."""
        return self.called == "board" or (not self.look.is_clip and "board" in roles_called(self.name))

    @property
    def moves(self) -> bool:
        """Whether it was filmed or photographed on the way; photos are unless their background says no."""
        return self.steady.stands is False or (not self.look.is_clip and self.steady.stands is None)


@dataclass
class Roles:
    """What was guessed.

    Attributes:
        sweep: Clip or folder; None without one.
        cameras, tests: Camera name -> clip.
        boards, joint: Camera name (or static) -> clip with the board before it alone, or before several at once.
        board: The board; None where none is seen.
        given: A calibration that places the cameras where nothing else does, relative to the folder.
        metric: Whether that gives metres.
        timestamps: A table of true times, relative to the folder.
        why: File -> what it was taken for, and why.
        left: File -> why it is not used, and what to do where it cannot be as it is.
        doubts: Contradictions and what is missing, one sentence each.
    """

    sweep: FootageContent | None = None
    cameras: dict[str, FootageContent] = field(default_factory=dict)
    tests: dict[str, FootageContent] = field(default_factory=dict)
    boards: dict[str, FootageContent] = field(default_factory=dict)
    joint: dict[str, FootageContent] = field(default_factory=dict)
    board: BoardGuess | None = None
    given: str | None = None
    metric: bool = False
    timestamps: str | None = None
    why: dict[str, str] = field(default_factory=dict)
    left: dict[str, str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)

    @property
    def fixed(self) -> dict[str, FootageContent]:
        """Every fixed camera, the test cameras last."""
        return {**self.cameras, **self.tests}
