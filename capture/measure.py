"""What rooms and stages measure of their own results: a code, a number, and what it is about; nobody judges here."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import inf, isnan
from typing import Any, Literal

Verdict = Literal["ok", "warn", "fail"]
ENOUGH_CAMERAS = 2  # that are trained on: with these a run goes on without others, as with two from the first


@dataclass(frozen=True)
class Measure:
    """One measure or finding, judged by the table of `devrf.pipelines.health`.

    Attributes:
        code: Its entry in the table.
        value: What was measured, in the entry's unit; text where something was found; None: it could not be measured.
        about: The camera, or what else it is about; empty where the code says all.
        why: Which of the entry's remedies is meant, where it has several.
        facts: What the remedy names.
        found: How bad a text is.
        warn, fail: Bounds that depend on what was measured, in place of the table's.
        refuses: Whether it may stop a run; of test cameras nothing does.
    """

    code: str
    value: float | int | str | None
    about: str = ""
    why: str = ""
    facts: Mapping[str, str | float | int] = field(default_factory=dict)
    found: Verdict = "warn"
    warn: float | int | None = None
    fail: float | int | None = None
    refuses: bool = True


def of_test(name: str, measures: Iterable[Measure]) -> list[Measure]:
    """Measures of a test camera: about it where they name no other, and never a refusal."""
    return [replace(m, about=m.about or name, refuses=False) for m in measures]


def noted(texts: Iterable[str], about: str) -> list[Measure]:
    """What is worth knowing and nothing to be done about, as one measure; none without texts."""
    said = "; ".join(texts)
    return [Measure("noted", said, about, found="ok")] if said else []


def highest(code: str, values: Mapping[str, float], scale: float | int = 1, **more: Any) -> Measure:
    """The largest of several cameras' values; `more` as of `Measure`. Values that are NaN lose."""
    name = max(values, key=lambda n: -inf if isnan(values[n]) else values[n])
    return Measure(code, scale * values[name], name, **more)


def lowest(code: str, values: Mapping[str, float], scale: float | int = 1, **more: Any) -> Measure:
    """The smallest of several cameras' values; `more` as of `Measure`."""
    name = min(values, key=lambda n: values[n])
    return Measure(code, scale * values[name], name, **more)
