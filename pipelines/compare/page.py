"""One self-contained page about several runs: measures side by side, what their differences are worth, and why."""

from collections.abc import Mapping, Sequence
from typing import Any

from devrf.pipelines.compare.differing import (
    ABSENT,
    differing_code,
    differing_config,
    differing_health,
    differing_versions,
    stage_times,
)
from devrf.pipelines.compare.measures import Difference, Measure, SeedDifference, repeats, value_of
from devrf.pipelines.compare.result import Comparison
from devrf.pipelines.compare.runs import METRICS, ComparedRun
from devrf.pipelines.compare.views import views_section
from devrf.pipelines.report.html import absent, asset, number, page, readable, section, table, text
from devrf.pipelines.report.page import MAX_PAGE_BYTES, ROOMS
from devrf.pipelines.report.run import at
from devrf.reconstruct.paired import CONFIDENCE
from devrf.reconstruct.paired_views import BLOCKS

WORDS = {"better": "better", "worse": "worse", "open": "cannot be told apart", "same": "the same"}
KINDS = {"better": "ok", "worse": "fail", "open": "", "same": ""}
MEASURES_LEAD = (
    f"Every run against the first. A difference is a mean over the same views with its {100 * CONFIDENCE:.0f} % "
    f"interval, from {BLOCKS} stretches of time, because pictures of neighbouring moments are alike. It says what "
    "other moments like these would show, of this scene and these cameras; it does not know what another seed would "
    "change."
)


def build_page(found: Comparison) -> str:
    """The page as one text, its pictures fewer and smaller where it would be larger than MAX_PAGE_BYTES."""
    html = ""
    for room in ROOMS:
        html = _page(found, room)
        if len(html.encode()) <= MAX_PAGE_BYTES:
            break
    return html


def said(difference: Difference | SeedDifference) -> str:
    """The difference and its interval in words without a unit: "+0.53 ± 0.21"."""
    gain, digits = difference.gain, difference.measure.digits
    mean = f"{'+' if gain.mean > 0 else ''}{readable(gain.mean, digits)}"
    return mean if gain.half is None else f"{mean} ± {readable(gain.half, digits)}"


def judged(difference: Difference | SeedDifference) -> str:
    """What it is worth, in words."""
    if difference.verdict is not None:
        return WORDS[difference.verdict]
    if isinstance(difference, Difference) and difference.views == 0:
        return ""  # one number of each run: there is nothing to judge it by
    return "too few independent moments"


def _page(found: Comparison, room: float) -> str:
    names = [run.name for run in found.runs]
    sections = (
        ("measures", "Measures", _measures(found)),
        ("views", "Views", views_section(found, room)),
        ("seeds", "Seeds", _seeds(found)),
        ("config", "Configuration", _config(found)),
        ("code", "Code and libraries", _code(found)),
        ("stages", "Stages", _stages(found)),
        ("health", "Health", _health(found)),
    )
    nav = "".join(f'<a href="#{key}">{title}</a>' for key, title, html in sections if html)
    top = (
        '<header id="top"><p class="kind">Comparison</p>'
        f"<h1>{text(' · '.join(names))}</h1>{_limits(found)}{_runs(found)}</header>"
    )
    body = "".join(html for _, _, html in sections)
    less = (
        f" Its pictures are fewer and smaller than usual, to keep it below {MAX_PAGE_BYTES / 1e6:.0f} MB."
        if room < ROOMS[0]
        else ""
    )
    footer = (
        "<footer>Dotted numbers lead to the file they stand in, as long as this page and the runs keep their "
        f"places.{less}</footer>"
    )
    return page(
        f"{', '.join(names)}: comparison",
        f'<nav aria-label="Sections"><div><a href="#top">Summary</a>{nav}</div></nav>{top}<main>{body}</main>{footer}'
        f"<script>{asset('slider.js')}</script>",
    )


def _limits(found: Comparison) -> str:
    """What stands against comparing these runs, before anything is read out of them."""
    lines = [*found.not_compared.values(), *found.notes]
    if not lines:
        return ""
    kind = "fail" if found.not_compared else "warn"
    what = "Not everything can be compared." if found.not_compared else "The comparison has limits."
    return (
        f'<div class="verdict {kind}"><strong>{what}</strong><ul>'
        + "".join(f"<li>{text(line)}</li>" for line in lines)
        + "</ul></div>"
    )


def _runs(found: Comparison) -> str:
    rows = []
    for run in found.runs:
        report = "report/index.html"
        has_report = (run.folder.path / report).is_file()
        finished = at(run.stamps.get("evaluate"), "finished")
        rows.append(
            [
                f"<strong>{text(run.name)}</strong>",
                found.link(run, report) if has_report else found.link(run, METRICS),
                text(run.config.get("preset") or ABSENT),
                number(run.metrics.get("seed"), "", 0, file=found.file(run, METRICS), key="seed"),
                text(finished or ABSENT),
                text(at(run.metrics, "versions.devrf") or ABSENT),
            ]
        )
    return table(("run", "files", "preset", "seed", "evaluated", "devrf"), rows, numeric=(3,))


