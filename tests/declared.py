"""Watches stages that run in this process: each reads the keys of scene.yaml and the folders it declares, no others.

A key or a folder that is read and not declared is no part of the stamp: a change of it would leave a stale result.
Every run of the command line in the tests (`devrf`) is watched, so what any of them makes a stage read is checked.
"""

import os
import sys
import threading
import types
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.stages import STAGES, stage_names

MOTION = ("motion_iterations", "key_times")
READ_BUT_NOT_A_KEY = {
    "ingest": {"capture.rest"},  # a session carries it for `check`
    "canonical": {f"reconstruct.{key}" for key in MOTION},  # options of both trainings are made at once
    "evaluate": {"evaluate.truth"},  # `inputs` has its content, named or not
}
NO_RESULT = ("kind",)  # which stages apply: changes without a stage's own result
WHOLE = ("model_dump", "model_dump_json")  # methods that read all of a section


@cache
def watch() -> "Watch":
    """Watches every stage of the pipeline from the first call on, as long as this process lives."""
    made = Watch()
    for stage in STAGES:
        object.__setattr__(stage, "run", made.watched(stage, stage.run))
    return made


class Watch:
    """What stages have read without declaring it."""

    def __init__(self) -> None:
        self._undeclared: list[str] = []
        self._stage: Stage | None = None
        self._allowed: set[str] = set()
        self._folders: set[str] = set()
        self._run_dir, self._thread, self._quiet = "", 0, False
        for key, model in {"": SceneConfig, **sections()}.items():
            self._spy_on(model, key)
        sys.addaudithook(self._audit)

    def undeclared(self) -> list[str]:
        """What was read since the last call."""
        found, self._undeclared = self._undeclared, []
        return list(dict.fromkeys(found))

    def watched(self, stage: Stage, run: Callable[[StageContext], None]) -> Callable[[StageContext], None]:
        """The work of a stage, watched."""
        declared = {leaf for key in (*stage.config_keys, "budget") for leaf in leaves(key)}
        referred = {name for one in STAGES if one.refers and one.name in stage.reads for name in one.reads}

        def watched(context: StageContext) -> None:
            self._allowed = declared | READ_BUT_NOT_A_KEY.get(stage.name, set())
            self._run_dir, self._thread = f"{context.run_dir}{os.sep}", threading.get_ident()
            self._folders = {stage.name, *stage.reads, *referred}
            self._stage = stage
            try:
                run(context)
            finally:
                self._stage = None

        return watched

    def _spy_on(self, model: type[BaseModel], key: str) -> None:
        """See every key that is read of a section."""
        get = model.__getattribute__

        def spied(section: BaseModel, name: str) -> Any:
            if name in NO_RESULT:
                before, self._quiet = self._quiet, True
                try:
                    return get(section, name)
                finally:
                    self._quiet = before
            if name in WHOLE:
                self._read(leaves(key))
            elif name in model.model_fields and (below := f"{key}.{name}".lstrip(".")) not in sections():
                self._read({below})
            return get(section, name)

        model.__getattribute__ = spied  # type: ignore[method-assign]

    def _read(self, keys: set[str]) -> None:
        stage = self._stage
        if stage is not None and not self._quiet and threading.get_ident() == self._thread:
            self._undeclared += [f"{stage.name} reads {key}" for key in sorted(keys - self._allowed)]

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        stage = self._stage
        if stage is None or event != "open" or not isinstance(arguments[0], str | os.PathLike):
            return
        path = os.fspath(arguments[0])
        if isinstance(path, str) and path.startswith(self._run_dir):
            name = path[len(self._run_dir) :].split(os.sep)[0]
            if name in stage_names() and name not in self._folders:
                self._undeclared.append(f"{stage.name} opens a file of {name}")


@cache
def sections() -> dict[str, type[BaseModel]]:
    """Dotted key -> class of every section of scene.yaml."""
    found: dict[str, type[BaseModel]] = {}

    def walk(prefix: str, model: type[BaseModel]) -> None:
        for name, field in model.model_fields.items():
            inner = _model_in(field.annotation)
            if inner is not None:
                found[f"{prefix}{name}"] = inner
                walk(f"{prefix}{name}.", inner)

    walk("", SceneConfig)
    return found


def leaves(key: str) -> set[str]:
    """Every key at or below a dotted one; the empty one is all of scene.yaml."""
    model = {"": SceneConfig, **sections()}.get(key)
    if model is None:
        return {key}
    return {leaf for name in model.model_fields for leaf in leaves(f"{key}.{name}".lstrip("."))}


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((m for part in get_args(annotation) if (m := _model_in(part))), None)
    return None
