"""Why a stage has to be made again, in words."""

from pathlib import Path
from typing import Any

from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.digests import Digests
from devrf.pipelines.stamps.stamp import damage


def why_stale(stage: Stage, folder: Path, stamp: dict, now: dict, digests: Digests | None) -> list[str]:
    """Reasons why a stage's folder does not fit; empty where it does.

    Args:
        stage: The stage.
        folder: The stage's folder.
        stamp: What lies in it.
        now: What it would be made from now (`identity`).
        digests: Source of content digests; None where its files are known to be whole.
    """
    then = stamp["identity"]
    if then.keys() != now.keys() or not all(isinstance(part, dict) for part in then.values()):
        return ["made by a version of the program that knew less of what it was made from"]
    reasons = [f"{key}: {_change(old, new)}" for key, old, new in _differences(then, now, "config")]
    reasons += [f"{name}: {_file_change(old, new)}" for name, old, new in _differences(then, now, "inputs")]
    reasons += [f"{name}: lies elsewhere" for name, _, _ in _differences(then, now, "places")]
    for name, _, made in _differences(then, now, "reads"):
        if name not in now["reads"]:
            reasons.append(f"{name} no longer applies")
        elif name not in then["reads"]:
            reasons.append(f"{name} applies now")
        else:
            again = "was made again" if stage.quotes_stamps else "came out differently"
            reasons.append(f"{name} {'is not made' if made is None else again}")
    changed = [_shown(name) for name, _, _ in _differences(then, now, "rooms")]
    reasons += [f"the code changed ({', '.join(changed)})"] if changed else []
    for name, old, new in _differences(then, now, "libraries"):
        reasons.append(
            f"{name} {old} is no longer there"
            if new is None
            else f"{name} {new} is newly there"
            if old is None
            else f"{name} {old} is now {new}"
        )
    return reasons if digests is None else reasons + damage(folder, stamp, digests)


def _differences(then: dict, now: dict, part: str) -> list[tuple[str, Any, Any]]:
    """Name, old and new value of each entry of a part that is not the same. None stands for none.

    A stage that is not made and one that is not read are two things; a key that is not set and one that is not there
    are the same.
    """
    old, new = then[part], now[part]
    return [
        (name, old.get(name), new.get(name))
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name) or (part == "reads" and (name in old) != (name in new))
    ]


def _change(old: Any, new: Any) -> str:
    """What happened to a key. Values are those of `identity`, None where there is none."""
    was_file, is_file = (isinstance(value, dict) and value.get("content") is not None for value in (old, new))
    if was_file or is_file:
        return _file_change(old if was_file else None, new if is_file else None)
    if old == {} or new == {}:  # what came or went stands at keys of its own
        return "no longer empty" if old == {} else "now empty"
    if old is None or new is None:
        return f"was not set, is now {new}" if old is None else f"was {old}, is no longer set"
    return f"{old} is now {new}"


def _file_change(old: Any, new: Any) -> str:
    return "newly given" if old is None else "no longer given" if new is None else "content changed"


def _shown(part: str) -> str:
    """A folder of code with a slash behind it."""
    return part if part.endswith(".py") else f"{part}/"
