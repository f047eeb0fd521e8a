"""From scene.yaml to a checked `SceneConfig`, or to the list of everything that is wrong with it.

Mistakes are collected, never raised one by one: YAML syntax and duplicate keys first (nothing can be
read beyond them), then types, ranges and unknown keys, then what keys mean together, then missing files.
A value that is wrong is replaced by its default so that the checks behind it can still speak.
"""

import copy
import difflib
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from devrf.capture.errors import InputError
from devrf.pipelines.scene_config import CAMERA_NAME, RESERVED_NAMES, RESERVED_PREFIXES, SceneConfig

REPAIRS = 20  # rounds of replacing wrong values; each round removes at least one


class ConfigError(InputError):
    """Everything that is wrong with a configuration; one line per mistake in `mistakes`."""

    def __init__(self, mistakes: Iterable[str]) -> None:
        self.mistakes = tuple(dict.fromkeys(mistakes))
        super().__init__("\n".join(self.mistakes))


def load_scene(
    path: Path, overrides: Sequence[str] = (), *, preset: str | None = None, check_files: bool = True
) -> SceneConfig:
    """Read scene.yaml, apply `a.b=value` overrides and check everything.

    Args:
        path: The file.
        overrides: Texts `dotted.key=value`; the value is read as YAML.
        preset: In place of the file's.
        check_files: Whether the files it names must exist.
    Raises:
        ConfigError: With every mistake, in the form `scene.yaml: key: what is wrong`.
    """
    raw = _read_yaml(path)
    if preset is not None:
        raw["preset"] = preset
    mistakes: list[str] = []
    overridden = [key for text in overrides if (key := _override(raw, text, mistakes))]

    def say(key: str, text: str) -> None:
        from_command_line = any(key == k or key.startswith(k + ".") for k in overridden)
        where = f"--set {key}" if from_command_line else f"{path.name}: {key}" if key else path.name
        if key == "preset" and preset is not None and not from_command_line:
            where = "--preset"
        mistakes.append(f"{where}: {text}")

    config = _validate(raw, say)
    if config is not None:
        _check_together(config, raw, say)
        if check_files:
            _check_files(config, path.parent.resolve(), say)
    if mistakes or config is None:
        raise ConfigError(mistakes)
    return config


# --- YAML ---


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses duplicate keys and reads 1e-3 as a number."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+"), list("-+0123456789.")
)


def _construct_mapping(loader: _Loader, node: yaml.MappingNode) -> dict:
    loader.flatten_mapping(node)
    seen: dict[Any, int] = {}
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        line = key_node.start_mark.line + 1
        if not isinstance(key, str | int | float | bool | None):
            raise yaml.MarkedYAMLError(problem="keys must be text", problem_mark=key_node.start_mark)
        if key in seen:
            raise yaml.MarkedYAMLError(
                problem=f"key {key!r} is given twice (first in line {seen[key]}); remove one",
                problem_mark=key_node.start_mark,
            )
        seen[key] = line
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)


