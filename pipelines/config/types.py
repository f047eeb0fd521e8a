"""Types, ranges and unknown keys of a scene.yaml, in the words of pydantic.

A value that is wrong is replaced by its default so that the checks behind it can still speak.
"""

import copy
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.config.words import Say, shown, suggestion

REPAIRS = 20  # rounds of replacing wrong values; each round removes at least one


def validated(raw: dict, say: Say) -> SceneConfig | None:
    """The configuration; what is wrong is said and replaced by its default. None where nothing is left."""
    data = copy.deepcopy(raw)
    for _ in range(REPAIRS):
        try:
            return SceneConfig.model_validate(data)
        except ValidationError as error:
            told: dict[tuple[str, str], list[str]] = {}  # one mistake for all that a value might have been
            repairs = []
            for item in error.errors(include_url=False):
                location = _place(data, item["loc"])
                absent = item["type"] == "missing" and not _has(data, location)
                repairs.append((location, absent))
                if not (absent and _has(raw, location)):  # removed by a repair: said already
                    value, text = _message(item, location, data)
                    told.setdefault((".".join(map(str, location)), value), []).append(text)
            for (key, value), texts in told.items():
                say(key, value + " or ".join(dict.fromkeys(texts)).replace(" or expected ", " or "))
            for location, absent in dict.fromkeys(repairs):
                _repair(data, location, absent)
    return None


def _place(data: Any, location: tuple) -> tuple:
    """The location without the marks pydantic adds for alternatives and keys, and not inside a list."""
    place = []
    for part in location:
        mark = part == "bool" or (isinstance(part, str) and "[" in part)
        if mark and not (isinstance(data, dict) and part in data):
            continue
        if isinstance(data, list):
            break
        place.append(part)
        data = data.get(part) if isinstance(data, dict) else None
    return tuple(place)


def _message(item: Any, location: tuple, data: dict) -> tuple[str, str]:
    """What is there, where it helps to see it, and what is wrong with it."""
    kind, context = item["type"], item.get("ctx", {})
    dotted = ".".join(map(str, location))
    if kind == "extra_forbidden":
        if (gone := GONE.get(dotted)) is not None:
            return "", f"is no longer a key: {gone}"
        keys = _keys(location[:-1])
        near = suggestion(str(location[-1]), keys) or f"; expected one of {', '.join(keys)}"
        return "", f"unknown key{near}"
    if kind == "literal_error" and (gone := GONE.get(f"{dotted}: {item['input']}")) is not None:
        return f"{item['input']!r} ", f"is no longer known: {gone}"
    if kind == "missing" and not _has(data, location):
        return "", "is missing"
    if kind == "value_error":
        return "", str(context["error"])
    if item["loc"][-1] == "[key]":
        return "", f"the key {item['input']!r} is no text; names are text, write it in quotes"
    value = _at(data, location)
    value = shown(list(value) if isinstance(value, tuple) else value)
    if kind == "model_type":
        return f"{value}; ", f"expected a section with the keys {', '.join(_keys(location))}"
    choices = context["expected"].split("'") if kind == "literal_error" else ()
    text = item["msg"].replace("Input should be", "expected").replace("dictionary", "section")
    return f"{value}; ", text.replace("tuple", "list") + suggestion(str(item["input"]), choices)


def _keys(location: tuple) -> list[str]:
    """The keys of the section at a location."""
    model: type[BaseModel] = SceneConfig
    for part in location:
        kinds = model.model_fields[part].annotation
        plain = (getattr(kind, "__origin__", kind) for kind in (kinds, *get_args(kinds)))
        model = next(kind for kind in plain if isinstance(kind, type) and issubclass(kind, BaseModel))
    return list(model.model_fields)


def _at(data: Any, location: tuple) -> Any:
    for part in location:
        data = data.get(part) if isinstance(data, dict) else None
    return data


def _has(data: Any, location: tuple) -> bool:
    section = _at(data, location[:-1])
    return isinstance(section, dict) and location[-1] in section


def _repair(data: dict, location: tuple, absent: bool) -> None:
    """Remove what is wrong, so that its default takes its place; where it has none, the section around it."""
    if location == ("name",):
        data["name"] = "scene"
    elif not absent and _has(data, location):
        del _at(data, location[:-1])[location[-1]]
    elif len(location) < 2:
        data.clear()
        data["name"] = "scene"
    elif _has(data, location[:-1]):
        del _at(data, location[:-2])[location[-2]]
