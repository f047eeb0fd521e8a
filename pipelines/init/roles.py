"""Which file is what: the sweep, a fixed camera, a board clip; by what is in it first, by its name second.

What the two disagree about is said. Nothing is decided by a file of truth or by the order of files alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from devrf.calibration.boards.guess import BoardGuess, Grey, board_pictures, guess_board
from devrf.calibration.field.steady import steadiness
from devrf.capture.survey import Look
from devrf.pipelines.init.boards import BOARD_SHARE, give_boards, is_board_clip
from devrf.pipelines.init.found import Roles, Seen
from devrf.pipelines.init.names import camera_name, photos
from devrf.pipelines.stages.ingest import FEWEST_SWEEP_PICTURES

FEWEST_PHOTOS = 8  # of a sweep that nobody calls one
MOST_TRIALS = 24  # pictures in which a board of unknown kind is looked for; each takes a second
BOARD_TRIALS, STILL_TRIALS = 4, 2  # of them of each clip called a board clip, and of each camera that stands


def see(looks: Sequence[Look], root: Path) -> tuple[list[Seen], BoardGuess | None]:
    """Look for movement and for a board in all clips and folders."""
    seen = [Seen(look, look.path.relative_to(root).as_posix(), steadiness(look.greys), 0.0) for look in looks]
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
        elif is_board_clip(s, seen, roles):
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
    give_boards(boards, roles)
    return roles


def _sweep(moving: list[Seen], standing: list[Seen], roles: Roles) -> None:
    few = [s for s in moving if not s.look.is_clip and s.look.count < FEWEST_PHOTOS and s.called != "sweep"]
    for s in few:
        roles.unused[s.name] = f"{photos(s.look.count)}: too few for a sweep"
    wanted = sorted(
        (s for s in moving if s not in few),
        key=lambda s: (s.called != "sweep", s.called in ("camera", "test"), -s.look.count),
    )
    if wanted:
        _take_sweep(wanted[0], roles)
    for s in wanted[1:]:
        if s.called in ("camera", "test"):
            roles.faulty[s.name] = (
                "called a fixed camera, but its picture moves: put it on a tripod and film again"
            )
        else:
            better = f"{wanted[0].name} is used. Swap them in scene.yaml if this is better"
            roles.unused[s.name] = f"a second sweep; {better}"
    for s in [s for s in standing if s.called == "sweep"]:
        roles.faulty[s.name] = "called a sweep, but the camera stands: walk around the scene with it"
        standing.remove(s)
    if roles.sweep is None:
        roles.doubts.append(
            "no sweep: no clip in which the camera moves, and no folder of photos. Film the scene at rest with one "
            "moving camera, walking around it; without one, `run --until flow` is all that can be done"
        )


def _take_sweep(s: Seen, roles: Roles) -> None:
    roles.sweep = s
    what = "the camera moves" if s.look.is_clip else photos(s.look.count)
    roles.why[s.name] = f"the sweep: {what}" + (", and so it is called" if s.called == "sweep" else "")
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


def _cameras(standing: list[Seen], roles: Roles) -> None:
    for s in standing:
        test = s.called == "test"
        name = camera_name(s.name, {*roles.cameras, *roles.tests})
        (roles.tests if test else roles.cameras)[name] = s
        found = "the camera stands" if s.steady.stands else "too little to see to tell whether it stands"
        roles.why[s.name] = f"fixed camera {name}: {found}" + ("; called a test camera" if test else "")
    if roles.tests and not roles.cameras:
        roles.cameras, roles.tests = roles.tests, {}
    if not roles.cameras:
        roles.doubts.append("no fixed cameras: no clip in which the camera stands; this is a scene at rest")


def _fault(s: Seen) -> str | None:
    if not s.look.pictures:
        return "no picture of it decodes; copy it from the camera again"
    if s.look.black:
        return "black: a lens cap, or no light; film again"
    if s.look.is_clip and s.look.count < 2:
        return "a single picture; expected a clip"
    if not s.look.is_clip and s.called == "sweep" and s.look.count < FEWEST_SWEEP_PICTURES:
        return f"called a sweep, but has {photos(s.look.count)}: photograph the scene at rest from all around"
    return None


def _some(items: list[Grey], count: int) -> list[Grey]:
    step = max(1, len(items) // count)
    return items[step // 2 :: step][:count]
