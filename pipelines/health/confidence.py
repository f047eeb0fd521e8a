"""Whether cameras see enough of the subject."""

from typing import Any

from devrf.capture.measure import Measure


def confidence_measures(confidence: dict[str, Any]) -> list[Measure]:
    """A box that shows nothing, or how much of the subject's motion nobody filmed.

    Args:
        confidence: The block of evaluate/metrics.json.
    """
    if not confidence["seen_by"]:
        return [Measure("surface-unseen", "no surface is seen in the box", why="nothing")]
    unseen = confidence["unseen_share"]
    return [] if unseen is None else [Measure("surface-unseen", 100 * unseen)]
