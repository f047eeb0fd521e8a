"""Types, ranges and unknown keys of a scene.yaml.

A value that is wrong is replaced by its default so that the checks behind it can still speak.
"""

import copy
import re
from typing import Any

from pydantic import ValidationError

from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.config.words import (
    Say,
    expectation,
    field_at,
    keys_at,
    shortened,
    suggestion,
    type_in_words,
)

_ALTERNATIVES = ("bool", "literal['auto']")  # marks that pydantic puts into locations
REPAIRS = 20  # rounds of replacing wrong values; each round removes at least one


def validated(raw: dict, say: Say) -> SceneConfig | None:
    """The configuration; what is wrong is said and replaced by its default. None where nothing is left."""
    data = copy.deepcopy(raw)
    for _ in range(REPAIRS):
        try:
            return SceneConfig.model_validate(data)
        except ValidationError as error:
            for item in error.errors(include_url=False):
                location = _real_location(data, item["loc"])
                absent = item["type"] == "missing" and not _has(data, location)
                if not (absent and _has(raw, location)):  # removed by a repair: said already
                    say(".".join(str(part) for part in location), _message(item, location, data))
                _repair(data, location, absent)
    return None


def _real_location(data: Any, location: tuple) -> tuple:
    """The location without the marks pydantic adds for alternatives and keys, and not inside a list."""
    real = []
    for part in location:
        mark = part in _ALTERNATIVES or (isinstance(part, str) and "[" in part)
        if mark and not (isinstance(data, dict) and part in data):
            continue
        if isinstance(data, list):
            break
        real.append(part)
        data = data.get(part) if isinstance(data, dict) else None
    return tuple(real)


def _message(item: Any, location: tuple, data: dict) -> str:
    kind, value, context = item["type"], item["input"], item.get("ctx", {})
    field = field_at(location)
    for part in location:
        data = data.get(part, {}) if isinstance(data, dict) else {}
    if isinstance(data, list) and kind != "value_error":
        return f"{shortened(data)}; expected {expectation(field)}"
    if kind == "extra_forbidden":
        if gone := GONE.get(".".join(map(str, location))):
            return f"is no longer a key: {gone}"
        keys = keys_at(location[:-1])
        hint = suggestion(str(location[-1]), keys) or f"; expected one of {', '.join(keys)}"
        return f"unknown key{hint}"
    if kind == "missing":
        return f"is missing; expected {expectation(field)}"
    if kind == "value_error":
        return str(context["error"])
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"])
        return f"{value!r}; expected {', '.join(choices)}{suggestion(str(value), choices)}"
    if item["loc"] and item["loc"][-1] == "[key]":
        return f"the key {value!r} is {type_in_words(value)}; names are text, write it in quotes"
    return f"{shortened(value)}; expected {expectation(field)}"


def _repair(data: dict, location: tuple, absent: bool) -> None:
    """Remove what is wrong, so that its default takes its place; give a placeholder to what has none."""
    placeholders: dict[tuple, Any] = {("name",): "scene"}
    if location in placeholders:
        data[location[0]] = placeholders[location]
        return
    here: Any = data
    for part in location[:-1]:
        if not isinstance(here, dict) or part not in here:
            break
        here = here[part]
    if absent or not isinstance(here, dict) or location[-1] not in here:
        _drop(data, location[:-1])  # a section that lacks what it needs, or an item of a list
    else:
        del here[location[-1]]


def _has(raw: Any, location: tuple) -> bool:
    for part in location:
        if not isinstance(raw, dict) or part not in raw:
            return False
        raw = raw[part]
    return True


def _drop(data: dict, location: tuple) -> None:
    here: Any = data
    for part in location[:-1]:
        here = here.get(part) if isinstance(here, dict) else None
    if location and isinstance(here, dict):
        here.pop(location[-1], None)
    else:
        data.clear()
        data["name"] = "scene"
