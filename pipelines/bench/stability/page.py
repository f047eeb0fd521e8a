"""One page with what the suite found: a table of all axes, then each axis with its chart and its cases."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from devrf.pipelines.bench.stability.axes import AXES
from devrf.pipelines.bench.stability.case import Result
from devrf.pipelines.bench.stability.heard import SUFFERED_DB, Heard
from devrf.pipelines.bench.stability.points import Points, said
from devrf.pipelines.report.html import figure, page, readable, section, table, text
from devrf.pipelines.report.pictures import data_uri


def build_page(
    title: str,
    undisturbed: Sequence[Result],
    results: Mapping[str, Sequence[Result]],
    found: Mapping[str, Points],
    known: Heard,
    overview_chart: Path,
    charts: Mapping[str, Path],
    left_out: Mapping[str, str],
) -> str:
    """The page as one text.

    Args:
        title: What was damaged, in words.
        undisturbed: The undisturbed case of every seed.
        results: Axis -> its cases.
        found: Axis -> its failure and notice point.
        known: Precision and recall of what is said.
        overview_chart: Of all axes.
        charts: Axis -> its chart.
        left_out: Axis and severity -> why it was not measured.
    """
    overview = table(
        ("axis", "what gets worse", "breaks at", "said at", "unit", "one step less", "what is said there"),
        [
            (
                f'<a href="#{text(name)}">{text(name)}</a>',
                text(AXES[name].what),
                _severity(found[name].failure),
                _severity(found[name].notice),
                text(AXES[name].unit),
                text(_lessened(found[name])),
                "<br>".join(text(words) for words in found[name].notices),
            )
            for name in results
        ],
    )
    not_there = "".join(f'<p class="source">{text(n)}: {text(why)}</p>' for n, why in left_out.items())
    lead = (
        "A result breaks where half of its seeds are stopped, or gain less over the undisturbed scene at rest than "
        "motion must. Said: a health row that the undisturbed case does not show and that needs no test view."
    )
    image = data_uri(overview_chart.read_bytes(), "image/png")
    picture = figure(image, "", "PSNR where it moves, along every axis") if results else ""
    body = section("overview", "Where it breaks", lead, _heard(known) + picture + overview + not_there)
    body += section("undisturbed", "Undisturbed", "The same scene without damage.", _cases(undisturbed, ()))
    for name, cases in results.items():
        image = data_uri(charts[name].read_bytes(), "image/png")
        picture = figure(image, text(f"Severity: {AXES[name].unit}."), f"chart of {name}")
        body += section(name, name, f"{AXES[name].what}.", picture + _cases(cases, undisturbed))
    head = f'<header><p class="kind">Stability</p><h1>{text(title)}</h1></header>'
    return page(f"{title}: stability", f"{head}<main>{body}</main>")


def _heard(known: Heard) -> str:
    """Precision and recall in words."""
    lines = [
        f"Recall: of {len(known.broken)} axes that break, {len(known.broken) - len(known.missed)} are noticed in time."
        + (f" Missed: {', '.join(known.missed)}." if known.missed else ""),
        f"Precision: of {len(known.spoken)} cases with a complaint that training did not mend, "
        f"{len(known.spoken) - len(known.unfounded)} lost {SUFFERED_DB:g} dB or more."
        + (f" The others: {'; '.join(known.unfounded)}." if known.unfounded else "")
        + (f" Early, because their axes break further on: {'; '.join(known.early)}." if known.early else ""),
        f"Said of the undisturbed scene: {'; '.join(known.alarms) or 'nothing'}.",
    ]
    return "".join(f"<p>{text(line)}</p>" for line in lines)


def _cases(cases: Sequence[Result], undisturbed: Sequence[Result]) -> str:
    of_seed = {r.seed: r for r in undisturbed}
    head = (
        "severity",
        "seed",
        "PSNR where it moves",
        "PSNR",
        "LPIPS",
        "turn, °",
        "clocks, ms",
        "s",
        "what is said",
    )
    rows = [
        (
            f"{r.severity:g}",
            str(r.seed),
            *(
                _number(value)
                for value in (r.psnr_moving, r.psnr, r.lpips, r.rotation_deg, r.sync_ms, r.seconds)
            ),
            "<br>".join(text(words) for words in said(r, of_seed.get(r.seed))),
        )
        for r in cases
    ]
    return table(head, rows, numeric=range(8))


def _lessened(found: Points) -> str:
    """What the result comes back to when damage that broke it is lessened by a step, or taken away."""
    if found.lessened is None or found.lessened_db is None:
        return ""
    at = f"at {found.lessened:g}" if found.lessened else "undamaged"
    return f"{readable(found.lessened_db, 1)} dB {at}"


def _severity(severity: float | None) -> str:
    return "never" if severity is None else f"{severity:g}"


def _number(value: float | None) -> str:
    return "" if value is None else readable(value, 2)
