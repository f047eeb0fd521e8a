"""The top of the report: one verdict with its remedies, and the film."""

from typing import Any

from devrf.pipelines.report.pictures import data_uri, file_uri
from devrf.pipelines.report.run import RunFolder

POSTER_WIDTH = 800
MAX_FILM_BYTES = 8_000_000  # base64 makes it a third larger; a bigger film is linked instead


def summary(run: RunFolder) -> dict[str, Any]:
    """The verdict of all health rows (`kind`: ok, warn or fail), what is to be done, what is missing, and the film."""
    checks = [(stage, n, row) for stage in run.stages for n, row in enumerate(run.health(stage))]
    bad, doubtful = ([c for c in checks if c[2].get("verdict") == kind] for kind in ("fail", "warn"))
    missing = [s for s in run.stages if s not in ("report", *run.reasons, *run.errors) and not run.has(s)]
    for stage in run.stages:
        run.json(f"{stage}/stamp.json")  # so that damaged ones are known when the verdict is written
    if bad:
        kind, line = "fail", f"{len(bad)} of {len(checks)} checks failed: do not trust this result."
    elif run.errors:
        kind, line = "fail", f"Stopped: {', '.join(run.errors)} failed."
    elif doubtful:
        kind, line = "warn", f"{len(doubtful)} of {len(checks)} checks warn; the others passed."
    elif checks:
        kind, line = "warn" if missing or run.stale else "ok", f"All {len(checks)} checks passed."
    else:
        kind, line = "warn", "No stage has checked its result yet."
    to_do = [*bad, *doubtful]
    return {
        "kind": kind,
        "line": line,
        "checks": checks,
        "to_do": to_do,
        "missing": missing,
        "film": _film(run),
    }


def _film(run: RunFolder) -> dict[str, Any] | None:
    """The rendered film: inside the page where it is small enough, else linked."""
    films = sorted((run.path / "render").glob("*.mp4"))
    if not films:
        return None
    small = run.film_inside and films[0].stat().st_size <= MAX_FILM_BYTES
    return {
        "files": [f"render/{film.name}" for film in films],
        "source": data_uri(films[0].read_bytes(), "video/mp4") if small else f"../render/{films[0].name}",
        "poster": file_uri(run.path / "render/poster.png", POSTER_WIDTH),
    }
