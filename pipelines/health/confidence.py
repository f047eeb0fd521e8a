"""Whether what was filmed tells enough of the subject, as rows."""

from typing import Any

from devrf.pipelines.health.rows import HealthRow, note, row

MOST_LOW = 0.5  # of the subject: a model that is doubtful in most of it is doubtful
MOST_UNSEEN = 0.5  # of what moves: more of the motion is a guess than is known
NAMED = 2  # regions in the remedy


def confidence_rows(confidence: dict[str, Any]) -> list[HealthRow]:
    """Rows about how much of the subject is expected to look wrong, and how much of its motion nobody filmed.

    Args:
        confidence: The block of evaluate/metrics.json.
    """
    check = (
        "share of the subject with low confidence "
        f"(expected error above {confidence['low_above']:.0f} grey levels, from all directions of the sweep)"
    )
    if confidence["low_share"] is None:
        nothing = (
            "The model shows nothing solid in the box: see that it holds the subject and poses are right."
        )
        return [note(check, "nothing solid is seen in the box", verdict="warn", remedy=nothing)]
    worst = list(dict.fromkeys(region["where"] for region in confidence["regions"]))[:NAMED]
    parts = f" (worst as seen by {confidence['as_seen_by']}: {'; '.join(worst)})" if worst else ""
    rows = [
        row(
            check,
            100 * confidence["low_share"],
            "%",
            warn=100 * MOST_LOW,
            low_is_bad=False,
            remedy=f"Most of the subject{parts} is badly seen or badly explained: let more cameras see it from further "
            "apart, sweep it closer, and check rig, clocks and flow in the report.",
        )
    ]
    if confidence["unseen_share"] is not None:
        rows.append(
            row(
                "moving surface that no camera sees (from all directions of the sweep)",
                100 * confidence["unseen_share"],
                "%",
                warn=100 * MOST_UNSEEN,
                low_is_bad=False,
                remedy=f"How most of it{parts} moves is a guess: spread the cameras around the subject, or look at it "
                "from where they stand only.",
            )
        )
    return rows
