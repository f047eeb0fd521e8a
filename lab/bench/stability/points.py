"""Where on an axis the result breaks, and where the pipeline first says so."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from devrf.lab.bench.stability.case import Complaint, Result
from devrf.pipelines.health.judge import warns_at

WORSE = {"warn": 1, "fail": 2}
LEAST_GAIN_DB = warns_at("views-gain")  # motion that gains less is not worth its name


@dataclass(frozen=True)
class Points:
    """What becomes of an axis.

    Attributes:
        failure: The first severity at which the result is no better than standing still; None: at none.
        notice: The first severity at which a health row or a message speaks up; None: at none.
        notices: What is said there: stage and check, or what stopped the run.
        lessened: The severity below the failure point; 0 for no damage at all, None where nothing fails.
        lessened_db: PSNR where it moves there: what becomes of the result when the damage is lessened.
    """

    failure: float | None
    notice: float | None
    notices: tuple[str, ...] = ()
    lessened: float | None = None
    lessened_db: float | None = None


def bar_db(undisturbed: Sequence[Result]) -> float | None:
    """PSNR where it moves that a result needs: what the undisturbed scene at rest has, and a gain worth its name.

    It is the undisturbed case's, so that damage to the scene at rest does not lower it. None where the undisturbed
    result itself is below: then nothing can be said of others.
    """
    baselines = [r.baseline for r in undisturbed if r.baseline is not None]
    reached = [r.psnr_moving for r in undisturbed if r.psnr_moving is not None]
    if not baselines or not reached:
        return None
    bar = fmean(baselines) + LEAST_GAIN_DB
    return bar if fmean(reached) >= bar else None


def fails(result: Result, bar: float | None) -> bool:
    """Whether a result is worth nothing: there is none, or it is below the bar.

    Where test views show something else than the undisturbed ones, the bar is that of their own scene at rest.
    """
    if result.stopped is not None:
        return True
    if result.films_anew and bar is not None:
        bar = None if result.baseline is None else result.baseline + LEAST_GAIN_DB
    return bar is not None and (result.psnr_moving is None or result.psnr_moving < bar)


def new_complaints(result: Result, undisturbed: Result) -> tuple[Complaint, ...]:
    """What is said of a case that is not said, or is said less loudly, of the undisturbed one."""
    before: dict[tuple[str, str], int] = {}
    for c in undisturbed.complaints:
        before[_kind(c)] = max(WORSE[c.verdict], before.get(_kind(c), 0))
    return tuple(c for c in result.complaints if WORSE[c.verdict] > before.get(_kind(c), 0))


def _kind(complaint: Complaint) -> tuple[str, str]:
    """Stage and code: the same complaint about another camera is no new one."""
    return complaint.stage, complaint.code


def said(result: Result, undisturbed: Result | None) -> tuple[str, ...]:
    """The same in words, what stopped the run first; everything, where there is nothing to compare with."""
    stopped = () if result.stopped is None else (f"stopped by {result.stopped}",)
    complaints = result.complaints if undisturbed is None else new_complaints(result, undisturbed)
    return (*stopped, *(f"{c.stage}: {c.check}" for c in complaints))


def points(results: Sequence[Result], undisturbed: Sequence[Result]) -> Points:
    """The failure and the notice point of one axis: where at least half of the seeds fail, or say something new.

    Args:
        results: Of one axis, every severity and seed.
        undisturbed: One for every seed.
    """
    bar, of_seed = bar_db(undisturbed), {r.seed: r for r in undisturbed}
    failure = notice = lessened = lessened_db = None
    notices: tuple[str, ...] = ()
    below = undisturbed
    for severity in sorted({r.severity for r in results}):
        cases = [r for r in results if r.severity == severity]
        failed = [r for r in cases if fails(r, bar)]
        spoken = [words for r in cases if (words := said(r, of_seed[r.seed]))]
        if failure is None and 2 * len(failed) >= len(cases):
            failure, lessened_db = severity, _mean_db(below)
            lessened = below[0].severity
        if notice is None and 2 * len(spoken) >= len(cases):
            notice, notices = severity, tuple(dict.fromkeys(word for words in spoken for word in words))
        below = cases
    return Points(failure, notice, notices, lessened, lessened_db)


def _mean_db(cases: Sequence[Result]) -> float | None:
    reached = [r.psnr_moving for r in cases if r.psnr_moving is not None]
    return fmean(reached) if reached else None
