"""Which file is what: the sweep, a fixed camera, a board clip; by what is in it first, by its name second.

What the two disagree about is said. Nothing is decided by a file of truth or by the order of files alone.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from devrf.calibration.boards.guess import BoardGuess, Grey, board_pictures, guess_board
from devrf.calibration.field.steady import Steadiness, steadiness
from devrf.capture.session import Rest
from devrf.capture.survey import Look
from devrf.pipelines.config.scene import CAMERA_NAME, RESERVED_NAMES, RESERVED_PREFIXES

WORDS: dict[str, tuple[str, ...]] = {  # what crews call things; the first that fits counts
    "board": ("board", "charuco", "calib", "checker", "chess", "aruco", "intrinsic", "extrinsic"),
    "white": ("white", "flatfield", "vignett"),
    "chart": ("chart", "colorcheck", "colourcheck", "macbeth"),
    "matte": ("matte", "mask"),
    "sweep": ("static", "sweep", "room", "scan", "walk", "orbit", "rest"),
    "test": ("witness", "test", "holdout", "heldout", "eval"),
    "camera": ("cam", "gopro", "view", "phone", "left", "right"),
}
BY_NAME = {  # what no content tells; role -> why it is not used
    "white": "a white sheet by its name; to even out a lens, put CAMERA: FILE into capture.white",
    "chart": "a colour chart by its name; to match colours, put CAMERA: FILE into calibration.colour.chart",
    "matte": "mattes by their name; to use them, name the folder in capture.mattes",
}
FEWEST_PHOTOS = 8  # of a sweep that nobody calls one
BOARD_SHARE = 0.5  # of a clip's pictures that show a board: it was filmed for the board
AS_LONG = 1.5  # clips of several cameras that filmed one thing; people start and stop them one by one
MOST_TRIALS = 24  # pictures in which a board of unknown kind is looked for; each takes a second
BOARD_TRIALS, STILL_TRIALS = 4, 2  # of them of each clip called a board clip, and of each camera that stands


@dataclass(frozen=True)
class Seen:
    """A clip or folder and what its pictures show."""

    look: Look
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
        why: File -> what it was taken for, and why.
        doubts: Contradictions and what is missing, one sentence each.
        unused: File -> why it is not used.
        faulty: File -> what is wrong with it, so that it cannot be used as it is.
    """

    sweep: Seen | None = None
    cameras: dict[str, Seen] = field(default_factory=dict)
    tests: dict[str, Seen] = field(default_factory=dict)
    boards: dict[str, Seen] = field(default_factory=dict)
    joint: dict[str, Seen] = field(default_factory=dict)
    board: BoardGuess | None = None
    why: dict[str, str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)
    faulty: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """What init knows when it writes.

    Attributes:
        roles: What is what.
        rest: When the moving clips show the scene as in the sweep.
        timestamps: A table of true times, relative to the folder; None without one.
        given: A calibration that places the cameras where nothing else does, relative to the folder; None without one.
        has_gpu: Whether an NVIDIA GPU is there.
    """

    roles: Roles
    rest: Rest
    timestamps: str | None
    given: str | None
    has_gpu: bool


def called(name: str) -> str:
    """The role that a name tells: `room/cam0.mp4` is a camera; empty where it tells none."""
    return next(iter(roles_called(name)), "")


def roles_called(name: str) -> list[str]:
    """The roles that the parts of a name tell, the last part's first."""
    roles = []
    for part in reversed(_without_suffix(name.lower()).split("/")):
        tokens = re.findall(r"[a-z]+", part)
        roles += [r for r, words in WORDS.items() if any(t.startswith(words) for t in tokens)][:1]
    return roles


def see(looks: Sequence[Look], root: Path) -> tuple[list[Seen], BoardGuess | None]:
    """Look for movement and for a board in all clips and folders."""
    seen = [Seen(look, _relative(look.path, root), steadiness(look.greys), 0.0) for look in looks]
    board = guess_board(_trials(seen))
    if board is None:
        return seen, None
    return [
        replace(s, board_share=board_pictures(s.look.greys, board) / max(1, len(s.look.greys))) for s in seen
    ], board


def _trials(seen: Sequence[Seen]) -> list[Grey]:
    """Pictures that tell which board it is: of board clips first, then of a sweep, which passes a board but once."""
    called = [grey for s in seen if s.called_board for grey in _some(s.look.greys, BOARD_TRIALS)]
    swept = [grey for s in seen if not s.called_board and s.moves for grey in s.look.greys]
    fixed = [
        grey for s in seen if not s.called_board and not s.moves for grey in _some(s.look.greys, STILL_TRIALS)
    ]
    return [*called, *swept, *fixed][:MOST_TRIALS]


