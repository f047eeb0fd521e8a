"""The report's training section: what the two stages learned over time, and what it cost."""

from devrf.pipelines.report.charts import COLOURS, Series, line_chart
from devrf.pipelines.report.html import absent, link, number, section, table, text
from devrf.pipelines.report.run import RunFolder, as_float, at

METRICS = "evaluate/metrics.json"
COSTS = (
    ("canonical_s", "canonical field", "s", 0),
    ("deformation_s", "motion field", "s", 0),
    ("total_s", "together", "s", 0),
    ("iterations", "iterations", "", 0),
    ("rays_per_s", "rays per second", "", 0),
    ("peak_rss_gb", "peak main memory", "GB", 2),
    ("peak_gpu_gb", "peak GPU memory", "GB", 2),
)
LABELS = ("iteration", "seconds", "psnr", "samples", "level", "key", "time")  # of a row; the rest are losses
LOSSES = {
    "mse": "re-rendering (mean squared error)",
    "entropy": "background entropy",
    "per_point": "colour per point",
    "cycle": "cycle",
    "flow": "flow",
    "variation": "total variation",
}
LEAD = (
    "Means over the rays of the iterations since the point before. The motion field visits its key times one after "
    "the other at every level, so its curves follow the motion, not only the learning."
)


def training_section(run: RunFolder) -> str:
    """Loss curves of both stages and the cost of training."""
    parts = []
    for stage, title in (("canonical", "Canonical field"), ("deformation", "Motion field")):
        charts = _charts(run, stage)
        note = f'<p class="source">Source: {link(f"{stage}/metrics.json")}</p>'
        decided = _decisions(run, stage)
        body = (
            f'<div class="charts">{charts}</div>{decided}{note}' if charts else absent(run.why_absent(stage))
        )
        parts.append(f"<h3>{title}</h3>{body}")
    return section("training", "Training", LEAD, "".join(parts) + _cost(run))


def _decisions(run: RunFolder, stage: str) -> str:
    """What the scene needed less of than the preset offers, and why."""
    lines = run.object(f"{stage}/metrics.json").get("decisions")
    if not isinstance(lines, list) or not lines:
        return ""
    return f"<p>By the scene:</p><ul>{''.join(f'<li>{text(line)}</li>' for line in lines)}</ul>"


def _charts(run: RunFolder, stage: str) -> str:
    """PSNR and losses of the rays that were trained on, against iterations."""
    curve = run.object(f"{stage}/metrics.json").get("curve")
    rows = [row for row in curve if isinstance(row, dict)] if isinstance(curve, list) else []
    if not rows:
        return ""
    iterations = [as_float(row.get("iteration")) for row in rows]
    losses = [str(key) for key in dict.fromkeys(k for row in rows for k in row) if key not in LABELS]
    marks = [
        (as_float(row.get("iteration")), f"level {row['level'] + 1:.0f}")
        for before, row in zip(rows, rows[1:], strict=False)
        if isinstance(row.get("level"), (int, float)) and row["level"] != before.get("level")
    ]
    psnr = Series("PSNR", iterations, [as_float(row.get("psnr")) for row in rows])
    lines = [
        Series(LOSSES.get(key) or key, iterations, [as_float(row.get(key)) for row in rows], n)
        for n, key in enumerate(losses[:COLOURS])
    ]
    return line_chart([psnr], "iteration", "PSNR of training rays, dB", x_marks=marks) + line_chart(
        lines, "iteration", "loss, before its weight", log_y=True, x_marks=marks
    )


def _cost(run: RunFolder) -> str:
    train = at(run.object(METRICS), "train")
    if not isinstance(train, dict):
        return ""
    rows = [
        [text(label), number(train[key], unit, digits, file=METRICS, key=f"train.{key}")]
        for key, label, unit, digits in COSTS
        if train.get(key) is not None
    ]
    device = f"<p>On {text(train['device'])}.</p>" if train.get("device") else ""
    return (
        f"<h3>Cost</h3>{device}{table(('what', 'measured'), rows, source=METRICS, numeric=(1,), narrow=True)}"
        if rows
        else ""
    )
