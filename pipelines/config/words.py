"""What messages about scene.yaml are made of: what was found, what is expected, what may have been meant."""

import difflib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from devrf.pipelines.config.scene import PathText, SceneConfig

_PATH = get_args(PathText)[1]  # the rule that marks a text as a path
Say = Callable[[str, str], None]  # takes the dotted key and what is wrong with it


def suggestion(word: str, choices: Iterable[str], *, cutoff: float = 0.6) -> str:
    """`, did you mean …?` where one of the choices is near; else nothing."""
    near = difflib.get_close_matches(word, list(choices), n=1, cutoff=cutoff)
    return f", did you mean {near[0]}?" if near else ""


def type_in_words(value: Any) -> str:
    """What kind of YAML value it is."""
    names = {dict: "a section", list: "a list", str: "text", bool: "true or false", type(None): "nothing"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else "a value")


def shortened(value: Any) -> str:
    """The value as text, at most 80 characters."""
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 80 else text[:77] + "..."


def near_file(path: Path) -> str:
    """A suggestion out of the folder of a file that is missing."""
    try:
        names = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    except OSError:
        names = []
    return suggestion(path.name, names, cutoff=0.75)


def _model(location: tuple) -> type[BaseModel] | None:
    """The section at a location."""
    model: Any = SceneConfig
    for part in location:
        field = model.model_fields.get(part) if model is not None else None
        model = next(
            (a for a in _alternatives(field) if isinstance(a, type) and issubclass(a, BaseModel)), None
        )
    return model


def _alternatives(field: FieldInfo | None) -> tuple:
    if field is None:
        return ()
    kind = field.annotation
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return (Path,) if _PATH in field.metadata else tuple(map(_unmarked, kinds))


def _unmarked(kind: Any) -> Any:
    """A type without its rules; Path for a text that has to be one."""
    if get_origin(kind) is not Annotated:
        return kind
    plain, *rules = get_args(kind)
    return Path if _PATH in rules else plain


def field_at(location: tuple) -> FieldInfo | None:
    """The field at a location, such as ("capture", "rest"); None where there is none."""
    model = _model(location[:-1]) if location else None
    return model.model_fields.get(str(location[-1])) if model is not None else None


def keys_at(location: tuple) -> list[str]:
    """The keys of the section at a location."""
    model = _model(location)
    return list(model.model_fields) if model is not None else []


def expectation(field: FieldInfo | None) -> str:
    """What a field takes, in words: `a whole number from 64 to 1048576`."""
    kinds = [kind for kind in _alternatives(field) if kind is not type(None)]
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
    parts = []
    for kind in kinds:
        origin = get_origin(kind)
        if origin is Literal:
            parts.append(", ".join(str(choice) for choice in get_args(kind)))
        elif origin is dict:
            number = get_args(get_args(kind)[1])[:1] == (float,)
            parts.append(
                "names with a number each ({cam0: 0.02})"
                if number
                else "names with a path each ({cam0: cam0.mp4})"
            )
        elif origin is list:
            parts.append("a list of names")
        elif origin is tuple:
            of = get_args(kind)
            count = "" if Ellipsis in of else {2: "two ", 3: "three ", 4: "four "}[len(of)]
            what = {int: "whole numbers", float: "numbers", str: "texts"}[of[0]]
            parts.append(f"a list of {count}{what}")
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            parts.append(f"a section with the keys {', '.join(kind.model_fields)}")
        else:
            parts.append(words.get(kind, "a value"))
    text = " or ".join(parts) or "text"
    return text + (_bounds(field) if field is not None else "")


def _bounds(field: FieldInfo) -> str:
    low = high = ""
    for rule in field.metadata:
        match rule:
            case Ge():
                low = f"from {rule.ge}"
            case Gt():
                low = f"above {rule.gt}"
            case Le():
                high = f"to {rule.le}" if low.startswith("from") else f"up to {rule.le}"
            case Lt():
                high = f"below {rule.lt}"
    if low.startswith("from") and not high:
        low += " up"
    return f" {low} {high}".rstrip() if low or high else ""
