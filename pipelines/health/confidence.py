"""Whether cameras see enough of the subject, as rows."""

from typing import Any

from devrf.pipelines.health.rows import HealthRow, note, row

MOST_UNSEEN = 0.5  # of what moves: more of the motion is a guess than is known


def confidence_rows(confidence: dict[str, Any]) -> list[HealthRow]:
    """Rows about a box that shows nothing, and about how much of the subject's motion nobody filmed.

    Args:
        confidence: The block of evaluate/metrics.json.
    """
    if not confidence["seen_by"]:
        nothing = (
            "The model shows nothing solid in the box: see that it holds the subject and poses are right."
        )
        return [note("surface in the box (from all directions of the sweep)", "none is seen", remedy=nothing)]
    if confidence["unseen_share"] is None:
        return []
    return [
        row(
            "moving surface that no camera sees (from all directions of the sweep)",
            100 * confidence["unseen_share"],
            "%",
            warn_above=100 * MOST_UNSEEN,
            remedy="How most of it moves is a guess: spread the cameras around the subject, or look at it from where "
            "they stand only.",
        )
    ]
