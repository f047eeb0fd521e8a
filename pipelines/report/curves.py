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
CORRELATION = ("delay, s", "correlation")


def training(run: RunFolder) -> dict[str, Any]:
    """PSNR and losses of the rays that were trained on, against iterations, of both stages."""
    return {"curves": {stage: _training(run, stage) for stage in ("canonical", "deformation")}}


def clocks(run: RunFolder) -> dict[str, Any]:
    """How well pairs of clips match against the delay between them, and how well geometry does."""
    heard = sorted(_with_tests(run, "sync/curves.json", "curves"), key=lambda c: not c.get("accepted"))
    pairs = _with_tests(run, "scene/clock_check.json", "pairs")[:MAX_CURVES]
    return {
        "correlation": _drawn(
            _clock(c, f"{c.get('method')}{'' if c.get('accepted') else ', not used'}", 1.0, CORRELATION)
            for c in heard[:MAX_CURVES]
        ),
        "geometry": _drawn(
            _clock(
                {"delay_s": 0.0} | c,
                f"{c.get('by')}{'' if c.get('sharp') else ', not sharp'}",
                1e3,
                ("trial offset, ms", "epipolar error, px" if c.get("by") == "tracks" else "correlation"),
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
            line_chart([psnr], ("iteration", "PSNR of training rays, dB"), marks=marks),
            line_chart(lines, ("iteration", "loss, before its weight"), log_y=True, marks=marks),
        ]
    )


def _clock(curve: dict[str, Any], by: str, scale: float, labels: tuple[str, str]) -> Chart | None:
    """One pair of cameras, compared by what `by` says; `scale` leads from seconds to the axis."""
    lags, values = curve.get("lags_s"), curve.get("values")
    if not (isinstance(lags, list) and isinstance(values, list) and 2 <= len(lags) == len(values)):
        return None
    title, delay = f"{curve.get('first')} and {curve.get('second')}: {by}", curve.get("delay_s")
    marks = [(scale * delay, f"{scale * delay:.4g}")] if is_number(delay) else []
    series = Series("", [scale * as_float(x) for x in lags], [as_float(y) for y in values])
    return line_chart([series], labels, marks=marks, title=title, small=True)


def _drawn(charts: Iterable[Chart | None]) -> list[Chart]:
    return [chart for chart in charts if chart is not None]
