"""Test views for the report: true and rendered pictures, where they differ, and PSNR over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from devrf.capture.system.spread import spread
from devrf.pipelines.report.data_uris import picture_uri, read_picture
from devrf.pipelines.report.run_reader import METRICS, RunFolder, as_float, at
from devrf.pipelines.report.svg_charts import COLOURS, Chart, Series, line_chart

# two under the border, and those beside it
WIDTHS = {"true": 720, "rendered": 720, "error": 400, "rest": 400}
MAX_MOVING, MAX_STILL, MAX_STATIC = 12, 4, 8  # frames inside the page; the others stay in evaluate/


@dataclass(frozen=True)
class ViewEntry:
    """One test view: its place in a list of evaluate/metrics.json, and the entry there."""

    place: int
    row: dict[str, Any]
    listed: str = "per_view"

    @property
    def time(self) -> Any:
        """When it was taken: in seconds, or from 0 to 1 where only that is known; None of a picture at rest."""
        time_s = self.row.get("time_s")
        return self.row.get("time") if time_s is None else time_s


def collect_views(metrics: dict[str, Any]) -> tuple[list[ViewEntry], list[ViewEntry]]:
    """Views of the moving scene, by camera and time, and of the scene at rest."""
    rows = metrics.get("per_view")
    views = [
        ViewEntry(n, row)
        for n, row in enumerate(rows if isinstance(rows, list) else [])
        if isinstance(row, dict)
    ]
    moving = [v for v in views if v.row.get("time") is not None]
    moving.sort(key=lambda v: (str(v.row.get("camera")), v.row["time"]))
    return moving, [v for v in views if v.row.get("time") is None]


def views(run: RunFolder) -> dict[str, Any]:
    """Test views over time and held-out sweep pictures: of each a chart, and the pictures of some frames."""
    moving, static = collect_views(run.object(METRICS))
    stands = [
        ViewEntry(n, row, "still_pictures") for n, row in enumerate(run.objects(METRICS, "still_pictures"))
    ]
    groups = []
    for title, found, most, chart in (
        ("Test views over time", moving, MAX_MOVING, _over_time(moving)),
        ("What stands, as test cameras show it", stands, MAX_STILL, None),
        ("Held-out sweep pictures", static, MAX_STATIC, None),
    ):
        full = [v for v in found if "error" in v.row] or found  # evaluate keeps error and rest for some
        several = len({v.row.get("camera") for v in full}) > 1
        some = [_frame(run, v, several) for v in spread(full, max(1, round(most * run.room)))]
        frames = [frame for frame in some if frame is not None]
        middle = len(frames) // 2  # at the first time of a clip nothing has moved yet
        group = {"title": title, "frames": frames, "shown": middle, "total": len(found)}
        groups += [group | {"charts": [chart] if chart else []}] if found else []
    clocks = run.object("deformation/metrics.json", "test_clocks")
    shown = dict.fromkeys(str(v.row.get("camera")) for v in moving)
    return {"groups": groups, "clocks": [_by_which_clock(n, clocks[n]) for n in shown if n in clocks]}


def _by_which_clock(camera: str, clock: dict[str, Any]) -> str:
    """Of a test camera whose clock is not known (`test_clocks` of stage `deformation`)."""
    offset_s = clock.get("offset_s")
    later = "" if offset_s is None else f"by what moves its pictures are {1e3 * offset_s:+.0f} ms later"
    said = later or clock.get("why")
    return f"{camera} is shown by its clock as it was calibrated, which is not known well ({said})"


def _over_time(views: Sequence[ViewEntry]) -> Chart | None:
    series = []
    for n, camera in enumerate(list(dict.fromkeys(str(v.row.get("camera")) for v in views))[: COLOURS // 2]):
        mine = [v for v in views if str(v.row.get("camera")) == camera]
        times = [as_float(v.time) for v in mine]
        for words, key, dashed in (
            ("result", "psnr", False),
            ("standing still", "static_baseline.psnr", True),
        ):
            psnr = [as_float(at(v.row, key)) for v in mine]
            series.append(Series(f"{camera}, {words}", times, psnr, 2 * n + dashed, dashed))
    in_s = any(v.row.get("time_s") is not None for v in views)
    return line_chart(series, ("time, s" if in_s else "time (0 to 1)", "PSNR, dB"))


def _frame(run: RunFolder, view: ViewEntry, several: bool) -> dict[str, Any] | None:
    """A view's pictures and its names; None where pictures are missing. Smaller ones where there is less room."""
    row, folder = view.row, run.folder("evaluate")
    found = {kind: read_picture(folder / row[kind]) for kind in WIDTHS if isinstance(row.get(kind), str)}
    pictures = {kind: picture for kind, picture in found.items() if picture is not None}
    true, rendered = pictures.get("true"), pictures.get("rendered")
    if true is None or rendered is None or true.shape != rendered.shape:
        return None
    scale = math.sqrt(run.room)
    shown = {"place": [view.listed, view.place]}
    shown |= {kind: picture_uri(picture, round(scale * WIDTHS[kind])) for kind, picture in pictures.items()}
    camera, index = row.get("camera", ""), row.get("index", "")
    if view.listed == "still_pictures":
        when = "picture at rest" if row.get("source") == "rest" else "clean plate"
        return {**shown, "word": f"{camera}", "name": f"{camera}, {when}"}
    when = str(index) if view.time is None else f"{view.time:.2f}" + " s" * (row.get("time_s") is not None)
    return {
        **shown,
        "word": f"{camera}, {when}" if several else when,
        "name": f"{camera}, frame {index}" + (f", {when}" if view.time is not None else ""),
    }
