"""The report's training section: what the two stages learned over time, and what it cost."""

from devrf.pipelines.report_html import absent, link, number, section, table, text
from devrf.pipelines.report_run import RunFolder, at

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
LEAD = (
    "Losses on the rays of each iteration, as the stages logged them. A curve that still falls at its end "
    "was stopped early; one that rises was trained too fast."
)


def training_section(run: RunFolder) -> str:
    """Loss curves of both stages and the cost of training."""
    parts = []
    for stage, title in (("canonical", "Canonical field"), ("deformation", "Motion field")):
        charts = _charts(run, stage)
        note = f'<p class="source">Source: {link(f"{stage}/metrics.json")}</p>'
        body = f'<div class="charts">{charts}</div>{note}' if charts else absent(run.why_absent(stage))
        parts.append(f"<h3>{title}</h3>{body}")
    return section("training", "Training", LEAD, "".join(parts) + _cost(run))


def _charts(run: RunFolder, stage: str) -> str:
    return ""


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
        f"<h3>Cost</h3>{device}{table(('what', ''), rows, source=METRICS, numeric=(1,), narrow=True)}"
        if rows
        else ""
    )