def _read_yaml(path: Path) -> dict:
    if path.is_dir():
        raise ConfigError([f"{path}: is a folder; name the scene.yaml in it"])
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError([_no_scene(path)]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read ({error}); expected a YAML text file"]) from None
    try:
        raw = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ConfigError([f"{path.name}: {line}{error.problem or error.context}"]) from None
    except yaml.YAMLError as error:
        raise ConfigError([f"{path.name}: not YAML: {error}"]) from None
    except RecursionError:
        raise ConfigError([f"{path.name}: nested too deeply to be a scene.yaml"]) from None
    if raw is None:
        raise ConfigError([f"{path.name}: is empty; expected at least name, and capture or dataset"])
    if not isinstance(raw, dict):
        raise ConfigError([f"{path.name}: holds {_type(raw)}; expected keys such as name: and capture:"])
    return raw


def _override(raw: dict, text: str, mistakes: list[str]) -> str | None:
    """Write one `a.b=value` into `raw`; its dotted key, or None where it cannot be read."""
    key, equals, value_text = text.partition("=")
    key = key.strip()
    if not equals or not key or not all(key.split(".")):
        mistakes.append(f"--set {text}: expected key=value, such as reconstruct.rays=4096")
        return None
    try:
        value = yaml.load(value_text, Loader=_Loader)
    except yaml.YAMLError:
        mistakes.append(f"--set {text}: the value cannot be read as YAML; quote it")
        return None
    *sections, last = key.split(".")
    here = raw
    for section in sections:
        inner = here.get(section)
        if inner is None:
            inner = here[section] = {}
        if not isinstance(inner, dict):
            mistakes.append(f"--set {key}: {section} is {_type(inner)}, which has no keys inside")
            return None
        here = inner
    here[last] = value
    return key


# --- types, ranges, unknown keys ---


def _validate(raw: dict, say: Any) -> SceneConfig | None:
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
        if part == "[key]" or (isinstance(part, str) and "[" in part) or part in _ALTERNATIVES:
            continue
        if isinstance(data, list):
            break
        real.append(part)
        data = data.get(part) if isinstance(data, dict) else None
    return tuple(real)


_ALTERNATIVES = ("bool", "literal['auto']")


def _message(item: Any, location: tuple, data: dict) -> str:
    kind, value, context = item["type"], item["input"], item.get("ctx", {})
    field = _field(location)
    for part in location:
        data = data.get(part, {}) if isinstance(data, dict) else {}
    if isinstance(data, list) and kind != "value_error":
        return f"{_shorten(data)}; expected {_expectation(field)}"
    if kind == "extra_forbidden":
        keys = _keys(location[:-1])
        hint = _suggestion(str(location[-1]), keys) or f"; expected one of {', '.join(keys)}"
        return f"unknown key{hint}"
    if kind == "missing":
        return f"is missing; expected {_expectation(field)}"
    if kind == "value_error":
        return str(context["error"])
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"])
        return f"{value!r}; expected {', '.join(choices)}{_suggestion(str(value), choices)}"
    if item["loc"] and item["loc"][-1] == "[key]":
        return f"the key {value!r} is {_type(value)}; names are text, write it in quotes"
    return f"{_shorten(value)}; expected {_expectation(field)}"


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
    return tuple(get_args(k)[0] if get_origin(k) is Annotated else k for k in kinds)


def _field(location: tuple) -> FieldInfo | None:
    model = _model(location[:-1]) if location else None
    return model.model_fields.get(str(location[-1])) if model is not None else None


def _keys(location: tuple) -> list[str]:
    model = _model(location)
    return list(model.model_fields) if model is not None else []


def _expectation(field: FieldInfo | None) -> str:
    """What a field takes, in words: `a whole number from 64 to 1048576`."""
    kinds = [kind for kind in _alternatives(field) if kind is not type(None)]
    words = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}
    parts = []
    for kind in kinds:
        origin = get_origin(kind)
        if origin is Literal:
            parts.append(", ".join(str(choice) for choice in get_args(kind)))
        elif origin is dict:
            parts.append("names with a path each ({cam0: cam0.mp4})")
        elif origin is list:
            parts.append("a list of names")
        elif origin is tuple:
            inner = words.get(get_args(kind)[0], "value")
            parts.append(f"a list of two {'whole numbers' if inner == 'a whole number' else 'numbers'}")
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


# --- what keys mean together ---


