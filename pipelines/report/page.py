"""One self-contained HTML page about a run: what was filmed, calibrated, trained and measured.

The page needs no network and no other file; it quotes numbers, and links each to the file it stands in.
It is made from whatever the run folder holds: a section without content says why. Nothing is computed
here that a stage did not measure.
"""

import logging
from collections.abc import Callable, Sequence

from devrf.pipelines.report.calibration import rig_section
from devrf.pipelines.report.capture import capture_section
from devrf.pipelines.report.clocks import sync_section
from devrf.pipelines.report.colour import colour_section
from devrf.pipelines.report.confidence import confidence_section
from devrf.pipelines.report.evidence import evidence_section
from devrf.pipelines.report.flow import flow_section
from devrf.pipelines.report.html import absent, asset, page, section, text
from devrf.pipelines.report.run import RunFolder
from devrf.pipelines.report.space import space_section
from devrf.pipelines.report.speed import speed_section
from devrf.pipelines.report.stability import stability_section
from devrf.pipelines.report.summary import METRICS, film, making, stages_table, tiles, verdict
from devrf.pipelines.report.training import training_section
from devrf.pipelines.report.views import views_section

logger = logging.getLogger(__name__)

MAX_PAGE_BYTES = 15_000_000  # what can still be sent by mail
ROOMS = (1.0, 0.5, 0.25, 0.1)  # shares of the usual pictures, tried one after the other
SECTIONS = (  # key, title, what makes it
    ("capture", "Capture", capture_section),
    ("space", "Cameras in space", space_section),
    ("rig", "Rig", rig_section),
    ("evidence", "Evidence", evidence_section),
    ("colour", "Colours", colour_section),
    ("sync", "Clocks", sync_section),
    ("flow", "Flow", flow_section),
    ("training", "Training", training_section),
    ("views", "Views", views_section),
    ("confidence", "Confidence", confidence_section),
)
OPTIONAL = (  # only where it has been measured: by `bench`, not by a stage
    ("speed", "Speed", speed_section),
    ("stability", "Stability", stability_section),
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
    made = [(key, title, _made(run, key, title, make)) for key, title, make in (*SECTIONS, *OPTIONAL)]
    made = [(key, title, html) for key, title, html in made if html]
    sections = "".join(html for _, _, html in made)
    facts_line = f'<p class="sub">{text(" · ".join(facts))}</p>'
    numbers = f'<div class="hero">{tiles(run)}{film(run)}</div>{stages_table(run)}'
    nav = "".join(f'<a href="#{key}">{text(title)}</a>' for key, title, _ in (("top", "Summary", ""), *made))
    top = (
        f'<header id="top"><p class="kind">Run report</p><h1>{text(name)}</h1>'
        f"{facts_line}{verdict(run)}{numbers}</header>"  # the verdict last: it also names unreadable files
    )
    return page(
        f"{name}: run report",
        f'<nav aria-label="Sections"><div>{nav}</div></nav>{top}<main>{sections}</main>{_footer(run)}'
        f"<script>{asset('slider.js')}</script><script>{asset('space.js')}</script>",
    )


def _made(run: RunFolder, key: str, title: str, make: Callable[[RunFolder], str]) -> str:
    """A section; where a damaged file breaks it, that is said and the rest of the page stands."""
    run.drawn_on.clear()
    try:
        return _traced(run, make(run))
    except Exception as error:
        logger.exception("report: section %s", key)
        reason = f"This section cannot be made: {type(error).__name__}: {error}"
        return section(key, title, "", absent(reason))


def _traced(run: RunFolder, html: str) -> str:
    """A section and, below it, when and in which run the stages were made that it drew on."""
    stages = [stage for stage in run.stages if stage in run.drawn_on]
    made = [text for stage in stages if (text := making(run, stage))]
    if not html or not made:
        return html
    return f'<div data-stages="{" ".join(stages)}">{html}<p class="source made">From {"; ".join(made)}.</p></div>'


def _footer(run: RunFolder) -> str:
    metrics = run.object(METRICS)
    versions = metrics.get("versions")
    words = [f"{k} {v}" for k, v in versions.items()] if isinstance(versions, dict) else []
    if metrics.get("seed") is not None:
        words.append(f"seed {metrics['seed']}")
    line = f"{text(' · '.join(words))}. " if words else ""
    less = "" if run.film_inside else " The film is linked, not in the page"
    less += ", and pictures are fewer and smaller than usual" if run.room < ROOMS[0] else ""
    kept = f"{less}, to keep it below {MAX_PAGE_BYTES / 1e6:.0f} MB." if less else ""
    return (
        f"<footer>{line}Dotted numbers lead to the file they stand in, in the folder of its stage, as long as this "
        f"page lies in the run folder.{kept}</footer>"
    )
