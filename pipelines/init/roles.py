"""Which file is what: the sweep, a fixed camera, a board clip; by what is in it first, by its name second.

What the two disagree about is said. Nothing is decided by a file of truth or by the order of files alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from devrf.calibration.boards.guess import BoardGuess, Grey, board_pictures, guess_board
from devrf.calibration.boards.instead import PICTURES, seen_instead
from devrf.calibration.preview.stability import steadiness
from devrf.capture.ingest.survey import Footage
from devrf.capture.measure import Measure
from devrf.capture.projection import projection_faults
from devrf.capture.system.amounts import counted
from devrf.pipelines.health.judge import judge
from devrf.pipelines.init.board_roles import BOARD_SHARE, give_boards, is_board_clip
from devrf.pipelines.init.material import FootageContent, Roles
from devrf.pipelines.init.names import camera_name

NO_BOARD = "no board is seen: film it larger and sharp, or rename the clip"
FEWEST_PHOTOS = 8  # of a sweep that nobody calls one
PLACES_A_SECOND = 2.0  # of a clip of a walk; a photo is one
MOST_TRIALS = 24  # pictures in which a board of unknown kind is looked for; each takes a second
BOARD_TRIALS, STILL_TRIALS = 4, 2  # of them of each clip called a board clip, and of each camera that stands


def see(looks: Sequence[Footage], root: Path) -> tuple[list[FootageContent], BoardGuess | None]:
    """Look for movement and for a board in all clips and folders."""
    seen = [
        FootageContent(look, look.path.relative_to(root).as_posix(), steadiness(look.greys), 0.0)
        for look in looks
    ]
    board = guess_board(_trials(seen))
    if board is None:
        return seen, None
    shares = [board_pictures(s.look.greys, board) / max(1, len(s.look.greys)) for s in seen]
    return [replace(s, board_share=share) for s, share in zip(seen, shares, strict=True)], board


def _trials(seen: Sequence[FootageContent]) -> list[Grey]:
    """Pictures that tell which board it is: of board clips first, then of a sweep, which passes a board but once."""
    called = [grey for s in seen if s.called_board for grey in _some(s.look.greys, BOARD_TRIALS)]
    others = [s for s in seen if not s.called_board]
    swept = [grey for s in others if s.moves for grey in s.look.greys]
    fixed = [grey for s in others if not s.moves for grey in _some(s.look.greys, STILL_TRIALS)]
    return [*called, *swept, *fixed][:MOST_TRIALS]


def guess_roles(seen: Sequence[FootageContent], board: BoardGuess | None) -> Roles:
    """Give every clip and folder a role."""
    roles = Roles(board=board)
    standing, moving, boards = [], [], []
    for s in seen:
        fault = _fault(s)
        if fault is None and is_board_clip(s, seen, roles):
            boards.append(s)
        elif fault is None and s.called_board:
            shown = seen_instead(_some(s.look.greys, PICTURES))
            fault = f"called a board clip, but {f'it shows {shown}' if shown else NO_BOARD}"
        elif fault is None and s.moves:
            moving.append(s)
        elif fault is None and not s.look.is_clip:
            fault = "photos whose background stands still: a sweep is photographed walking around the scene"
        elif fault is None:
            standing.append(s)
        if fault is not None:
            roles.left[s.name] = fault
    _sweep(moving, roles)
    for s in standing:
        if s.called == "sweep":
            roles.left[s.name] = "called a sweep, but the camera stands: walk around the scene with it"
        else:
            _camera(s, roles)
    if roles.tests and not roles.cameras:
        roles.cameras, roles.tests = roles.tests, {}
    if not roles.cameras:
        roles.doubts.append("no fixed cameras: no clip in which the camera stands; this is a scene at rest")
    give_boards(boards, roles)
    return roles


def _sweep(moving: list[FootageContent], roles: Roles) -> None:
    """The one so called, else the one from most places that no name calls a camera."""
    for s in sorted(
        moving,
        key=lambda s: (s.called != "sweep", s.called in ("camera", "test"), -_places(s), -s.look.count),
    ):
        count, is_camera = counted(s.look.count, "photo"), s.called in ("camera", "test")
        if not s.look.is_clip and s.look.count < FEWEST_PHOTOS and s.called != "sweep":
            roles.left[s.name] = f"{count}: too few for a sweep"
        elif roles.sweep is None:
            roles.sweep = s
            roles.why[s.name] = f"the sweep: {'the camera moves' if s.look.is_clip else count}"
            if not s.look.is_clip and s.board_share >= BOARD_SHARE:
                roles.doubts.append(
                    f"{s.name}: the board is in {100 * s.board_share:.0f} % of its photos. If they were taken for the "
                    "board, they are no sweep: photograph the scene at rest, walking around it"
                )
            if is_camera:
                roles.doubts.append(
                    f"{s.name}: called a fixed camera, but its picture moves; taken as the sweep"
                )
        elif is_camera:
            roles.left[s.name] = "called a fixed camera, but its picture moves: film again from a tripod"
        else:
            roles.left[s.name] = f"a second sweep; {roles.sweep.name} is used. Swap them if this is better"
    if roles.sweep is None:
        roles.doubts.append(
            "no sweep: no clip in which the camera moves, and no folder of photos. Film the scene at rest with one "
            "moving camera, walking around it; without one, `run --until flow` is all that can be done"
        )


def _places(s: FootageContent) -> float:
    """From about how many places the scene is seen: a walk passes two a second, whatever the frame rate."""
    return (
        min(float(s.look.count), PLACES_A_SECOND * s.look.duration_s)
        if s.look.is_clip
        else float(s.look.count)
    )


def _camera(s: FootageContent, roles: Roles) -> None:
    name = camera_name(s.name, set(roles.fixed))
    (roles.tests if s.called == "test" else roles.cameras)[name] = s
    stands = "the camera stands" if s.steady.stands else "too little to see to tell whether it stands"
    roles.why[s.name] = f"fixed camera {name}: {stands}" + (
        "; a test camera by its name" if s.called == "test" else ""
    )


def _fault(s: FootageContent) -> str | None:
    if s.look.black:
        return "black: a lens cap, or no light; film again"
    if s.look.projection is not None:
        source = s.look.path.name
        (row,) = judge(projection_faults(s.look.projection, source))
        return f"{row.value}. {row.remedy.removeprefix(f'{source}: ')}"
    if s.look.is_clip and s.look.count < 2:
        return "a single picture; expected a clip"
    few = judge([Measure("sweep-few-pictures", s.look.count)])[0].verdict == "fail"
    if not s.look.is_clip and s.called == "sweep" and few:
        return f"called a sweep, but has {counted(s.look.count, 'photo')}: photograph the scene at rest from all around"
    return None


def _some(items: list[Grey], count: int) -> list[Grey]:
    step = max(1, len(items) // count)
    return items[step // 2 :: step][:count]