def guess_roles(seen: Sequence[Seen], board: BoardGuess | None) -> Roles:
    """Give every clip and folder a role."""
    roles = Roles(board=board)
    standing, moving, boards = [], [], []
    for s in seen:
        fault = _fault(s)
        if fault is not None:
            roles.faulty[s.name] = fault
        elif _is_board_clip(s, seen, roles):
            boards.append(s)
        elif s.called_board:
            roles.faulty[s.name] = (
                f"called a board clip, but no board is seen in {len(s.look.pictures)} pictures of it: "
                "film the board larger, sharp and without glare, or rename the clip"
            )
        elif s.moves:
            moving.append(s)
        elif not s.look.is_clip:
            roles.faulty[s.name] = (
                "photos whose background stands still: a sweep is photographed walking around the scene"
            )
        else:
            standing.append(s)
    _sweep(moving, standing, roles)
    _cameras(standing, roles)
    _boards(boards, roles)
    return roles


def _fault(s: Seen) -> str | None:
    if not s.look.pictures:
        return "no picture of it decodes; copy it from the camera again"
    if s.look.black:
        return "black: a lens cap, or no light; film again"
    if s.look.is_clip and s.look.count < 2:
        return "a single picture; expected a clip"
    return None


def _is_board_clip(s: Seen, seen: Sequence[Seen], roles: Roles) -> bool:
    if s.board_share == 0:
        return False
    if s.called_board:
        return True
    if s.board_share < BOARD_SHARE:
        return False
    if not s.look.is_clip:
        return s.steady.stands is True
    if s.called:
        return False  # a board that lies in the scene, or moving clips that are joint clips too
    others = [o for o in seen if o is not s and o.moves == s.moves and o.board_share < BOARD_SHARE]
    if others:
        roles.doubts.append(f"{s.name}: taken as a board clip, because the board is in most of its pictures")
    return bool(others)


def _sweep(moving: list[Seen], standing: list[Seen], roles: Roles) -> None:
    wanted = []
    for s in moving:
        if not s.look.is_clip and s.look.count < FEWEST_PHOTOS and s.called != "sweep":
            roles.unused[s.name] = f"{s.look.count} photos: too few for a sweep"
        else:
            wanted.append(s)
    wanted.sort(key=lambda s: (s.called != "sweep", s.called in ("camera", "test"), -s.look.count))
    for n, s in enumerate(wanted):
        if n == 0:
            roles.sweep = s
            what = f"{s.look.count} photos" if not s.look.is_clip else "the camera moves"
            roles.why[s.name] = f"the sweep: {what}" + (
                ", and so it is called" if s.called == "sweep" else ""
            )
            if not s.look.is_clip and s.board_share >= BOARD_SHARE:
                roles.doubts.append(
                    f"{s.name}: the board is in {100 * s.board_share:.0f} % of its photos. If they were taken for the "
                    "board, they are no sweep: photograph the scene at rest, walking around it"
                )
            if s.called in ("camera", "test"):
                roles.doubts.append(
                    f"{s.name}: called a fixed camera, but its picture moves; taken as the sweep. If it is no sweep, "
                    "put the camera on a tripod and film again"
                )
        elif s.called in ("camera", "test"):
            roles.faulty[s.name] = (
                "called a fixed camera, but its picture moves: put it on a tripod and film again"
            )
        else:
            roles.unused[s.name] = (
                f"a second sweep; {wanted[0].name} is used. Swap them in scene.yaml if this is better"
            )
    for s in [s for s in standing if s.called == "sweep"]:
        roles.faulty[s.name] = "called a sweep, but the camera stands: walk around the scene with it"
        standing.remove(s)
    if roles.sweep is None:
        roles.doubts.append(
            "no sweep: no clip in which the camera moves, and no folder of photos. Film the scene at rest with one "
            "moving camera, walking around it; without one, `run --until flow` is all that can be done"
        )


def _cameras(standing: list[Seen], roles: Roles) -> None:
    for s in standing:
        test = s.called == "test"
        name = _camera_name(s.name, {*roles.cameras, *roles.tests})
        (roles.tests if test else roles.cameras)[name] = s
        found = "the camera stands" if s.steady.stands else "too little to see to tell whether it stands"
        roles.why[s.name] = f"fixed camera {name}: {found}" + ("; called a test camera" if test else "")
    if roles.tests and not roles.cameras:
        roles.cameras, roles.tests = roles.tests, {}
    if not roles.cameras:
        roles.doubts.append("no fixed cameras: no clip in which the camera stands; this is a scene at rest")


