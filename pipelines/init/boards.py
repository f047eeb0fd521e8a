"""Which clips were made for the calibration board, and which camera each of them is of."""

from collections.abc import Sequence
from pathlib import Path

from devrf.pipelines.init.found import Roles, Seen
from devrf.pipelines.init.names import WORDS, words_of

BOARD_SHARE = 0.5  # of a clip's pictures that show a board: it was filmed for the board
AS_LONG = 1.5  # clips of several cameras that filmed one thing; people start and stop them one by one


def is_board_clip(s: Seen, seen: Sequence[Seen], roles: Roles) -> bool:
    """Whether a clip or folder was made for the board; a guess is said."""
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


def give_boards(boards: list[Seen], roles: Roles) -> None:
    """Find the camera of each board clip; without a sweep, whether the cameras see the board at once."""
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
    own = words_of(s.name)
    best: tuple[float, str] | None = None
    for name, other in owners.items():
        words = words_of(name)
        inside = any(own[i : i + len(words)] == words for i in range(len(own)))
        if not inside and name == "static":
            inside = any(w.startswith(WORDS["sweep"]) for w in own)
        beside = Path(other.name).parent != Path(".") and Path(other.name).parent == Path(s.name).parent
        score = len(name) if inside else 0.5 if beside and _alone_in_folder(other, owners) else 0
        if score and (best is None or score > best[0]):
            best = (score, name)
    return None if best is None else best[1]


def _alone_in_folder(s: Seen, owners: dict[str, Seen]) -> bool:
    return sum(Path(o.name).parent == Path(s.name).parent for o in owners.values()) == 1


def _same_mode(s: Seen, other: Seen) -> bool:
    size, own = (s.look.width, s.look.height), (other.look.width, other.look.height)
    devices = {s.look.device, other.look.device} - {""}
    return size == own and len(devices) < 2