def _check_together(config: SceneConfig, raw: dict, say: Any) -> None:
    if raw.get("capture") is None and raw.get("dataset") is None:
        misspelt = [str(key) for key in raw if key not in SceneConfig.model_fields]
        if not any(difflib.get_close_matches(word, ("capture", "dataset")) for word in misspelt):
            say("capture", "is missing; give capture (raw files) or dataset (a finished data set)")
        return
    if config.dataset is not None:
        for key in ("capture", "calibration"):
            if raw.get(key) is not None:
                say(key, "does not go with dataset; remove one of them")
        return
    capture = config.capture
    if capture is None:
        return
    given = raw.get("capture")
    if isinstance(given, dict) and not given.get("static") and not capture.all_cameras:
        say("capture", "names no material; give static (the sweep), cameras, or both")
    of_the_sweep = {"white": capture.white, "board.clips": capture.board.clips if capture.board else {}}
    if capture.static is None and not (
        isinstance(given, dict) and given.get("static")
    ):  # else that is said already
        for section, clips in of_the_sweep.items():
            if "static" in clips:
                say(
                    f"capture.{section}.static", "is of the sweep's camera; give capture.static, or remove it"
                )
    _check_names(config, say)
    if config.kind == "cameras" and capture.cameras:
        rig = config.calibration.rig
        board_is_wrong = capture.board is None and isinstance(given, dict) and bool(given.get("board"))
        joint = {} if capture.board is None else capture.board.joint_clips
        without = [name for name in capture.all_cameras if name not in joint]
        if rig.given is None and joint and without:
            say(
                "capture.board.joint_clips",
                f"has no clip of {', '.join(without)}; expected one of every camera",
            )
        if rig.given is None and not joint and not board_is_wrong:
            say(
                "capture.static",
                "is missing, and without a sweep the cameras' poses come from a board that several see "
                "(capture.board.joint_clips) or from a file (calibration.rig.given); give one of the three",
            )
    if capture.mattes is not None and capture.mattes.method == "background" and config.kind == "sweep":
        say("capture.mattes", "background needs fixed cameras, and there is only a sweep; use another method")
    rig = config.calibration.rig
    if rig.method == "given" and rig.given is None:
        say("calibration.rig.given", "is missing; rig.method: given needs the calibration file")
    if rig.method == "board" and not (capture.board and capture.board.joint_clips):
        say(
            "capture.board.joint_clips",
            "is missing; rig.method: board needs clips that several cameras share",
        )
    if rig.method == "sweep" and capture.static is None:
        say("capture.static", "is missing; rig.method: sweep needs the sweep")
    _check_charts(config, say)
    if config.calibration.sync.method == "timestamps" and capture.timestamps is None:
        say("capture.timestamps", "is missing; sync.method: timestamps needs the CSV file")


def _check_charts(config: SceneConfig, say: Any) -> None:
    capture, colour = config.capture, config.calibration.colour
    assert capture is not None
    if colour.method == "chart" and not colour.chart:
        say(
            "calibration.colour.chart",
            "is missing; colour.method: chart needs a picture of the chart by each camera",
        )
    known = [*(["static"] if capture.static is not None else []), *capture.all_cameras]
    for name in colour.chart:
        if name not in known:
            text = f"no camera has this name{_suggestion(name, known)} (cameras: {', '.join(known)})"
            say(f"calibration.colour.chart.{name}", text)
    reference = "static" if capture.static is not None else next(iter(capture.training_cameras), None)
    if colour.chart and reference is not None and reference not in colour.chart:
        say(
            f"calibration.colour.chart.{reference}",
            "is missing; all cameras are brought to the look of this one, so film the chart with it too",
        )


def _check_names(config: SceneConfig, say: Any) -> None:
    capture = config.capture
    assert capture is not None
    named = {"cameras": capture.cameras}
    if isinstance(capture.test_cameras, dict):
        named["test_cameras"] = capture.test_cameras
    for section, cameras in named.items():
        for name in cameras:
            if not CAMERA_NAME.fullmatch(name):
                say(
                    f"capture.{section}",
                    f"{name!r} cannot be a camera's name; use letters, digits, _ and - (at most 64)",
                )
            elif name in RESERVED_NAMES or name.startswith(RESERVED_PREFIXES):
                say(f"capture.{section}", f"{name!r} is a name that the run folder needs; choose another")
    sync = config.calibration.sync
    for key, named_cameras in (("av_lag_s", sync.av_lag_s), ("readout_s", sync.readout_s)):
        for name in named_cameras:
            if name not in capture.all_cameras:
                known = capture.all_cameras
                say(f"calibration.sync.{key}", f"{name!r} is not in cameras{_suggestion(name, known)}")
    if isinstance(capture.test_cameras, list):
        for name in capture.test_cameras:
            if name not in capture.cameras:
                say("capture.test_cameras", f"{name!r} is not in cameras{_suggestion(name, capture.cameras)}")
    else:
        for name in sorted(set(capture.cameras) & set(capture.test_cameras)):
            say("capture.test_cameras", f"{name!r} is in cameras too; a name stands for one camera")
    if capture.all_cameras and not capture.training_cameras:
        say("capture.cameras", "every camera is a test camera; leave at least one to train on")
    clips = Counter(capture.all_cameras.values())
    for clip, count in clips.items():
        if count > 1:
            names = ", ".join(name for name, own in capture.all_cameras.items() if own == clip)
            say("capture.cameras", f"{names} name the same file {clip!r}; each camera has its own clip")
    sections = {"white": capture.white}
    if capture.board is not None:
        sections |= {"board.clips": capture.board.clips, "board.joint_clips": capture.board.joint_clips}
    for section, clips in sections.items():
        known = [*capture.all_cameras, *([] if section == "board.joint_clips" else ["static"])]
        for name in clips:
            if name not in known:
                say(
                    f"capture.{section}.{name}",
                    f"no camera has this name{_suggestion(name, known)} (cameras: {', '.join(known)})",
                )