def _boards(boards: list[Seen], roles: Roles) -> None:
    cameras = {**roles.cameras, **roles.tests}
    if roles.sweep is None and cameras and all(s.board_share > 0 for s in cameras.values()):
        roles.joint |= cameras
        for s in cameras.values():
            roles.why[s.name] += f"; the board is in {100 * s.board_share:.0f} % of its pictures"
    owners = {"static": roles.sweep} if roles.sweep is not None else {}
    owners |= cameras
    left = []
    for s in boards:
        owner = _owner_by_name(s, owners)
        if owner is None or owner in roles.boards:
            left.append(s)
        else:
            _give_board(s, owner, "by its name", roles)
    for s in left:
        free = [n for n, o in owners.items() if n not in roles.boards and _same_mode(s, o)]
        if len(free) == 1:
            _give_board(s, free[0], "the only camera of this size without one", roles)
        else:
            fits = f"fits {', '.join(free)}" if free else "fits none that lacks one"
            roles.unused[s.name] = (
                f"a board clip, but of which camera? It {fits}; put CAMERA: {s.name} into capture.board.clips"
            )
    if roles.sweep is None and not roles.joint and _filmed_at_once(roles.boards, cameras):
        roles.doubts.append(
            "the board clips are taken as filmed at once: without a sweep only they tell the cameras' places"
        )
        roles.joint, roles.boards = roles.boards, {}


def _filmed_at_once(boards: dict[str, Seen], cameras: dict[str, Seen]) -> bool:
    """Whether every camera has a board clip, and all are about as long."""
    lengths = [s.look.duration_s or 0.0 for s in boards.values()]
    return len(lengths) > 1 and set(boards) == set(cameras) and 0 < max(lengths) <= AS_LONG * min(lengths)


def _give_board(s: Seen, owner: str, how: str, roles: Roles) -> None:
    roles.boards[owner] = s
    whose = "the sweep's camera" if owner == "static" else f"camera {owner}"
    roles.why[s.name] = f"board before {whose}, {how}; seen in {100 * s.board_share:.0f} % of its pictures"


def _owner_by_name(s: Seen, owners: dict[str, Seen]) -> str | None:
    """The camera whose name, or whose folder, is part of the clip's name; the longest counts."""
    own = _words(s.name)
    best: tuple[int, str] | None = None
    for name, other in owners.items():
        words = _words(name)
        inside = any(own[i : i + len(words)] == words for i in range(len(own)))
        if not inside and name == "static":
            inside = any(w.startswith(WORDS["sweep"]) for w in own)
        beside = Path(other.name).parent != Path(".") and Path(other.name).parent == Path(s.name).parent
        score = len(name) if inside else 0.5 if beside and _alone_in_folder(other, owners) else 0
        if score and (best is None or score > best[0]):
            best = (int(2 * score), name)
    return None if best is None else best[1]


def _alone_in_folder(s: Seen, owners: dict[str, Seen]) -> bool:
    return sum(Path(o.name).parent == Path(s.name).parent for o in owners.values()) == 1


def _same_mode(s: Seen, other: Seen) -> bool:
    size, own = (s.look.width, s.look.height), (other.look.width, other.look.height)
    devices = {s.look.device, other.look.device} - {""}
    return size == own and len(devices) < 2


def _camera_name(name: str, taken: set[str]) -> str:
    """A name for a camera out of its file's, or its folder's where that is the telling one."""
    path = Path(name)
    stem = path.stem
    if called(stem) not in ("camera", "test") and called(path.parent.name) in ("camera", "test"):
        stem = path.parent.name
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")[:60] or "cam"
    if stem in RESERVED_NAMES or stem.startswith(RESERVED_PREFIXES):
        stem = f"cam_{stem}"
    folder = re.sub(r"[^A-Za-z0-9_-]+", "_", path.parent.name).strip("_-")
    tries = [stem, f"{folder}_{stem}"[:64], *(f"{stem}_{n}" for n in range(2, 1000))]
    return next(t for t in tries if t not in taken and CAMERA_NAME.fullmatch(t))


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+|\d+", _without_suffix(name.lower()))


def _without_suffix(name: str) -> str:
    return re.sub(r"\.\w+$", "", name)


def _relative(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _some(items: list[Grey], count: int) -> list[Grey]:
    step = max(1, len(items) // count)
    return items[step // 2 :: step][:count]
