"""Confidence for the report: how many cameras see the subject's surface, and so what a crew should film more."""

from typing import Any

from devrf.pipelines.report.run import METRICS, RunFolder


def confidence(run: RunFolder) -> dict[str, Any]:
    """Shares of the subject by how many cameras see it."""
    found = run.object(METRICS, "confidence")
    return {"found": found, "seen_by": run.objects(METRICS, "confidence", "seen_by")}
