"""Sections of the report that are curves: training and clocks."""

from collections.abc import Iterable
from typing import Any

from devrf.pipelines.report.run_reader import RunFolder, as_float, is_number
from devrf.pipelines.report.svg_charts import COLOURS, Chart, Series, line_chart

LABELS = ("iteration", "seconds", "psnr", "samples", "level", "key", "time")  # of a row; the rest are losses
LOSSES = {
    "mse": "re-rendering (mean squared error)",
    "entropy": "background entropy",
    "per_point": "colour per point",
    "cycle": "cycle",
    "flow": "flow",
    "variation": "total variation",
}
MAX_CURVES = 9  # of pairs of clocks


def training(run: RunFolder) -> dict[str, Any]:
    """PSNR and losses of the rays that were trained on, against iterations, of both stages."""
    return {"curves": {stage: _training(run, stage) for stage in ("canonical", "deformation")}}


def clocks(run: RunFolder) -> dict[str, Any]:
    """How well pairs of clips match against the delay between them, and how well geometry does."""
    heard = sorted(_with_tests(run, "sync/curves.json", "curves"), key=lambda c: not c.get("accepted"))
    pairs = _with_tests(run, "scene/clock_check.json", "pairs")[:MAX_CURVES]
    label = {"tracks": "epipolar error, px"}
    return {
        "correlation": _drawn(
            _clock(c, "method", "accepted", "not used", 1.0, "delay, s", "correlation")
            for c in heard[:MAX_CURVES]
        ),
        "geometry": _drawn(
            _clock(
                c,
                "by",
                "sharp",
                "not sharp",
                1e3,
                "trial offset, ms",
                label.get(str(c.get("by")), "correlation"),
            )
            for c in pairs
        ),
    }


def _with_tests(run: RunFolder, file: str, key: str) -> list[dict[str, Any]]:
    """What two cameras say of each other, of those that are trained on and of each test camera with these."""
    tests = [run.objects(file, "tests", name, key) for name in run.object(file, "tests")]
    return [pair for of in (run.objects(file, key), *tests) for pair in of]


def _training(run: RunFolder, stage: str) -> list[Chart]:
    rows = run.objects(f"{stage}/metrics.json", "curve")
    iterations = [as_float(row.get("iteration")) for row in rows]
    losses = [str(key) for key in dict.fromkeys(k for row in rows for k in row) if key not in LABELS]
    marks = [
        (as_float(row.get("iteration")), f"level {row['level'] + 1:.0f}")
        for before, row in zip(rows, rows[1:], strict=False)
        if is_number(row.get("level")) and row["level"] != before.get("level")
    ]
    psnr = Series("PSNR", iterations, [as_float(row.get("psnr")) for row in rows])
    lines = [
        Series(LOSSES.get(key) or key, iterations, [as_float(row.get(key)) for row in rows], n)
        for n, key in enumerate(losses[:COLOURS])
    ]
    return _drawn(
        [
            line_chart([psnr], "iteration", "PSNR of training rays, dB", marks=marks),
            line_chart(lines, "iteration", "loss, before its weight", log_y=True, marks=marks),
        ]
    )


def _clock(
    curve: dict[str, Any], by: str, good: str, bad: str, scale: float, x_label: str, y_label: str
) -> Chart | None:
    """One pair of cameras; `good` says whether its peak is one, `scale` leads from seconds to the axis."""
    lags, values = curve.get("lags_s"), curve.get("values")
    if (
        not isinstance(lags, list)
        or not isinstance(values, list)
        or len(lags) < 2
        or len(lags) != len(values)
    ):
        return None
    title = f"{curve.get('first')} and {curve.get('second')}: {curve.get(by)}"
    title += "" if curve.get(good) else f", {bad}"
    delay = curve.get("delay_s", 0.0 if by == "by" else None)
    marks = [(scale * delay, f"{scale * delay:.4g}")] if is_number(delay) else []
    series = Series("", [scale * as_float(x) for x in lags], [as_float(y) for y in values])
    return line_chart([series], x_label, y_label, marks=marks, title=title, small=True)


def _drawn(charts: Iterable[Chart | None]) -> list[Chart]:
    return [chart for chart in charts if chart is not None]
