"""Whether what was filmed tells enough of the subject, as rows."""

from typing import Any

from devrf.pipelines.health.rows import HealthRow, note, row

MOST_LOW = 0.5  # of the subject: a model that is doubtful in most of it is doubtful
MOST_UNSEEN = 0.5  # of what moves: more of the motion is a guess than is known


def confidence_rows(confidence: dict[str, Any]) -> list[HealthRow]:
    """Rows about how much of the subject is expected to look wrong, and how much of its motion nobody filmed.

    Args:
        confidence: The block of evaluate/metrics.json.
    """
    low = (
        "share of the subject with low confidence "
        f"(expected error above {confidence['low_above']:.0f} grey levels, from all directions of the sweep)"
    )
    if confidence["low_share"] is None:
        nothing = (
            "The model shows nothing solid in the box: see that it holds the subject and poses are right."
        )
        return [note(low, "nothing solid is seen in the box", remedy=nothing)]
    badly_seen = (
        "Most of the subject is badly seen or badly explained: let more cameras see it from further apart, sweep it "
        "closer, and check rig, clocks and flow in the report."
    )
    rows = [_share(low, confidence["low_share"], MOST_LOW, badly_seen)]
    if confidence["unseen_share"] is not None:
        unseen = "moving surface that no camera sees (from all directions of the sweep)"
        guess = (
            "How most of it moves is a guess: spread the cameras around the subject, or look at it from where they "
            "stand only."
        )
        rows.append(_share(unseen, confidence["unseen_share"], MOST_UNSEEN, guess))
    return rows


def _share(check: str, share: float, most: float, remedy: str) -> HealthRow:
    return row(check, 100 * share, "%", warn_above=100 * most, remedy=remedy)
