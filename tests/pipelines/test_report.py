"""The report: complete, self-contained, escaped, true to its files, and made from whatever there is."""

import json
import re
import shutil
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import Command
from tests.pipelines.report_folder import NASTY, write_json, write_run
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.pipelines.cli.results import _report_is_left
from devrf.pipelines.report import report_page
from devrf.pipelines.report.data_uris import flow_picture
from devrf.pipelines.report.report_page import SECTIONS, build_report
from devrf.pipelines.report.run_reader import RunFolder, at
from devrf.pipelines.report.svg_charts import Series, line_chart
from devrf.pipelines.stages import STAGES, stage_names

ALWAYS = {key for key, *_ in SECTIONS}


class Page(HTMLParser):
    """What a page holds: ids, links, quoted numbers, and the text outside scripts and styles; its tags are closed.

    `stages` are those that the numbers and links of a section are said to be from.
    """

    VOID = {"meta", "img", "br", "input"}

    def __init__(self, html: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.addresses: list[str] = []
        self.numbers: dict[tuple[str, str], float] = {}
        self.stages: list[
            tuple[str, frozenset[str]]
        ] = []  # of each quoted number: its file's stage, its section's
        self.linked: dict[frozenset[str], set[str]] = {}
        self.open: list[tuple[str, frozenset[str]]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == [], f"never closed: {self.open}"
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        inside = self.open[-1][1] if self.open else frozenset()
        inside = frozenset(values["data-stages"].split()) if "data-stages" in values else inside
        self.ids.update([values["id"]] if "id" in values else [])
        self.addresses += [values[k] for k in ("src", "href", "srcset", "action", "data") if k in values]
        if "data-key" in values:
            self.numbers[values["data-file"], values["data-key"]] = float(values["data-value"])
            self.stages.append((values["data-file"].split("/")[0], inside))
        if values.get("href", "").startswith("../"):
            self.linked.setdefault(inside, set()).add(values["href"][3:])
        if tag not in self.VOID:
            self.open.append((tag, inside))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open and self.open[-1][0] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        inside = self.open[-1][0] if self.open else ""
        (self.scripts if inside in ("script", "style") else self.words).append(data)


@pytest.fixture(scope="module")
def full_run(tmp_path_factory) -> Path:
    """A run folder with every artifact."""
    run = tmp_path_factory.mktemp("report") / "run"
    write_run(run)
    return run


@pytest.fixture(scope="module")
def full_page(full_run) -> tuple[str, Page]:
    return _page(full_run)


def _page(run: Path, reasons: Mapping[str, str] = {}, name: str = NASTY) -> tuple[str, Page]:  # noqa: B006
    html = build_report(RunFolder(run, stage_names(), reasons), name)
    return html, Page(html)


def test_every_section_is_there_and_small(full_page):
    html, page = full_page
    assert page.ids >= ALWAYS and "cannot be made" not in page.text
    assert 'class="absent"' not in html and len(html) < 1_000_000
    for words in ("orbit.mp4", "Hold the camera still.", "static/000006.png", "Method: dis.", "level 2"):
        assert words in page.text
    assert html.count("<svg") == html.count('role="img"') == 2 + 1 + 2 * 2 + 1


def test_it_needs_nothing_from_outside_and_what_it_links_to_exists(full_run, full_page):
    html, page = full_page
    for address in page.addresses:
        assert address.startswith(("data:", "../", "#")), address[:80]
        assert not address.startswith("../") or (full_run / address[3:]).is_file(), address
    outside_data = re.sub(r"data:[\w/]+;base64,[A-Za-z0-9+/=\s]+", "", html)
    assert "http" not in outside_data and "@import" not in html and not re.search(r"url\([^#]", html)


@pytest.mark.parametrize("by_truth", [False, True])
def test_it_says_which_pixels_move(full_run, tmp_path, by_truth):
    run = shutil.copytree(full_run, tmp_path / "run")
    file = run / "evaluate" / "metrics.json"
    file.write_text(
        json.dumps(json.loads(file.read_text()) | {"true_masks": ["witness"] if by_truth else []})
    )
    _, page = _page(run)
    assert ("where something moves in truth" in page.text) == by_truth
    assert ("where the true picture differs" in page.text) != by_truth


def test_names_are_escaped(full_page):
    html, page = full_page
    assert "alert('x')" not in "".join(page.scripts)
    assert "<script>alert" not in html and "<b>ness" not in html
    assert NASTY in page.text and "cam0 and wit<b>ness: audio" in page.text  # shown as they were written


def test_numbers_are_those_of_the_files_and_traced_to_their_stages(full_run, full_page):
    html, page = full_page
    for key in ("test.psnr", "test_moving.psnr", "static_baseline.test_moving.psnr", "train.total_s", "model_mb",
                "shading.unshaded_psnr", "confidence.unseen_share", "confidence.seen_by.0.share"):  # fmt: skip
        assert ("evaluate/metrics.json", key) in page.numbers
    assert page.numbers["colour/colour.json", "cameras.cam0.stops"] == -0.375 and "−0.38" in page.text
    for (file, key), value in page.numbers.items():
        path = (
            key.split(".")
            if "wit<b>ness" not in key
            else [key.split(".")[0], "wit<b>ness", *key.split(".")[2:]]
        )
        assert value == at(json.loads((full_run / file).read_text()), *path), (file, key)
    top = frozenset()  # the summary, whose numbers are linked one by one
    assert len(page.stages) > 50
    assert all(inside == top or stage in inside for stage, inside in page.stages)
    for stages, links in page.linked.items():
        assert {f"{stage}/stamp.json" for stage in stages or set(stage_names()) - {"report"}} <= links
    assert "made 2026-11-22 23:15:00 in run night-1" in page.text and 'title="id id-evaluate"' in html


def test_the_same_run_makes_the_same_page(full_run, full_page):
    assert _page(full_run)[0] == full_page[0]


@pytest.mark.parametrize(("moves", "said"), [(True, "moving cameras that see it"), (False, "sweep pictures")])
def test_the_subject_is_shown_by_how_many_cameras_see_it(tmp_path, moves, said):
    seen_by = [{"cameras": 2, "share": 0.375}]
    found = {"moves": moves, "unseen_share": 0.625 if moves else None, "seen_by": seen_by}
    write_json(tmp_path / "evaluate/metrics.json", {"confidence": found})
    _, page = _page(tmp_path)
    assert said in page.text and page.numbers["evaluate/metrics.json", "confidence.seen_by.0.share"] == 0.375
    assert (("evaluate/metrics.json", "confidence.unseen_share") in page.numbers) == moves


@pytest.mark.full
def test_a_page_that_would_be_too_large_gives_up_the_film_then_pictures_and_says_so(
    full_run, tmp_path, monkeypatch
):
    run = shutil.copytree(full_run, tmp_path / "run")
    (run / "render/orbit.mp4").write_bytes(bytes(100_000))
    whole, page = _page(run)
    assert whole.count("data:video/mp4") == 1
    monkeypatch.setattr(report_page, "MAX_PAGE_BYTES", len(whole.encode()) - 1)
    linked, page = _page(run)
    assert "data:video/mp4" not in linked and "The film is linked, not in the page, to keep" in page.text
    assert linked.count("data:image") == whole.count("data:image")
    monkeypatch.setattr(report_page, "MAX_PAGE_BYTES", len(linked.encode()) - 1000)
    small, page = _page(run)
    assert len(small.encode()) <= len(linked.encode()) - 1000
    assert "pictures are fewer and smaller" in page.text
    assert "1 of 2 views are shown" in page.text


def test_a_stage_without_a_stamp_is_not_named_as_a_source(full_run, tmp_path):
    run = shutil.copytree(full_run, tmp_path / "run")
    (run / "ingest/stamp.json").unlink()
    (run / "scene/stamp.json").write_text('{"id": "x"}')  # of an earlier version
    html, _ = _page(run)
    assert "ingest/stamp.json" not in html and "scene/stamp.json" in html


def test_counts_have_no_decimals_and_measures_keep_theirs(tmp_path):
    counted = {
        "code": "x",
        "check": "views",
        "value": 147.0,
        "unit": "",
        "warn": 200.0,
        "fail": 0.25,
        "verdict": "warn",
    }
    rows = [counted, counted | {"check": "error", "value": 0.5}]
    write_json(tmp_path / "rig/health.json", {"stage": "rig", "rows": rows})
    _, page = _page(tmp_path)
    assert "views: 147 ." in page.text and "error: 0.500 ." in page.text
    assert "147.000" not in page.text and "200.00" not in page.text and "0.25" in page.text


def test_parts_that_move_are_listed(tmp_path):
    part = {"part": 7, "at": [0.25, -1.5, 0.0], "points": 4321, "goes": 0.875, "longest_lost": 3}
    write_json(tmp_path / "deformation/metrics.json", {"rigid_parts": [part, "damaged"]})
    _, page = _page(tmp_path)
    assert "What moves, in parts" in page.text and "7 0.25, -1.5, 0.0 4321 0.875 3" in page.text
    write_json(tmp_path / "deformation/metrics.json", {"rigid_parts": "damaged"})
    assert "What moves, in parts" not in _page(tmp_path)[1].text


def test_what_is_not_there_is_said(full_run, tmp_path):
    run = shutil.copytree(full_run, tmp_path / "run")
    for stage, said in (("flow", "flow has not run"), ("render", "flow, render have not run")):
        shutil.rmtree(run / stage)
        assert f"Not finished: {said}." in _page(run)[1].text
    _, page = _page(tmp_path / "empty", dict.fromkeys(("sync", "rig", "flow"), NASTY))
    assert page.text.count(f"Does not apply: {NASTY}") == 3 and not page.numbers
    assert page.text.count("has not run") >= len(ALWAYS) - 3


FILES = (
    "ingest/ingest.json",
    "static_poses/static_poses.json",
    "sync/sync.json",
    "sync/curves.json",
    "rig/rig.json",
    "scene/scene.json",
    "flow/flow.json",
    "canonical/metrics.json",
    "evaluate/metrics.json",
    "scene/health.json",
    "scene/stamp.json",
)


@pytest.mark.parametrize(
    "file", [*FILES[:2], *(pytest.param(file, marks=pytest.mark.full) for file in FILES[2:])]
)
def test_no_damaged_file_stops_it(full_run, tmp_path, file):
    for entry in full_run.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    stage, name = file.split("/")
    (tmp_path / stage).unlink()
    (tmp_path / stage).mkdir()
    for entry in (full_run / stage).iterdir():
        (tmp_path / stage / entry.name).symlink_to(entry)
    for content in ("{", "[]", '{"cameras": [], "curves": {}, "per_view": 3, "rows": [3]}'):
        (tmp_path / file).unlink()
        (tmp_path / file).write_text(content)
        _, page = _page(tmp_path)
        assert "cannot be made" not in page.text
        if content == "{":
            assert f"{file} cannot be read" in page.text or f"{stage}/ cannot be read" in page.text


def test_a_section_that_breaks_leaves_the_others(full_run, monkeypatch):
    def broken(run):
        raise RuntimeError(NASTY)

    sections = tuple((key, title, broken if key == "flow" else make) for key, title, make in SECTIONS)
    monkeypatch.setattr(report_page, "SECTIONS", sections)
    _, page = _page(full_run)
    assert f"This section cannot be made: RuntimeError: {NASTY}" in page.text and page.ids >= ALWAYS


def test_a_chart_shows_what_can_be_drawn_and_long_ones_keep_their_spikes():
    assert line_chart([Series("a", [0.0, 1.0], [float("nan"), 0.0])], ("x", "y"), log_y=True) is None
    y = np.zeros(20_000)
    y[12_345] = 1.0
    chart = line_chart(
        [Series("a", np.arange(20_000.0).tolist(), y.tolist())], ("x", "y $1 < 2"), title=NASTY
    )
    assert chart is not None and len(chart.svg) < 15_000 and NASTY not in chart.svg
    assert "y $1 &lt; 2" in chart.svg
    lines = [
        np.array([[float(v) for v in xy] for xy in re.findall(r"[ML] ([\d.]+) ([\d.]+)", d)])
        for d in re.findall(r'<path d="([^"]+)"[^>]*stroke: var\(--s0\)', chart.svg)
    ]
    (line,) = lines
    assert np.ptp(line[:, 1]) > 150  # the spike is there, on a drawing of 250
    assert line[np.argmin(line[:, 1]), 0] == pytest.approx(line[0, 0] + 0.617 * np.ptp(line[:, 0]), abs=1)


def test_flow_colours_are_directions():
    flow = np.array([[[4.0, 0.0], [0.0, 4.0], [-4.0, 0.0], [0.0, 0.0]]], np.float32)
    picture = flow_picture(flow, np.array([[True, True, True, False]]), 4.0)
    expected = [[255, 0, 0], [128, 255, 0], [0, 255, 255], [120, 120, 120]]
    np.testing.assert_allclose(picture[0], expected, atol=1)  # rounding


def test_stage_is_in_the_pipeline():
    stage = next(s for s in STAGES if s.name == "report")
    assert set(stage.reads) == set(stage_names()) - {"report"}


def test_command_reports_a_run_that_has_not_come_to_its_end(tmp_path, devrf: Command):
    for name in ("cam0", "cam1"):
        (tmp_path / f"{name}.mp4").touch()
    (tmp_path / "rig.json").touch()
    (tmp_path / "scene.yaml").write_text(
        "name: half\noutput: run\ncapture: {cameras: {cam0: cam0.mp4, cam1: cam1.mp4}}\n"
        "calibration: {rig: {given: rig.json}}\n"
    )
    assert devrf("report", tmp_path).code == 2  # nothing there
    write_json(tmp_path / "run/ingest/ingest.json", {"cameras": {}})
    assert devrf("report", tmp_path).code == 0
    assert "has not run" in Page((tmp_path / "run/report/index.html").read_text()).text
    assert devrf("status", tmp_path).code == 0


def test_the_page_as_a_file_leaves_the_run_as_it_is(tmp_path, devrf: Command):
    (tmp_path / "scene.yaml").write_text(
        "name: half\noutput: run\ncapture: {cameras: {cam0: cam0.mp4, cam1: cam1.mp4}}\n"
        "calibration: {rig: {given: rig.json}}\n"
    )
    page = tmp_path / "pages/half.html"
    assert devrf("report", tmp_path, "--out", page).code == 2  # nothing there
    write_json(tmp_path / "run/ingest/ingest.json", {"cameras": {}})
    before = sorted(tmp_path.rglob("run/**/*"))
    for _ in range(2):  # its own page is replaced
        assert devrf("report", tmp_path, "--out", page).code == 0
    assert "has not run" in Page(page.read_text()).text and sorted(tmp_path.rglob("run/**/*")) == before
    (tmp_path / "mine.html").write_text("<p>mine")
    assert devrf("report", tmp_path, "--out", tmp_path / "mine.html").code == 2
    assert (tmp_path / "mine.html").read_text() == "<p>mine"


def test_a_run_that_may_only_be_read_keeps_its_report(tmp_path, monkeypatch):
    """As of another user, or on a disk that is read-only; the administrator may write anywhere, so it is asked only."""
    (tmp_path / "report").mkdir()
    monkeypatch.setattr("os.access", lambda path, mode: True)
    assert not _report_is_left(tmp_path)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with refused("folder-unwritable", tmp_path, kind=InputError):
        _report_is_left(tmp_path)
    (tmp_path / "report" / "index.html").touch()
    assert _report_is_left(tmp_path)
    assert not _report_is_left(tmp_path / "gone")
