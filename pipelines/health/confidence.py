"""Whether what was filmed tells enough of the subject, as rows."""

from typing import Any

from devrf.pipelines.health.rows import HealthRow, row

MOST_LOW = 0.5  # of the subject: a model that is doubtful in most of it is doubtful
NAMED = 2  # regions in the remedy


def confidence_rows(confidence: dict[str, Any]) -> list[HealthRow]:
    """A row about how much of the subject is expected to look wrong.

    Args:
        confidence: The block of evaluate/metrics.json.
    """
    low = confidence["low_share"]
    worst = list(dict.fromkeys(region["where"] for region in confidence["regions"]))[:NAMED]
    parts = f" (worst as seen by {confidence['as_seen_by']}: {'; '.join(worst)})" if worst else ""
    return [
        row(
            "share of the subject with low confidence "
            f"(expected error above {confidence['low_above']:.0f} grey levels, from all directions of the sweep)",
            None if low is None else 100 * low,
            "%",
            warn=100 * MOST_LOW,
            low_is_bad=False,
            remedy=f"Most of the subject{parts} is badly seen or badly explained: let more cameras see it from further "
            "apart, sweep it closer, and check rig, clocks and flow in the report.",
        )
    ]
