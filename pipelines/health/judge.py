"""The judge: measures of a stage become rows, by the one table of what is good enough and what to do (`table.yaml`)."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

from devrf.capture.measure import ENOUGH_CAMERAS, Measure, Verdict

log = logging.getLogger(__name__)
TABLE = Path(__file__).with_name("table.yaml")
Bounds = Sequence[float | int | None]  # from where on it warns, and fails


@dataclass(frozen=True)
class Entry:
    """What is known of a code.

    Attributes:
        check: What is measured, in words.
        remedy: A sentence a field crew can act on, with the measure's facts in braces; several by `Measure.why`.
        unit: Of value and bounds.
        low, high: Bounds, where a low or a high value is bad; at a bound is still fine. None in it: there is no such
            bound, or the measure brings it.
    """

    check: str
    remedy: str | Mapping[str, str] = ""
    unit: str = ""
    low: Bounds | None = None
    high: Bounds | None = None


@dataclass(frozen=True)
class HealthRow:
    """One finding about one stage's result.

    Attributes:
        code: Stays the same whatever is measured.
        check: What was measured, in words.
        value: What came out; None where it could not be measured.
        unit: Unit of value, warn and fail.
        warn, fail: Bounds; None where there is none.
        verdict: ok, warn or fail.
        remedy: A sentence a field crew can act on; empty when the verdict is ok.
        about: The camera, or what else it is about; empty where `check` says all.
    """

    code: str
    check: str
    value: float | str | None
    unit: str
    warn: float | int | None
    fail: float | int | None
    verdict: Verdict
    remedy: str
    about: str = ""

    def as_dict(self) -> dict[str, Any]:
        """As written to health.json: JSON knows no infinity, which is said in words."""
        return {k: str(v) if isinstance(v, float) and not isfinite(v) else v for k, v in asdict(self).items()}

    @property
    def title(self) -> str:
        """What was measured, and of what."""
        return f"{self.check} ({self.about})" if self.about else self.check


@cache
def entries() -> dict[str, Entry]:
    """The table, by code."""
    return {code: Entry(**entry) for code, entry in yaml.safe_load(TABLE.read_text(encoding="utf-8")).items()}


def warns_at(code: str) -> float:
    """The bound beyond which a code warns; of codes whose bound stands in the table only."""
    return _bound(code, 0)


def refuses_at(code: str) -> float:
    """The bound beyond which it refuses; the same."""
    return _bound(code, 1)


def _bound(code: str, which: int) -> float:
    bounds = entries()[code].high or entries()[code].low
    bound = None if bounds is None else bounds[which]
    assert bound is not None
    return float(bound)


def carried(code: str, values: Iterable[float | int]) -> bool:
    """Whether enough cameras are good enough to carry a run, which is then not refused for the poorest one."""
    entry = entries()[code]
    warn, fail = entry.high or entry.low or (None, None)
    sign = 1.0 if entry.high else -1.0
    return sum(_judged(value, warn, fail, sign)[1] != "fail" for value in values) >= ENOUGH_CAMERAS


def judge(measures: Iterable[Measure]) -> list[HealthRow]:
    """A row for each measure; what could not be measured is a warning.

    A fact that a remedy asks for and that is missing is a fault of the program: it is logged, and the remedy stands as
    the table has it, since a stage's work is not to be lost for it.

    Raises:
        KeyError: A code or a reason that the table does not have.
    """
    return [_row(measure, entries()[measure.code]) for measure in measures]


def _row(m: Measure, entry: Entry) -> HealthRow:
    bounds = entry.high or entry.low or (None, None)
    warn, fail = (b if a is None else a for a, b in zip((m.warn, m.fail), bounds, strict=True))
    value, verdict = _judged(m.value, warn, fail if m.refuses else None, 1.0 if entry.high else -1.0)
    if isinstance(value, str):
        warn, fail, verdict = None, None, m.found
    if not m.refuses:
        fail, verdict = None, "warn" if verdict == "fail" else verdict
    remedy = ""
    if verdict != "ok":
        text = entry.remedy if isinstance(entry.remedy, str) else entry.remedy[m.why]
        remedy = _filled(text.strip(), m, value)
        remedy = f"not measured. {remedy}" if value is None else remedy
    return HealthRow(m.code, entry.check, value, entry.unit, warn, fail, verdict, remedy, m.about)


def _filled(text: str, m: Measure, value: float | str | None) -> str:
    """A remedy with the facts of its measure."""
    try:
        return text.format_map({"about": m.about, "value": value, **m.facts})
    except (KeyError, ValueError, TypeError) as error:
        log.error("%s: its remedy cannot be filled in (%r)", m.code, error)
        return text


def _judged(
    value: float | int | str | None, warn: float | int | None, fail: float | int | None, sign: float
) -> tuple[float | str | None, Verdict]:
    """A value as it is written, and how bad it is; `sign`: -1 where a low one is bad."""
    if isinstance(value, str):
        return value, "ok"
    if value is None or value != value:
        return None, "warn"
    beyond = [bound is not None and sign * value > sign * bound for bound in (fail, warn)]
    return float(value), "fail" if beyond[0] else "warn" if beyond[1] else "ok"


def worst(verdicts: Iterable[Verdict | None]) -> Verdict | None:
    """The worst of several verdicts; None where there are none."""
    found = set(verdicts)
    return "fail" if "fail" in found else "warn" if "warn" in found else "ok" if "ok" in found else None
