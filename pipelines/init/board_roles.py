"""Which clips were made for the calibration board, and which camera each of them is of."""

from collections.abc import Sequence
from pathlib import Path

from devrf.pipelines.init.material import FootageContent, Roles
from devrf.pipelines.init.names import SHORT, WORDS, words_of

BOARD_SHARE = 0.5  # of a clip's pictures that show a board: it was filmed for the board
AS_LONG = 1.5  # clips of several cameras that filmed one thing; people start and stop them one by one


def is_board_clip(s: FootageContent, seen: Sequence[FootageContent], roles: Roles) -> bool:
    """Whether a clip or folder was made for the board; a guess is said."""
    if s.called_board and s.board_share > 0:
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


def give_boards(boards: list[FootageContent], roles: Roles) -> None:
    """Find the camera of each board clip; without a sweep, whether the cameras see the board at once."""
    if roles.sweep is None and roles.fixed and all(s.board_share > 0 for s in roles.fixed.values()):
        roles.joint |= roles.fixed
    owners = roles.fixed if roles.sweep is None else {"static": roles.sweep, **roles.fixed}
    left = []
    for s in boards:
        owner = _owner_by_name(s, owners)
        if owner is None or owner in roles.boards:
            left.append(s)
        else:
            roles.boards[owner] = s
            roles.why[s.name] = f"board before {owner}, by its name"
    for s in left:
        free = [n for n, o in owners.items() if n not in roles.boards and _same_mode(s, o)]
        if len(free) == 1:
            roles.boards[free[0]] = s
            roles.why[s.name] = f"board before {free[0]}, the only camera of this size without one"
        else:
            fits = f"fits {', '.join(free)}" if free else "fits none that lacks one"
            roles.left[s.name] = (
                f"a board clip, but of which camera? It {fits}; put CAMERA: {s.name} into capture.board.clips"
            )
    if roles.sweep is None and not roles.joint and _filmed_at_once(roles.boards, roles.fixed):
        roles.doubts.append(
            "the board clips are taken as filmed at once: without a sweep only they tell the cameras' places"
        )
        roles.joint, roles.boards = roles.boards, {}


def _filmed_at_once(boards: dict[str, FootageContent], cameras: dict[str, FootageContent]) -> bool:
    """Whether every camera has a board clip, and all are about as long."""
    lengths = [s.look.duration_s for s in boards.values()]
    return len(lengths) > 1 and set(boards) == set(cameras) and 0 < max(lengths) <= AS_LONG * min(lengths)


def _owner_by_name(s: FootageContent, owners: dict[str, FootageContent]) -> str | None:
    """The camera whose name, or that alone lies in the same folder, is part of the clip's name; the longest counts."""
    own, folder = words_of(s.name), Path(s.name).parent
    scores: dict[str, float] = {}
    for name, owner in owners.items():
        words = words_of(name if len(name) < SHORT else Path(owner.name).name)  # long ones are cut
        inside = any(own[i : i + len(words)] == words for i in range(len(own)))
        if name == "static":
            inside |= any(w.startswith(WORDS["sweep"]) for w in own)
        alone = folder != Path(".") and [n for n, o in owners.items() if Path(o.name).parent == folder] == [
            name
        ]
        scores[name] = len(name) if inside else 0.5 if alone else 0
    best = max(scores, key=lambda name: scores[name], default=None)
    return best if best is not None and scores[best] else None


def _same_mode(s: FootageContent, other: FootageContent) -> bool:
    size, own = (s.look.width, s.look.height), (other.look.width, other.look.height)
    devices = {s.look.device, other.look.device} - {""}
    return size == own and len(devices) < 2
