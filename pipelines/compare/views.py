"""The comparison's pictures: PSNR of each run over time, and the same test view of each under the slider."""

import math
from collections.abc import Sequence

from devrf.pipelines.compare.result import Comparison
from devrf.pipelines.compare.runs import METRICS, ComparedRun, ViewKey
from devrf.pipelines.compare.same_views import common_views, picture_of
from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import absent, number, section, text
from devrf.pipelines.report.pictures import error_picture, picture_uri, shrink
from devrf.pipelines.report.run import as_float, at, evenly, fewer
from devrf.pipelines.report.slider import chooser, frames, pane, slider
from devrf.pipelines.report.views import collect_views, error_scale

VIEW_WIDTH, BESIDE_WIDTH = 640, 360
MAX_MOVING, MAX_STILL, MAX_CAMERAS = 8, 3, 3
LEAD = (
    "The same test view as each run renders it. Choose which two are left and right of the border and drag it, or use "
    "the arrow keys. Beside it: where each differs from the true picture."
)


def views_section(found: Comparison, room: float) -> str:
    """PSNR over time and a few of the views that all runs have; `room` is the share of pictures there is place for."""
    moving = _shared(found.runs, moving=True)
    still = _shared(found.runs, moving=False)
    body = _over_time(found)
    for title, keys, most in (
        ("Test views", moving, MAX_MOVING),
        ("Held-out sweep pictures", still, MAX_STILL),
    ):
        if keys:
            some = evenly(keys, fewer(most, room))
            body += f"<h3>{title}</h3>{_viewer(found, some, len(keys), math.sqrt(room))}"
    return section("views", "Views", LEAD, body or absent("No view is in all of the runs."))


def _shared(runs: Sequence[ComparedRun], moving: bool) -> list[ViewKey]:
    keys = list(runs[0].moving if moving else runs[0].still)
    for run in runs[1:]:
        keys = common_views(keys, run.moving if moving else run.still)
    return keys


def _over_time(found: Comparison) -> str:
    """A chart per test camera, a line per run."""
    rows = [row for run in found.runs for row in run.moving.values()]
    in_s = all(row.get("time_s") is not None for row in rows)  # data sets only know times from 0 to 1
    charts = []
    for camera in list(dict.fromkeys(camera for camera, _ in found.runs[0].moving))[:MAX_CAMERAS]:
        lines = []
        for n, run in enumerate(found.runs):
            mine = [row for (name, _), row in run.moving.items() if name == camera]
            times = [as_float(row.get("time_s" if in_s else "time")) for row in mine]
            lines.append(Series(run.name, times, [as_float(row.get("psnr")) for row in mine], n))
        charts.append(line_chart(lines, "time, s" if in_s else "time (0 to 1)", f"PSNR of {camera}, dB"))
    files = "; ".join(found.link(run, METRICS) for run in found.runs)
    drawn = "".join(charts)
    return (
        f'<h3>Over time</h3><div class="charts">{drawn}</div><p class="source">{files}</p>' if drawn else ""
    )


def _viewer(found: Comparison, keys: Sequence[ViewKey], total: int, scale: float) -> str:
    rows = [(_word(found.runs[0], key), panes) for key in keys if (panes := _panes(found, key, scale))]
    if not rows:
        return absent("The true and rendered pictures are not in evaluate/.")
    words = ["true", *(run.name for run in found.runs)]
    some = (
        f" {len(rows)} of {total} views are shown; the others are in evaluate/." if len(rows) < total else ""
    )
    middle = len(rows) // 2
    return f'<div class="views">{chooser(words, 1, 2)}{frames(rows, middle)}{error_scale(some)}</div>'


def _panes(found: Comparison, key: ViewKey, scale: float) -> list[str]:
    """The slider and the differences from the true picture; nothing where a picture is missing."""
    name = f"{key[0]}, frame {key[1]}"
    true = picture_of(found.runs[0], key, "true")
    rendered = [picture_of(run, key, "rendered") for run in found.runs]
    if true is None or any(picture is None for picture in rendered):
        return []
    width = round(scale * VIEW_WIDTH)
    named = zip(["true", *(run.name for run in found.runs)], [true, *rendered], strict=True)
    pictures = [(picture_uri(picture, width), word) for word, picture in named if picture is not None]
    panes = [pane(slider(pictures, name, 1, 2), text(name))]
    for run, picture in zip(found.runs, rendered, strict=True):
        own = picture_of(run, key, "true")
        if picture is None or own is None or own.shape != picture.shape:
            continue
        uri = picture_uri(shrink(error_picture(own, picture), round(scale * BESIDE_WIDTH)), BESIDE_WIDTH)
        psnr = number(
            at(run.moving.get(key) or run.still.get(key), "psnr"),
            "dB",
            2,
            file=found.file(run, METRICS),
            key=f"per_view.{_place(run, key)}.psnr",
        )
        words = f"{text(run.name)}: {psnr}"
        panes.append(pane(f'<img src="{uri}" alt="difference of {text(run.name)}, {text(name)}">', words))
    return panes


def _word(run: ComparedRun, key: ViewKey) -> str:
    """On the button of a view."""
    row = run.moving.get(key) or run.still.get(key) or {}
    several = len({camera for camera, _ in run.moving}) > 1
    when = f"{row['time_s']:.2f} s" if isinstance(row.get("time_s"), float) else str(key[1])
    return f"{key[0]}, {when}" if several else when


def _place(run: ComparedRun, key: ViewKey) -> int:
    """Of a view in `per_view`."""
    for view in (view for views in collect_views(run.metrics) for view in views):
        if (str(view.row.get("camera")), view.row.get("index")) == key:
            return view.place
    raise ValueError(f"{run.name} has no view {key}")
