"""One self-contained HTML page about a run: what was filmed, calibrated, trained and measured.

The page needs no network and no other file; it quotes numbers, and links each to the file it stands in.
It is made from whatever the run folder holds: a section without content says why. Nothing is computed
here that a stage did not measure. A section is a template of its key and, here, what a template cannot make:
drawings and pictures.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Any

from devrf.pipelines.report.calibration_section import calibration
from devrf.pipelines.report.capture_section import capture, colours
from devrf.pipelines.report.curves import clocks, training
from devrf.pipelines.report.data_uris import data_uri, file_uri
from devrf.pipelines.report.flow_section import flow
from devrf.pipelines.report.run_reader import METRICS, RunFolder
from devrf.pipelines.report.templates import render
from devrf.pipelines.report.views_section import views

logger = logging.getLogger(__name__)

MAX_PAGE_BYTES = 15_000_000  # what can still be sent by mail
ROOMS = (1.0, 0.5, 0.25, 0.1)  # shares of the usual pictures, tried one after the other
POSTER_WIDTH = 800
MAX_FILM_BYTES = 8_000_000  # base64 makes it a third larger; a bigger film is linked instead
SECTIONS: tuple[tuple[str, str, Callable[[RunFolder], dict[str, Any]]], ...] = (
    ("capture", "Capture", capture),
    ("rig", "Cameras", calibration),
    ("colour", "Colours", colours),
    ("sync", "Clocks", clocks),
    ("flow", "Flow", flow),
    ("training", "Training", training),
    ("views", "Views", views),
    ("confidence", "Confidence", lambda run: {}),
)


def build_report(run: RunFolder, name: str, facts: Sequence[str] = ()) -> str:
    """The page as one text, below MAX_PAGE_BYTES: the film goes first, then pictures become fewer and smaller.

    Args:
        run: The run folder.
        name: Name of the scene, as the user wrote it.
        facts: A few words for the line under the title (preset, device, ...).
    """
    html = ""
    for run.film_inside, run.room in ((True, ROOMS[0]), *((False, room) for room in ROOMS)):
        html = _page(run, name, facts)
        if len(html.encode()) <= MAX_PAGE_BYTES:
            break
    return html


def _page(run: RunFolder, name: str, facts: Sequence[str]) -> str:
    sections = [_made(run, *section) for section in SECTIONS]
    values = {"run": run, "METRICS": METRICS, "name": name, "facts": facts}
    top = render("summary.html", values | _summary(run))  # after the sections: it also names unreadable files
    values |= {"title": f"{name}: run report", "summary": top, "max_bytes": MAX_PAGE_BYTES}
    return render("page.html", values | {"sections": sections})


def _made(
    run: RunFolder, key: str, title: str, make: Callable[[RunFolder], dict[str, Any]]
) -> dict[str, Any]:
    """A section and the stages that it drew on; where a damaged file breaks it, that is said and the others stand."""
    run.drawn_on.clear()
    try:
        html = render(f"{key}.html", {"run": run, "METRICS": METRICS} | make(run))
    except Exception as error:
        logger.exception("report: section %s", key)
        html = render("broken.html", {"error": f"{type(error).__name__}: {error}"})
    stages = [s for s in run.stages if s in run.drawn_on and run.object(f"{s}/stamp.json")]
    return {"key": key, "title": title, "html": html, "stages": stages}


def _summary(run: RunFolder) -> dict[str, Any]:
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
    found = {"checks": checks, "to_do": [*bad, *doubtful], "missing": missing, "film": _film(run)}
    return {"kind": kind, "line": line, **found}


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
