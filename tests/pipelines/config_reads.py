"""Which keys of scene.yaml a stage's code reads, found in its text: for the test that its stamp holds them all.

From the stage's `run` on, every function and class of devrf.pipelines that is named is followed. Types are those of the
annotations (`config: SceneConfig`, `settings: RigConfig`, `context.config`), carried through assignments.
"""

import ast
import types
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel

from devrf.pipelines.config.scene import SceneConfig

Section = tuple[str, type[BaseModel]]  # dotted key, its class
CONTEXT = "StageContext"
WHOLE = ("model_dump", "model_dump_json")  # methods that read all of a section
NO_RESULT = (
    "kind",
    "run_dir",
)  # which stages apply, and where they lie: both change without a stage's own result


def reads_of(module: str, function: str = "run") -> set[str]:
    """Dotted keys that a function reads, directly or by what it calls."""
    found: set[str] = set()
    todo, seen = [(module, function)], {(module, function)}
    while todo:
        name, entry = todo.pop()
        source = _Module.of(name)
        node = source.defined.get(entry)
        if node is None:
            continue
        reader = _Reader(source, found)
        reader.look_at(node)
        todo += reader.named - seen
        seen |= reader.named
    return found


def leaves(key: str) -> set[str]:
    """Every key at or below a dotted one."""
    model: type[BaseModel] = SceneConfig
    for part in key.split("."):
        inner = _model_in(model.model_fields[part].annotation)
        if inner is None:
            return {key}
        model = inner
    return {leaf for name in model.model_fields for leaf in leaves(f"{key}.{name}")}


def sections() -> dict[str, Section]:
    """Class name -> where in scene.yaml it stands."""
    found: dict[str, Section] = {"SceneConfig": ("", SceneConfig)}

    def walk(prefix: str, model: type[BaseModel]) -> None:
        for name, field in model.model_fields.items():
            inner = _model_in(field.annotation)
            if inner is not None:
                key = f"{prefix}.{name}".lstrip(".")
                found[inner.__name__] = (key, inner)
                walk(key, inner)

    walk("", SceneConfig)
    return found


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((m for part in get_args(annotation) if (m := _model_in(part))), None)
    return None


SECTIONS = sections()


class _Module:
    """One module of devrf.pipelines: what it defines, and what its names mean."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.defined: dict[str, ast.AST] = {}
        self.imported: dict[str, tuple[str, str]] = {}
        spec = find_spec(name)
        assert spec is not None and spec.origin is not None
        tree = ast.parse(Path(spec.origin).read_text())
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                self.defined[node.name] = node
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("devrf.pipelines"):
                for alias in node.names:
                    self.imported[alias.asname or alias.name] = (str(node.module), alias.name)

    @staticmethod
    @cache
    def of(name: str) -> "_Module":
        return _Module(name)

    def meaning(self, name: str) -> tuple[str, str] | None:
        return (self.name, name) if name in self.defined else self.imported.get(name)


class _Reader:
    """Looks at one function or class; adds the keys it reads, and collects what it names."""

    def __init__(self, module: _Module, found: set[str]) -> None:
        self._module, self._found = module, found
        self.named: set[tuple[str, str]] = set()
        self._own: dict[str, str | None] = {}  # attribute of self -> class

    def look_at(self, node: ast.AST) -> None:
        if isinstance(node, ast.ClassDef):
            for _ in range(2):  # attributes may be set below the place where they are read
                for part in node.body:
                    if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                        self._own[part.target.id] = _kind_in(part.annotation)
                    elif isinstance(part, ast.FunctionDef):
                        self._function(part, {})
        elif isinstance(node, ast.FunctionDef):
            self._function(node, {})

    def _function(self, node: ast.FunctionDef | ast.Lambda, outer: dict[str, str | None]) -> None:
        known = dict(outer)
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        for argument in arguments:
            known[argument.arg] = _kind_in(argument.annotation)
        for part in node.body if isinstance(node, ast.FunctionDef) else [node.body]:
            self._look(part, known)

    def _look(self, node: ast.AST, known: dict[str, str | None]) -> None:
        if isinstance(node, (ast.FunctionDef, ast.Lambda)):
            return self._function(node, known)
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            for target, value in _pairs(node):
                kind = self._kind(value, known)
                if isinstance(target, ast.Name):
                    known[target.id] = kind
                elif isinstance(target, ast.Attribute) and _is_self(target.value) and kind:
                    self._own[target.attr] = kind
        if isinstance(node, ast.Name) and (meaning := self._module.meaning(node.id)):
            if meaning[0] != "devrf.pipelines.config.scene":
                self.named.add(meaning)
        if isinstance(node, ast.Attribute):
            self._kind(node, known)
        for part in ast.iter_child_nodes(node):
            self._look(part, known)

    def _kind(self, node: ast.AST, known: dict[str, str | None]) -> str | None:
        """Class of a section, or of a context, that an expression gives; what it reads on the way is added."""
        if isinstance(node, ast.Name):
            return known.get(node.id)
        if isinstance(node, ast.IfExp):
            return self._kind(node.body, known) or self._kind(node.orelse, known)
        if isinstance(node, ast.BoolOp):
            return next((kind for part in node.values if (kind := self._kind(part, known))), None)
        if not isinstance(node, ast.Attribute):
            return None
        if _is_self(node.value) and node.attr in self._own:
            return self._own[node.attr]
        base = self._kind(node.value, known)
        if base == CONTEXT:
            return "SceneConfig" if node.attr == "config" else None
        if base is None:
            return None
        key, model = SECTIONS[base]
        if node.attr in model.model_fields:
            inner = _model_in(model.model_fields[node.attr].annotation)
            if inner is None:
                self._found.add(f"{key}.{node.attr}".lstrip("."))
            return None if inner is None else inner.__name__
        if node.attr in WHOLE:
            self._found |= leaves(key)
        elif node.attr not in NO_RESULT:
            self._property(base, node.attr)
        return None

    def _property(self, base: str, name: str) -> None:
        module = _Module.of("devrf.pipelines.config.scene")
        owner = module.defined[base]
        assert isinstance(owner, ast.ClassDef)
        for part in owner.body:
            if isinstance(part, ast.FunctionDef) and part.name == name:
                part.args.args[0].annotation = ast.Name(base)  # its self is the section
                _Reader(module, self._found).look_at(part)


def _is_self(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id == "self"


def _pairs(node: ast.Assign | ast.AnnAssign) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Targets and their values: `a, b = c, d` gives two."""
    assert node.value is not None
    for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            yield from zip(target.elts, node.value.elts, strict=True)
        else:
            yield target, node.value


def _kind_in(annotation: ast.AST | None) -> str | None:
    """Name of a section, or of a context, in an annotation: `RigConfig | None` too."""
    for part in ast.walk(annotation) if annotation is not None else ():
        word = part.id if isinstance(part, ast.Name) else getattr(part, "value", None)
        for name in word.split(" | ") if isinstance(word, str) else ():
            if name in SECTIONS or name == CONTEXT:
                return name
    return None