# --- files ---


def input_paths(config: SceneConfig) -> dict[str, str]:
    """Every path that the configuration names: dotted key -> path as written."""
    paths: dict[str, str | None] = {}
    if config.dataset is not None:
        paths["dataset.path"] = config.dataset.path
    if config.capture is not None:
        capture = config.capture
        paths["capture.static"] = capture.static
        paths |= {f"capture.cameras.{name}": clip for name, clip in capture.cameras.items()}
        if isinstance(capture.test_cameras, dict):
            paths |= {f"capture.test_cameras.{name}": clip for name, clip in capture.test_cameras.items()}
        paths["capture.timestamps"] = capture.timestamps
        paths |= {f"capture.white.{name}": path for name, path in capture.white.items()}
        paths["capture.mattes.folder"] = None if capture.mattes is None else capture.mattes.folder
        if capture.board is not None:
            paths |= {f"capture.board.clips.{name}": c for name, c in capture.board.clips.items()}
            paths |= {f"capture.board.joint_clips.{name}": c for name, c in capture.board.joint_clips.items()}
    given = config.calibration.rig.given
    if isinstance(given, dict):
        paths |= {f"calibration.rig.given.{name}": path for name, path in given.items()}
    else:
        paths["calibration.rig.given"] = given
    paths |= {f"calibration.colour.chart.{n}": path for n, path in config.calibration.colour.chart.items()}
    if config.evaluate.lpips_weights != "download":
        paths["evaluate.lpips_weights"] = config.evaluate.lpips_weights
    paths["evaluate.truth"] = config.evaluate.truth
    paths["flow.weights"] = config.flow.weights
    return {key: path for key, path in paths.items() if path is not None}


def _check_files(config: SceneConfig, scene_dir: Path, say: Any) -> None:
    folders = {"dataset.path", "evaluate.lpips_weights", "capture.mattes.folder"}
    files_or_folders = {"capture.static", "calibration.rig.given"}
    clips = "capture.board.clips."  # photos of the board will do
    for key, text in input_paths(config).items():
        path = config.path(scene_dir, text)
        if not text.strip():
            say(key, "is empty; expected a path")
        elif not path.exists():
            say(key, f"{text!r}: no such file or folder ({path}){_near_file(path)}")
        elif key in folders and not path.is_dir():
            say(key, f"{text!r} is a file; expected a folder")
        elif key not in folders | files_or_folders and not key.startswith(clips) and path.is_dir():
            say(key, f"{text!r} is a folder; expected a file")


def _no_scene(path: Path) -> str:
    """What to say where there is no scene.yaml: what the folder holds instead, and what to write."""
    from devrf.capture.formats.datasets import guess_format

    folder = path.parent
    if not folder.is_dir():
        return f"{path}: no such file, and no such folder; expected a scene.yaml or the folder that holds one"
    found = guess_format(folder)
    if found is None:
        return f"{path}: no such file{_near_file(path)}; expected a scene.yaml, see docs/formats.md"
    return (
        f"{path}: no such file; the folder looks like a data set ({found}): write a scene.yaml with "
        f"name: NAME and dataset: {{format: {found}, path: {folder}}}"
    )


def _near_file(path: Path) -> str:
    try:
        names = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    except OSError:
        names = []
    return _suggestion(path.name, names, cutoff=0.75)


# --- words ---


def _suggestion(word: str, choices: Iterable[str], *, cutoff: float = 0.6) -> str:
    near = difflib.get_close_matches(word, list(choices), n=1, cutoff=cutoff)
    return f", did you mean {near[0]}?" if near else ""


def _type(value: Any) -> str:
    names = {dict: "a section", list: "a list", str: "text", bool: "true or false", type(None): "nothing"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else "a value")


def _shorten(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 80 else text[:77] + "..."
