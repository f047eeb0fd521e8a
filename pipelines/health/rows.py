"""Health rows: what a stage measured of its own result, and what to do where it falls short."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import wraps
from typing import Literal, ParamSpec

NO_PICTURE = "it takes no picture while two training cameras film"  # why a test camera is left out of a scene

Verdict = Literal["ok", "warn", "fail"]
Of = ParamSpec("Of")


@dataclass(frozen=True)
class HealthRow:
    """One check of one stage.

    Attributes:
        check: What was measured, in words.
        value: What came out; None where it could not be measured.
        unit: Unit of value, warn and fail.
        warn, fail: Bounds; None where there is none.
        verdict: ok, warn or fail.
        remedy: A sentence a field crew can act on; empty when the verdict is ok.
    """

    check: str
    value: float | str | None
    unit: str
    warn: float | None
    fail: float | None
    verdict: Verdict
    remedy: str

    def as_dict(self) -> dict:
        """As written to health.json."""
        return asdict(self)


def row(
    check: str,
    value: float | None,
    unit: str = "",
    *,
    warn: float | None = None,
    fail: float | None = None,
    warn_above: float | None = None,
    fail_above: float | None = None,
    remedy: str,
) -> HealthRow:
    """Judge a value: at a bound is still fine, beyond it is not; not measured is a warning.

    A low value is bad (`warn`, `fail`), or a high one (`warn_above`, `fail_above`).
    """
    sign = -1.0 if warn_above is fail_above is None else 1.0
    warn, fail = (warn, fail) if sign < 0 else (warn_above, fail_above)
    if value is None or value != value:
        return HealthRow(check, None, unit, warn, fail, "warn", f"not measured. {remedy}")
    beyond = [bound is not None and sign * value > sign * bound for bound in (fail, warn)]
    verdict: Verdict = "fail" if beyond[0] else "warn" if beyond[1] else "ok"
    return HealthRow(check, float(value), unit, warn, fail, verdict, "" if verdict == "ok" else remedy)


def note(check: str, value: str, *, verdict: Verdict | None = None, remedy: str = "") -> HealthRow:
    """A row that states something in words (which cue gave the clocks); a warning where there is a remedy."""
    return HealthRow(check, value, "", None, None, verdict or ("warn" if remedy else "ok"), remedy)


def without_refusal(rows: Iterable[HealthRow]) -> list[HealthRow]:
    """Rows on a test camera, as warnings at most: nothing but its own numbers depends on it."""
    return [replace(r, fail=None, verdict="warn" if r.verdict == "fail" else r.verdict) for r in rows]


def of_test(name: str, rows: Iterable[HealthRow]) -> list[HealthRow]:
    """Rows on a test camera, whose titles name it."""
    return [r if name in r.check else replace(r, check=f"{r.check}, test camera {name}") for r in rows]


def left_out_row(name: str, why: str) -> HealthRow:
    """A test camera that cannot be measured with; everything else is as without it."""
    return note(f"test camera {name}", "left out", remedy=f"Nothing is measured with {name}: {why}")


def listed(told: Callable[Of, Iterator[HealthRow]]) -> Callable[Of, list[HealthRow]]:
    """A function that yields rows, as one that returns them."""

    @wraps(told)
    def rows(*args: Of.args, **named: Of.kwargs) -> list[HealthRow]:
        return list(told(*args, **named))

    return rows


def worst(verdicts: Iterable[Verdict | None]) -> Verdict | None:
    """The worst of several verdicts; None where there are none."""
    found = set(verdicts)
    return "fail" if "fail" in found else "warn" if "warn" in found else "ok" if "ok" in found else None
