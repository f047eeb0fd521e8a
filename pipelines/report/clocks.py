"""The report's clocks: each camera's against the first one's, the pairs they were read from, loops, and geometry."""

from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import absent, link, number, section, table, text
from devrf.pipelines.report.run import RunFolder

SYNC, CURVES, CHECK = "sync/sync.json", "sync/curves.json", "scene/clock_check.json"
MAX_CURVES = 9


def sync_section(run: RunFolder) -> str:
    """Each camera's clock against cam0's, and the curves they were read from."""
    lead = (
        "True time = offset + (1 + drift) × file time, on the first camera's clock. "
        "One clear peak in the correlation is what makes an offset sure."
    )
    used = CHECK if run.cameras(CHECK) else SYNC  # geometry may have replaced some
    cameras = run.cameras(used)
    if not cameras:
        return section("sync", "Clocks", lead, absent(run.why_absent("sync")))
    rows = []
    for name, clock in cameras.items():
        key = f"cameras.{name}"
        if clock.get("method") == "reference":  # its zeros are no measurements
            rows.append([f"<strong>{text(name)}</strong>", "the reference", "", "", "its own", ""])
            continue
        rows.append(
            [
                f"<strong>{text(name)}</strong>",
                number(clock.get("offset_s"), "s", 4, file=used, key=f"{key}.offset_s", sign=True),
                number(clock.get("drift_ppm"), "ppm", 1, file=used, key=f"{key}.drift_ppm", sign=True),
                number(clock.get("std_s"), "ms", 3, file=used, key=f"{key}.std_s", scale=1000.0),
                f'<span title="{text(clock.get("basis") or "")}">{text(clock.get("method", ""))}</span>',
                number(clock.get("confidence"), "", 2, file=used, key=f"{key}.confidence"),
            ]
        )
    head = ("camera", "offset", "drift", "std. deviation", "cue", "confidence")
    body = table(head, rows, source=used, numeric=(1, 2, 3, 5))
    body += _pairs(run) + _loops(run) + _sync_curves(run) + _geometry(run)
    return section("sync", "Clocks", lead, body)


def _pairs(run: RunFolder) -> str:
    """Every pair of cameras: how clear its peak is."""
    rows = []
    for n, curve in enumerate(run.objects(CURVES, "curves")):
        key = f"curves.{n}"
        rows.append(
            [
                text(f"{curve.get('first')} and {curve.get('second')}"),
                text(curve.get("method", "")),
                number(
                    curve.get("delay_s"), "ms", 3, file=CURVES, key=f"{key}.delay_s", scale=1e3, sign=True
                ),
                number(curve.get("quality"), "", 1, file=CURVES, key=f"{key}.quality"),
                "" if curve.get("accepted") else "not used",
            ]
        )
    head = ("pair", "cue", "delay", "peak over next", "")
    return f"<h3>Pairs</h3>{table(head, rows, source=CURVES, numeric=(2, 3))}" if rows else ""


def _loops(run: RunFolder) -> str:
    """Delays around three cameras must add up to nothing; two cues must agree."""
    rows = []
    for n, loop in enumerate(run.objects(CURVES, "loops")):
        names = loop.get("cameras")
        words = " → ".join(map(str, names)) if isinstance(names, list) else ""
        value = number(
            loop.get("closure_s"), "ms", 3, file=CURVES, key=f"loops.{n}.closure_s", scale=1e3, sign=True
        )
        rows.append([text(words), text(loop.get("cue", "")), value])
    for n, two in enumerate(run.objects(CURVES, "comparisons")):
        key = f"comparisons.{n}.difference_s"
        words = f"{two.get('first')} and {two.get('second')}: {two.get('other')} against {two.get('cue')}"
        value = number(two.get("difference_s"), "ms", 3, file=CURVES, key=key, scale=1e3, sign=True)
        rows.append([text(words), "contradict" if two.get("contradicts") else "agree", value])
    head = ("loop of cameras, or two cues", "", "left over")
    body = table(head, rows, source=CURVES, numeric=(2,))
    largest = run.object(SYNC).get("loop_s")
    if largest is not None:
        shown = number(largest, "ms", 3, file=SYNC, key="loop_s", scale=1e3)
        body += f"<p>Largest miss of a pair of cameras from the clocks: {shown}.</p>"
    return f"<h3>Contradictions</h3>{body}" if body else ""


def _geometry(run: RunFolder) -> str:
    """Epipolar error, or agreement of motion in epipolar planes, against a trial offset: best where it is 0."""
    charts = []
    for pair in run.objects(CHECK, "pairs")[:MAX_CURVES]:
        lags, values = pair.get("lags_s") or [], pair.get("values") or []
        if len(lags) < 2 or len(lags) != len(values):
            continue
        title = f"{pair.get('first')} and {pair.get('second')}: {pair.get('by')}"
        title += "" if pair.get("sharp") else ", not sharp"
        label = "epipolar error, px" if pair.get("by") == "tracks" else "correlation"
        series = [Series(title, [1e3 * float(x) for x in lags], [float(y) for y in values])]
        charts.append(
            line_chart(series, "trial offset, ms", label, x_marks=[(0.0, "0")], title=title, small=True)
        )
    if not charts:
        return ""
    return (
        f'<h3>By geometry</h3><div class="charts three">{"".join(charts)}</div>'
        f'<p class="source">Clocks that are right have their best point at 0. Source: {link(CHECK)}</p>'
    )


def _sync_curves(run: RunFolder) -> str:
    """How well pairs of cameras match, against the delay between them: those that were accepted first."""
    curves = sorted(run.objects(CURVES, "curves"), key=lambda c: not c.get("accepted"))
    charts = [chart for curve in curves[:MAX_CURVES] if (chart := _sync_curve(curve))]
    if not charts:
        return ""
    some = f" {len(charts)} of {len(curves)} pairs are drawn." if len(charts) < len(curves) else ""
    return (
        f'<h3>Correlation</h3><div class="charts three">{"".join(charts)}</div>'
        f'<p class="source">Source: {link(CURVES)}.{some}</p>'
    )


def _sync_curve(curve: dict[str, Any]) -> str:
    lags, values, delay = curve.get("lags_s") or [], curve.get("values") or [], curve.get("delay_s")
    if len(lags) < 2 or len(lags) != len(values):
        return ""
    marks = [(float(delay), f"{delay:.4f} s")] if isinstance(delay, (int, float)) else []
    title = f"{curve.get('first')} and {curve.get('second')}: {curve.get('method')}"
    title += "" if curve.get("accepted") else ", not used"
    series = [Series(title, [float(x) for x in lags], [float(y) for y in values])]
    return line_chart(series, "delay, s", "correlation", x_marks=marks, title=title, small=True)