def _measures(found: Comparison) -> str:
    base, *others = found.runs
    rows = []
    for measure in found.measures:
        cells = [text(measure.name), _value(found, base, measure)]
        for run in others:
            difference = found.of(run, measure)
            cells.append(_value(found, run, measure) + ("" if difference is None else _told(difference)))
        rows.append(cells)
    head = ("", *(run.name for run in found.runs))
    views = {d.views for d in found.differences if d.views}
    count = sum(d.verdict is not None for d in found.differences)
    chance = (
        f"{count} differences have an interval of their own: where nothing differs, about one in twenty would still "
        "look like something. "
        if count
        else ""
    )
    over = f"Over {' or '.join(str(n) for n in sorted(views))} views. " if views else ""
    note = (
        f'<p class="source">{over}{chance}Times are of whatever device and load each run had. '
        f"{'; '.join(found.link(run, METRICS) for run in found.runs)}</p>"
    )
    return section(
        "measures", "Measures", MEASURES_LEAD, table(head, rows, numeric=range(1, len(head))) + note
    )


def _value(found: Comparison, run: ComparedRun, measure: Measure) -> str:
    block, _, name = measure.key.rpartition(".")
    why = str(at(run.metrics, f"{block}.why.{name}") or "")
    file = found.file(run, METRICS)
    return number(
        at(run.metrics, measure.key), measure.unit, measure.digits, file=file, key=measure.key, why=why
    )


def _told(difference: Difference) -> str:
    words = judged(difference)
    chip = f' <span class="chip {KINDS.get(difference.verdict or "", "")}">{words}</span>' if words else ""
    return f'<div class="gain">{said(difference)}{chip}</div>'


def _seeds(found: Comparison) -> str:
    """Repeated runs: what another seed changes, and whether groups differ by more than that."""
    groups = [group for group in repeats(found.runs) if len(group) > 1]
    if not groups:
        return ""
    lead = (
        "Runs that differ in nothing but their seed. Two such groups are compared seed by seed, with Student's "
        "interval of the differences: what training again with other seeds would show."
    )
    spread = []
    for group in groups:
        for measure in found.measures:
            values = [value for run in group if (value := value_of(run, measure)) is not None]
            if len(values) == len(group):
                low, high = (readable(value, measure.digits) for value in (min(values), max(values)))
                name = ", ".join(run.name for run in group)
                spread.append([text(name), text(measure.name), f"{low} to {high} {text(measure.unit)}"])
    rows = [
        [
            text(f"{', '.join(d.groups[1])} against {', '.join(d.groups[0])}"),
            text(d.measure.name),
            f"{said(d)} {text(d.measure.unit)}",
            text(judged(d)),
        ]
        for d in found.by_seed
    ]
    files = "; ".join(found.link(run, METRICS) for group in groups for run in group)
    body = table(("runs", "measure", "from the lowest to the highest"), spread)
    body += table(("groups", "measure", f"difference, {100 * CONFIDENCE:.0f} %", ""), rows)
    return section("seeds", "Seeds", lead, f'{body}<p class="source">{files}</p>')


def _config(found: Comparison) -> str:
    lead = "Keys that are not the same in all runs, as the stages were given them."
    unknown = [run.name for run in found.runs if not run.config]
    said_of = f"<p>Not known of {text(', '.join(unknown))}: no stamps.</p>" if unknown else ""
    return _differing(
        found, "config", "Configuration", lead, differing_config(found.runs), "evaluate/stamp.json", said_of
    )


def _code(found: Comparison) -> str:
    lead = (
        "Versions that differ, and files of code that are not the first run's, by the stage they worked in."
    )
    rows = {**differing_versions(found.runs), **differing_code(found.runs)}
    return _differing(found, "code", "Code and libraries", lead, rows, METRICS)


def _differing(
    found: Comparison,
    key: str,
    title: str,
    lead: str,
    rows: Mapping[str, Sequence[str]],
    file: str,
    more: str = "",
) -> str:
    head = ("", *(run.name for run in found.runs))
    cells = [[f"<code>{text(name)}</code>", *map(text, values)] for name, values in rows.items()]
    files = f'<p class="source">{"; ".join(found.link(run, file) for run in found.runs)}</p>'
    body = table(head, cells) + files if rows else absent("Nothing differs.")
    return section(key, title, lead, more + body)


def _stages(found: Comparison) -> str:
    lead = (
        "Seconds that each stage took when it was made; a stage taken over from a run before keeps its time."
    )
    rows = []
    for stage, seconds in stage_times(found.runs).items():
        cells = [text(stage)]
        for run, value in zip(found.runs, seconds, strict=True):
            file = found.file(run, f"{stage}/stamp.json")
            cells.append(ABSENT if value is None else number(value, "s", 1, file=file, key="seconds"))
        rows.append(cells)
    head = ("stage", *(run.name for run in found.runs))
    body = table(head, rows, numeric=range(1, len(head)))
    return section("stages", "Stages", lead, body or absent("No stage says how long it took."))


def _health(found: Comparison) -> str:
    lead = "Checks whose verdict is not the same in all runs."
    rows = [
        [
            text(stage),
            text(check),
            *(
                ABSENT if row is None else _checked(found, run, stage, row)
                for run, row in zip(found.runs, shown, strict=True)
            ),
        ]
        for (stage, check), shown in differing_health(found.runs).items()
    ]
    head = ("stage", "check", *(run.name for run in found.runs))
    return section(
        "health", "Health", lead, table(head, rows) or absent("All verdicts are the same in all runs.")
    )


def _checked(found: Comparison, run: ComparedRun, stage: str, placed: tuple[int, dict[str, Any]]) -> str:
    place, row = placed
    value, file = row.get("value"), found.file(run, f"{stage}/health.json")
    shown = (
        text(value)
        if isinstance(value, str)
        else number(value, str(row.get("unit") or ""), 3, file=file, key=f"rows.{place}.value")
    )
    verdict = text(row.get("verdict", ""))
    return f'{shown} <span class="chip {verdict}">{verdict}</span>'
