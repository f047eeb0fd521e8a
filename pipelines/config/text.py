"""The text of a scene.yaml and of `--set`, as nested dictionaries."""

import re
from pathlib import Path
from typing import Any

import yaml

from devrf.capture.system.limits import is_device
from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.words import near_file

LARGEST_BYTES = 250_000  # a large scene.yaml has 5 000; yaml reads 100 000 a second
MOST_VALUES = 20_000  # with aliases written out: nine lines of them can stand for a thousand million values

MOST_BITS = 4096  # of a whole number; Python prints 4300 digits, which are 14 000


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


def _construct_whole(loader: _Loader, node: yaml.ScalarNode) -> int:
    """A whole number that Python can print: hexadecimal and sexagesimal digits come in thousands, too."""
    value = loader.construct_yaml_int(node)
    if value.bit_length() > MOST_BITS:
        raise yaml.MarkedYAMLError(
            problem=f"a whole number of {value.bit_length()} bits; none needs more than {MOST_BITS}",
            problem_mark=node.start_mark,
        )
    return value


_Loader.add_constructor("tag:yaml.org,2002:int", _construct_whole)


def read_yaml(path: Path) -> dict:
    """The keys of the file; ConfigError where it is missing, or not YAML with keys."""
    if path.is_dir():
        raise ConfigError([f"{path}: is a folder; name the scene.yaml in it"])
    try:
        if is_device(path):
            raise ConfigError([f"{path}: is a device or a pipe; expected a scene.yaml"])
        with path.open("rb") as file:
            content = file.read(LARGEST_BYTES + 1)
        if len(content) > LARGEST_BYTES:
            raise ConfigError([f"{path}: more than {LARGEST_BYTES // 1000} kB; expected a scene.yaml"])
        text = content.decode("utf-8-sig")
    except FileNotFoundError:
        remedy = f"expected a scene.yaml; `devrf-pipeline init {path.parent}` writes one for what lies there"
        raise ConfigError([f"{path}: no such file{near_file(path)}; {remedy}"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read ({error}); expected a YAML text file"]) from None
    try:
        raw = _parsed(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ConfigError([f"{path.name}: {line}{error.problem or error.context}"]) from None
    except yaml.YAMLError as error:
        raise ConfigError([f"{path.name}: not YAML: {error}"]) from None
    if raw is None:
        raise ConfigError([f"{path.name}: is empty; expected at least name, and capture or dataset"])
    if not isinstance(raw, dict):
        raise ConfigError(
            [f"{path.name}: holds a {type(raw).__name__}; expected keys such as name: and capture:"]
        )
    return raw


def _parsed(text: str) -> Any:
    """The plain values of a text.

    Raises:
        yaml.YAMLError: It is not YAML, a value cannot be read, or there are too many.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _count(node, {}) > MOST_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MOST_VALUES} values, aliases (*name) written out; write fewer",
                problem_mark=node.start_mark,
            )
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("nested too deeply to be a scene.yaml") from None
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise yaml.YAMLError(f"a value cannot be read ({error}); quote it if it is text") from None
    finally:
        loader.dispose()


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Values in a node, each alias counted as what it stands for; `known`: nodes counted before."""
    if id(node) not in known:
        known[id(node)] = MOST_VALUES  # met again while it is counted: an alias inside what it names
        inner = node.value if isinstance(node, yaml.SequenceNode | yaml.MappingNode) else []
        parts = [part for item in inner for part in (item if isinstance(item, tuple) else (item,))]
        known[id(node)] = 1 + sum(_count(part, known) for part in parts)
    return known[id(node)]


def override(raw: dict, text: str, mistakes: list[str]) -> str | None:
    """Write one `a.b=value` into `raw`; its dotted key, or None where it cannot be read."""
    key, equals, value_text = text.partition("=")
    key = key.strip()
    if not equals or not key or not all(key.split(".")):
        mistakes.append(f"--set {text}: expected key=value, such as reconstruct.rays=4096")
        return None
    try:
        value = _parsed(value_text)
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
            mistakes.append(f"--set {key}: {section} is {inner!r}, which has no keys inside")
            return None
        here = inner
    here[last] = value
    return key
