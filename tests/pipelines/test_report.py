"""The report: complete, self-contained, escaped, true to its files, and made from whatever there is."""

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from tests.pipelines.report_folder import NASTY, write_json, write_run

from devrf.pipelines.report import page as report_page
from devrf.pipelines.report.confidence import CURVES, confidence_section
from devrf.pipelines.report.page import SECTIONS, build_report
from devrf.pipelines.report.run import RunFolder
from devrf.pipelines.stages import STAGES, stage_names


class Page(HTMLParser):
    """Ids, links, quoted numbers, open tags at the end, and the text outside scripts and styles."""

    VOID = {"meta", "img", "br", "input", "line", "circle", "path"}

    def __init__(self, html: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.addresses: list[str] = []
        self.numbers: list[tuple[str, str, float]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        self.ids.update([values["id"]] if "id" in values else [])
        self.addresses += [values[k] for k in ("src", "href", "srcset", "action", "data") if k in values]
        if "data-key" in values:
            self.numbers.append((values["data-file"], values["data-key"], float(values["data-value"])))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        inside = self.open[-1] if self.open else ""
        (self.scripts if inside in ("script", "style") else self.words).append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def full_run(tmp_path_factory) -> Path:
    """A run folder with every artifact."""
    run = tmp_path_factory.mktemp("report") / "run"
    write_run(run)
    return run


def _page(run: Path, reasons: dict[str, str] | None = None, name: str = NASTY) -> tuple[str, Page]:
    html = build_report(RunFolder(run, stage_names(), reasons or {}), name)
    page = Page(html)
    assert page.open == [], f"never closed: {page.open}"
    return html, page


def test_every_section_is_there_and_none_is_empty(full_run):
    _, page = _page(full_run)
    assert {key for key, *_ in SECTIONS} <= page.ids
    for words in ("orbit.mp4", "Hold the camera still.", "not registered", "Metric scale"):
        assert words.lower() in page.text.lower()


def test_confidence_shows_pictures_curve_and_who_sees_it(full_run):
    html, page = _page(full_run)
    quoted = {key: value for file, key, value in page.numbers if file == "evaluate/metrics.json"}
    assert quoted["confidence.test.spearman"] == 0.625
    assert quoted["confidence.test_static.spearman"] == 0.375 and "held-out sweep" in page.text
    assert quoted["confidence.seen_by.0.expected_rms"] == 40.5
    assert html.count('alt="confidence picture"') == 2  # of the two test views in motion
    assert "measured error, grey levels" in html


@pytest.mark.parametrize(("curves", "said"), [({"test_static"}, 1), ({"test", "test_static"}, 1), (set(), 0)])
def test_held_out_sweep_pictures_stand_in_for_test_views(tmp_path, curves, said):
    """Without a test camera they are shown; where nothing moves they are the test views, and shown once."""
    bins = [{"share": 1.0, "expected_rms": 4.0, "measured_rms": 3.5}]
    found = {
        key: {"bins": bins, "expected_rms": 4.0} if key in curves else {"pixels": 0, "why": "none"}
        for key in CURVES
    }
    write_json(tmp_path / "evaluate/metrics.json", {"confidence": found})
    html = confidence_section(RunFolder(tmp_path, stage_names(), {}))
    assert len(re.findall(r'data-key="confidence\.\w+\.expected_rms"', html)) == said
    assert ("Not compared with true pictures: none" in html) == (not said)


def test_speed_is_shown_where_it_was_measured(full_run):
    _, page = _page(full_run)
    assert "speed" not in page.ids
    rows = [
        {"name": "speed/tiny/test/psnr", "value": 31.25, "why": None},
        {"name": "speed/tiny/test/lpips_vgg", "value": None, "why": "no weights"},
        {"name": "speed/tiny/seconds", "value": 44.0, "why": None},
    ]
    file = full_run.with_name(f"{full_run.name}-bench") / "speed.json"
    write_json(file, {"rows": rows, "curves": {"tiny": []}, "device": f"a device {NASTY}"})
    try:
        html, page = _page(full_run)
    finally:
        shutil.rmtree(file.parent)
    assert "speed" in page.ids and "Speed and accuracy" in page.text
    link = f"../../{full_run.name}-bench/speed.json"
    assert f'href="{link}"' in html and ">31.25<" in html and "no weights" in html
    assert NASTY in page.text


def test_stability_is_shown_where_it_was_measured(full_run):
    _, page = _page(full_run)
    assert "stability" not in page.ids
    file = full_run.with_name(f"{full_run.name}-bench") / "stability.json"
    cases = [
        {"axis": "undisturbed", "severity": 0.0, "psnr_moving": 26.0},
        {"axis": "blur", "severity": 1.0, "psnr_moving": 24.0},
        {"axis": "blur", "severity": 2.0, "psnr_moving": None},  # stopped
    ]
    notices = [NASTY, "two", "three", "four"]
    points = {"failure": 2.0, "notice": 1.0, "notices": notices, "lessened_db": 24.0}
    found = {
        "axes": {"blur": {"what": "motion blur", "unit": "px"}},
        "points": {"blur": points},
        "cases": cases,
    }
    heard = {"recall": 0.75, "broken": ["blur"], "precision": None, "spoken": []}
    write_json(file, {**found, "heard": heard, "bar_db": 23.0, "seeds": [0], "device": "a device"})
    try:
        html, page = _page(full_run)
    finally:
        shutil.rmtree(file.parent)
    assert "stability" in page.ids and "motion blur" in page.text and "and 1 more" in page.text
    assert f'href="../../{full_run.name}-bench/stability.json"' in html and "75 % of 1 axes" in page.text
    quoted = {key: value for name, key, value in page.numbers if name.endswith("stability.json")}
    assert quoted["points.blur.failure"] == 2.0 and quoted["points.blur.notice"] == 1.0 and NASTY in page.text


def test_a_page_that_would_be_too_large_gives_up_the_film_then_pictures_and_says_so(
    full_run, tmp_path, monkeypatch
):
    run = shutil.copytree(full_run, tmp_path / "run")
    (run / "render/orbit.mp4").write_bytes(bytes(100_000))
    whole, page = _page(run)
    assert "linked, not in" not in page.text and whole.count("data:video/mp4") == 1
    monkeypatch.setattr(report_page, "MAX_PAGE_BYTES", len(whole.encode()) - 1)
    linked, page = _page(run)
    assert "data:video/mp4" not in linked and "The film is linked, not in the page, to keep" in page.text
    assert linked.count("data:image") == whole.count("data:image")
    monkeypatch.setattr(report_page, "MAX_PAGE_BYTES", len(linked.encode()) - 1000)
    small, page = _page(run)
    assert len(small.encode()) <= len(linked.encode()) - 1000
    assert "The film is linked, not in the page, and pictures are fewer and smaller" in page.text
    assert "1 of 2 views are shown" in page.text


def test_the_method_of_the_flow_is_said(full_run):
    assert "Method: dis." in _page(full_run)[1].text


def test_needs_nothing_from_outside(full_run):
    html, page = _page(full_run)
    for address in page.addresses:
        assert address.startswith(("data:", "../", "#")), address[:80]
    outside_data = re.sub(r"data:[\w/]+;base64,[A-Za-z0-9+/=]+", "", html)
    assert "http" not in outside_data
    assert "@import" not in html and "url(" not in html


def test_linked_files_exist(full_run):
    _, page = _page(full_run)
    for address in page.addresses:
        if address.startswith("../"):
            assert (full_run / address[3:]).is_file(), address


def test_names_are_escaped(full_run):
    html, page = _page(full_run)
    assert "alert('x')" not in "".join(page.scripts)
    assert "<script>alert" not in html and "<b>ness" not in html
    assert NASTY in page.text  # shown as it was written


def test_numbers_are_those_of_the_files(full_run):
    _, page = _page(full_run)
    quoted = {(file, key) for file, key, _ in page.numbers}
    for key in (
        "test.psnr",
        "test_moving.psnr",
        "static_baseline.test_moving.psnr",
        "train.total_s",
        "model_mb",
    ):
        assert ("evaluate/metrics.json", key) in quoted
    for file, key, value in page.numbers:
        assert value == _entry(json.loads((full_run / file).read_text()), key), (file, key)


def _entry(value, key: str):
    while key:
        name = (
            next((k for k in value if key == k or key.startswith(f"{k}.")), None)
            if isinstance(value, dict)
            else None
        )
        head = name if name is not None else key.split(".")[0]
        value = value[head] if name is not None else value[int(head)]
        key = key[len(head) + 1 :]
    return value


class Sources(HTMLParser):
    """Of every number, table and figure: the stages of its section, and the files that it or its section links to."""

    SHOWN = {"table", "figure", "svg", "img", "video", "canvas"}

    def __init__(self, html: str) -> None:
        super().__init__()
        self.stages: list[tuple[str, tuple[str, ...]]] = []  # open tags, with the stages that count there
        self.shown: list[tuple[str, tuple[str, ...]]] = []
        self.numbers: list[tuple[str, tuple[str, ...]]] = []
        self.linked: dict[tuple[str, ...], set[str]] = {}
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        inside = self.stages[-1][1] if self.stages else ()
        inside = tuple(values["data-stages"].split()) if "data-stages" in values else inside
        if tag in self.SHOWN:
            self.shown.append((tag, inside))
        if "data-file" in values:
            self.numbers.append((values["data-file"], inside))
        if values.get("href", "").startswith("../"):
            self.linked.setdefault(inside, set()).add(values["href"][3:])
        if tag not in Page.VOID:
            self.stages.append((tag, inside))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in Page.VOID:
            self.stages.pop()

    def handle_endtag(self, tag):
        self.stages.pop()


def test_every_number_and_figure_can_be_traced_to_its_stage(full_run):
    html, page = _page(full_run)
    found = Sources(html)
    top: tuple[str, ...] = ()  # the summary, whose numbers and film are linked one by one
    assert {tag for tag, stages in found.shown if stages == top} <= {"table", "figure", "video"}
    assert len([1 for _, stages in found.shown if stages != top]) > 10 and len(found.numbers) > 50
    for file, stages in found.numbers:
        assert (full_run / file).is_file()
        assert stages == top or file.split("/")[0] in stages, f"{file} in a section of {stages}"
    for stages, links in found.linked.items():
        if stages != top:
            assert {f"{stage}/stamp.json" for stage in stages} <= links
    made = {f"{stage}/stamp.json" for stage in stage_names() if stage != "report"}
    assert made <= found.linked[top]  # the table of stages
    assert "made 2026-11-22 23:15:00 in run night-1" in page.text
    assert 'title="id id-evaluate"' in html


def test_a_stage_without_a_stamp_is_not_named_as_a_source(full_run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(full_run, copy)
    (copy / "ingest/stamp.json").unlink()
    (copy / "scene/stamp.json").write_text('{"id": "x"}')  # of an earlier version
    html, _ = _page(copy)
    assert "ingest/stamp.json" not in html and "scene/stamp.json" in html


def test_counts_have_no_decimals_and_measures_keep_theirs(tmp_path):
    counted = {"check": "views", "value": 147.0, "unit": "", "warn": 200.0, "fail": 0.25, "verdict": "warn"}
    rows = [counted, counted | {"check": "error", "value": 0.5}]
    write_json(tmp_path / "rig/health.json", {"stage": "rig", "rows": rows})
    _, page = _page(tmp_path)
    assert "views: 147 . " in page.text and "error: 0.500 . " in page.text
    assert "147.000" not in page.text and "200.00" not in page.text and "0.25" in page.text


def test_colours_are_shown_before_and_after(full_run):
    _, page = _page(full_run)
    for said in (
        "against the sweep",
        "−0.38 EV",
        "surface points",
        "one gain",
        "cam0: left as filmed, right as used",
        "not corrected",
    ):
        assert said in page.text, said


def test_what_has_not_run_is_said_of_one_stage_and_of_several(full_run, tmp_path):
    run = shutil.copytree(full_run, tmp_path / "run")
    for stage, said in (("flow", "flow has not run"), ("render", "flow, render have not run")):
        shutil.rmtree(run / stage)
        assert f"Not finished: {said}." in _page(run)[1].text


def test_an_empty_run_folder_says_what_is_missing(tmp_path):
    _, page = _page(tmp_path, name="empty")
    assert page.text.count("has not run") >= len(SECTIONS)
    assert not page.numbers


def test_stages_that_do_not_apply_say_why(tmp_path):
    reasons = {
        "sync": "only a sweep",
        "rig": "only a sweep",
        "flow": "only a sweep",
        "deformation": "only a sweep",
    }
    _, page = _page(tmp_path, reasons)
    assert page.text.lower().count("does not apply: only a sweep") >= 2 * len(reasons)


FILES = (
    "ingest/ingest.json",
    "static_poses/static_poses.json",
    "sync/sync.json",
    "rig/rig.json",
    "scene/scene.json",
    "flow/flow.json",
    "canonical/metrics.json",
    "deformation/metrics.json",
    "evaluate/metrics.json",
    "scene/health.json",
    "scene/stamp.json",
)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("content", ["{", "[]", '{"cameras": []}'])
def test_no_damaged_file_stops_it(full_run, tmp_path, file, content):
    for entry in full_run.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    stage, name = file.split("/")
    (tmp_path / stage).unlink(missing_ok=True)
    (tmp_path / stage).mkdir()
    for entry in (full_run / stage).iterdir() if (full_run / stage).is_dir() else []:
        (tmp_path / stage / entry.name).symlink_to(entry)
    (tmp_path / file).unlink(missing_ok=True)
    (tmp_path / file).write_text(content)
    _, page = _page(tmp_path)
    if content == "{":
        named = f"{file} cannot be read" in page.text or f"{stage}/ cannot be read" in page.text
        assert named
    assert "cannot be made" not in page.text


def test_curves_are_drawn(full_run):
    html, page = _page(full_run)
    for words in ("PSNR of training rays, dB", "cam0 and wit<b>ness: audio", "level 2", "PSNR, dB"):
        assert words in page.text
    assert html.count('<figure class="chart') - html.count('<figure class="chart plot') == 2 * 2 + 1 + 1 + 1


def test_size_stays_small(full_run):
    html, _ = _page(full_run)
    assert len(html) < 1_000_000


def test_stage_is_in_the_pipeline():
    stage = next(s for s in STAGES if s.name == "report")
    assert set(stage.reads) == set(stage_names()) - {"report"}


def test_command_reports_a_run_that_has_not_come_to_its_end(tmp_path):
    for name in ("cam0", "cam1"):
        (tmp_path / f"{name}.mp4").touch()
    (tmp_path / "rig.json").touch()
    (tmp_path / "scene.yaml").write_text(
        "name: half\noutput: run\ncapture: {cameras: {cam0: cam0.mp4, cam1: cam1.mp4}}\n"
        "calibration: {rig: {given: rig.json}}\n"
    )

    def command(word: str) -> int:
        line = [sys.executable, "-m", "devrf.pipelines.cli", word, str(tmp_path)]
        return subprocess.run(line, capture_output=True, timeout=60).returncode

    assert command("report") == 2  # nothing there
    write_json(tmp_path / "run/ingest/ingest.json", {"cameras": {}})
    assert command("report") == 0
    assert "has not run" in Page((tmp_path / "run/report/index.html").read_text()).text
    assert command("status") == 0
