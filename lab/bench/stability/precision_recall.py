"""How well the pipeline knows: precision and recall of what it says over the whole suite.

Recall asks the axes: of those that break, at how many does the pipeline speak up at or before the failure point?
Precision asks the cases: of those in which something new is said, in how many has the result really suffered? A case
that was stopped has said so, and has. Where all that is new is that training mended something, the damage is real, and
an unharmed result is what mending is for: such a case is not asked. A complaint below the failure point of an axis is
what recall asks for; where the result has not suffered yet, it counts against precision, and is named early.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from devrf.lab.bench.stability.case import Result
from devrf.lab.bench.stability.points import LEAST_GAIN_DB, Points, new_complaints, said
from devrf.pipelines.health.training_rows import MENDED

# lost where it moves: half of what motion must gain; other seeds differ by less
SUFFERED_DB = LEAST_GAIN_DB / 2


@dataclass(frozen=True)
class PrecisionRecall:
    """What is said over the whole suite, against what happens.

    Attributes:
        broken: Axes with a failure point.
        missed: Those of them at which nothing is said up to there.
        spoken: Cases in which something is said that the undisturbed case does not say, more than that training
            mended something: "axis severity, seed".
        unfounded: Those of them that lost less than `SUFFERED_DB`.
        early: Those of these whose axis breaks at a greater severity.
        alarms: What is said of the undisturbed cases themselves.
    """

    broken: tuple[str, ...]
    missed: tuple[str, ...]
    spoken: tuple[str, ...]
    unfounded: tuple[str, ...]
    early: tuple[str, ...]
    alarms: tuple[str, ...]

    @property
    def recall(self) -> float | None:
        """Share of the broken axes that are noticed in time; None where none breaks."""
        return 1 - len(self.missed) / len(self.broken) if self.broken else None

    @property
    def precision(self) -> float | None:
        """Share of the cases with complaints that suffered; None where there are none."""
        return 1 - len(self.unfounded) / len(self.spoken) if self.spoken else None

    @property
    def precision_or_early(self) -> float | None:
        """The same, a complaint before the axis breaks counted as right."""
        wrong = len(self.unfounded) - len(self.early)
        return 1 - wrong / len(self.spoken) if self.spoken else None


def heard(
    results: Mapping[str, Sequence[Result]], undisturbed: Sequence[Result], found: Mapping[str, Points]
) -> PrecisionRecall:
    """Compare what is said with what happens.

    Args:
        results: Axis -> its cases, every severity and seed.
        undisturbed: One for every seed.
        found: Axis -> its failure and notice point.
    """
    of_seed = {r.seed: r for r in undisturbed}
    broken = tuple(name for name in results if found[name].failure is not None)
    cases = [r for of_axis in results.values() for r in of_axis]
    spoken = [r for r in cases if _warns(r, of_seed[r.seed])]
    unfounded = [r for r in spoken if not _suffered(r, of_seed[r.seed])]
    return PrecisionRecall(
        broken=broken,
        missed=tuple(name for name in broken if not _in_time(found[name])),
        spoken=tuple(_called(r) for r in spoken),
        unfounded=tuple(map(_called, unfounded)),
        early=tuple(_called(r) for r in unfounded if _breaks_later(r, found[r.axis])),
        alarms=tuple(dict.fromkeys(words for r in undisturbed for words in said(r, None))),
    )


def _in_time(found: Points) -> bool:
    return found.failure is not None and found.notice is not None and found.notice <= found.failure


def _breaks_later(result: Result, found: Points) -> bool:
    return found.failure is not None and found.failure > result.severity


def _warns(result: Result, undisturbed: Result) -> bool:
    """Whether it was stopped, or something new is said that training did not mend."""
    new = new_complaints(result, undisturbed)
    return result.stopped is not None or not all(c.code in MENDED for c in new)


def _suffered(result: Result, undisturbed: Result) -> bool:
    """Whether it is clearly worse; where test views show something else, by what motion gains in them."""
    was, now = undisturbed.psnr_moving, result.psnr_moving
    if result.stopped is not None or was is None or now is None:
        return True
    if result.films_anew and undisturbed.baseline is not None and result.baseline is not None:
        was, now = was - undisturbed.baseline, now - result.baseline
    return was - now >= SUFFERED_DB


def _called(result: Result) -> str:
    return f"{result.axis} {result.severity:g}, seed {result.seed}"
