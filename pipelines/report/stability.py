"""The report's page of `bench stability`: where this scene's result breaks under damage, and what is said there."""

from collections import defaultdict
from collections.abc import Mapping
from statistics import fmean
from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import link, number, section, table, text
from devrf.pipelines.report.run import RunFolder, as_float, at

UNDISTURBED = "undisturbed"
LEAD = (
    "What happens to this scene when one thing gets worse at a time, through the whole pipeline. A result breaks where "
    "half of its seeds are stopped, or gain less over the scene at rest than motion must. Said: a health row that the "
    "undisturbed scene does not show and that needs no test view."
)
MAX_NOTICES = 3


def stability_section(run: RunFolder) -> str:
    """Table and a chart per axis of the suite beside the run folder; empty where none has been run."""
    file = f"../{run.path.name}-bench/stability.json"
    found = run.object(file)
    axes, points = found.get("axes"), found.get("points")
    if not isinstance(axes, dict) or not isinstance(points, dict):
        return ""
    charts = "".join(_chart(run, file, name, axes[name]) for name in axes)
    left_out = found.get("left_out")
    left_out = left_out if isinstance(left_out, dict) else {}
    body = (
        _heard(found, file)
        + _table(found, axes, file)
        + "".join(f'<p class="source">{text(name)}: {text(why)}</p>' for name, why in left_out.items())
        + f'<h3>PSNR where it moves, by severity</h3><div class="charts three">{charts}</div>'
        '<p class="legend source"><span class="key dashed" style="--c:var(--s2)">undamaged</span>'
        '<span class="key dashed" style="--c:var(--s1)">the least that is worth its name</span></p>'
        f'<p class="source">{_measured_on(found)} Every case: {_page(run, file)}</p>'
    )
    return section("stability", "Stability", LEAD, body)


def _heard(found: Mapping[str, Any], file: str) -> str:
    """How many breaks are noticed, and how many complaints are founded."""
    parts = []
    for key, of, what in (
        ("recall", "broken", "axes that break are noticed in time"),
        ("precision", "spoken", "cases with a complaint lost something"),
    ):
        counted = at(found, f"heard.{of}")
        if at(found, f"heard.{key}") is not None and isinstance(counted, list):
            share = number(at(found, f"heard.{key}"), "%", 0, file=file, key=f"heard.{key}", scale=100.0)
            parts.append(f"<p>{share} of {len(counted)} {what}.</p>")
    return "".join(parts)


def _table(found: Mapping[str, Any], axes: Mapping[str, Any], file: str) -> str:
    rows = []
    for name, axis in axes.items():

        def of(key: str, unit: str, digits: int, none: str, name: str = name) -> str:
            value = at(found, f"points.{name}.{key}")
            whole = f"points.{name}.{key}"
            digits = 0 if isinstance(value, float) and value.is_integer() else digits
            return none if value is None else number(value, unit, digits, file=file, key=whole)

        notices = at(found, f"points.{name}.notices")
        notices = [str(words) for words in notices] if isinstance(notices, list) else []
        more = f"<br>and {len(notices) - MAX_NOTICES} more" if len(notices) > MAX_NOTICES else ""
        rows.append(
            [
                f"<strong>{text(name)}</strong><br>{text(at(axis, 'what') or '')}",
                of("failure", "", 2, "never"),
                of("notice", "", 2, "never"),
                text(at(axis, "unit") or ""),
                of("lessened_db", "dB", 1, ""),
                "<br>".join(text(words) for words in notices[:MAX_NOTICES]) + more,
            ]
        )
    head = ("what gets worse", "breaks at", "said at", "unit", "one step less", "what is said there")
    return table(head, rows, source=file, numeric=(1, 2, 4), wide_last=True)


def _chart(run: RunFolder, file: str, name: str, axis: Mapping[str, Any]) -> str:
    """Mean over seeds against severity, between the undisturbed result and the least that is worth its name."""
    reached: dict[float, list[float]] = defaultdict(list)
    undisturbed = []
    for case in run.objects(file, "cases"):
        value = as_float(case.get("psnr_moving"))
        if case.get("axis") == UNDISTURBED:
            undisturbed.append(value)
        elif case.get("axis") == name:
            reached[as_float(case.get("severity"))].append(value)
    if not reached:
        return ""
    severities = sorted(reached)
    ends = [severities[0], severities[-1] if len(severities) > 1 else severities[0] + 1]
    series = [Series("damaged", severities, [fmean(reached[s]) for s in severities], 0, markers=True)]
    for words, level, colour in (
        ("undamaged", fmean(undisturbed) if undisturbed else float("nan"), 2),
        ("least", as_float(run.object(file).get("bar_db")), 1),
    ):
        if level == level:
            series.append(Series(words, ends, [level, level], colour, dashed=True))
    marks = [
        (float(value), words)
        for key, words in (("notice", "said"), ("failure", "breaks"))
        if isinstance(value := at(run.object(file), f"points.{name}.{key}"), (int, float))
    ]
    if len(marks) == 2 and marks[0][0] == marks[1][0]:
        marks = [(marks[0][0], "breaks, said")]
    unit = at(axis, "unit") or "severity"
    title = str(at(axis, "what") or name)
    return line_chart(series, str(unit), "PSNR, dB", x_marks=marks, title=title, small=True)


def _measured_on(found: Mapping[str, Any]) -> str:
    seeds = found.get("seeds")
    with_seeds = f", seeds {', '.join(map(str, seeds))}" if isinstance(seeds, list) else ""
    return text(f"{found.get('device', '')}{with_seeds}.")


def _page(run: RunFolder, file: str) -> str:
    page = file.removesuffix(".json") + ".html"
    return link(page if (run.path / page).is_file() else file)
