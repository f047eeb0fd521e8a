"""Types and shapes of all of devrf's functions are checked while tests run.

jaxtyping's import hook (`addopts` in pyproject.toml) decorates every function with `jaxtyping.jaxtyped`, which checks
every call, arguments twice. `check_once`, called before devrf is imported, puts a decorator in its place that checks
each call once, and that compiles a function's checks when it is first called.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import Any, ForwardRef, get_args

import jaxtyping
from beartype import BeartypeConf, beartype

_jaxtyped: Any = jaxtyping.jaxtyped
_check = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))


def check_once() -> None:
    """Let the import hook decorate with the cheaper checks."""
    jaxtyping.jaxtyped = _checked


def _checked(fn: Any = None, *, typechecker: Any = None) -> Any:
    """What the hook writes before functions and classes, `@jaxtyped(typechecker=..)`; also `jaxtyped("context")`."""
    if fn is None:
        return functools.partial(_checked, typechecker=typechecker)
    if inspect.isfunction(fn):
        return _when_called(fn)
    if dataclasses.is_dataclass(fn) and inspect.isfunction(made := vars(fn).get("__init__")):
        fn.__init__ = _when_called(made)
        return fn
    return _jaxtyped(fn, typechecker=typechecker) if typechecker else _jaxtyped(fn)


def _when_called(fn: Callable[..., Any]) -> Callable[..., Any]:
    checked: Callable[..., Any] | None = None

    @functools.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        checked = checked or _with_checks(fn)
        return checked(*args, **kwargs)

    return call


def _with_checks(fn: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose arguments and result are checked; a name of an axis stands for one length in a call."""
    parts = [part for hint in fn.__annotations__.values() for part in _parts(hint)]
    if any(isinstance(part, str | ForwardRef) for part in parts):  # may name what is not there at run time
        return _jaxtyped(fn, typechecker=_check)
    checked = _check(fn)
    if not any(inspect.isclass(part) and issubclass(part, jaxtyping.AbstractArray) for part in parts):
        return checked

    def call(*args: Any, **kwargs: Any) -> Any:
        with _jaxtyped("context"):
            return checked(*args, **kwargs)

    return call


def _parts(hint: Any) -> Iterator[Any]:
    """An annotation and all that it is made of."""
    yield hint
    for part in hint if isinstance(hint, list) else get_args(hint):
        yield from _parts(part)
