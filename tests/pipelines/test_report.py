"""The report: complete, self-contained, escaped, true to its files, and made from whatever there is."""

import json
import re
import shutil
import struct
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from pydantic import BaseModel

from devrf.capture.camera import Camera
from devrf.capture.formats import write_scene
from devrf.capture.look import Look
from devrf.capture.scene import PosedFrame, Scene
from devrf.flow.store import BEST, pair_path, write_pair
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.report.page import SECTIONS, build_report
from devrf.pipelines.report.run import RunFolder
from devrf.pipelines.stages import STAGES, stage_names

NASTY = "<script>alert('x')</script> & \"friends\""
WIDTH, HEIGHT = 48, 36


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
    """A run folder with every artifact, as docs/formats.md describes them."""
    run = tmp_path_factory.mktemp("report") / "run"
    rng = np.random.default_rng(0)
    cameras = {"static": 6, "cam0": 4, "wit<b>ness": 4}
    frames: dict[str, list[Path]] = {}
    for name, count in cameras.items():
        folder = run / "ingest" / "frames" / name
        folder.mkdir(parents=True)
        frames[name] = [folder / f"{n:06d}.png" for n in range(count)]
        for path in frames[name]:
            cv2.imwrite(str(path), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    _json(
        run / "ingest/ingest.json",
        {
            "cameras": {
                name: {
                    "role": "sweep" if name == "static" else "camera",
                    "source": f"raw/{name}.mp4",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "fps_mean": 29.97,
                    "variable_rate": name == "cam0",
                    "has_audio": True,
                    "exif_focal_px": None,
                    "rotation_deg": 0,
                    "frames": [
                        {"index": n, "time_s": n / 30, "sharpness": 1.0, "used": True,
                         "file": f"frames/{name}/{n:06d}.png"}
                        for n in range(count)
                    ],
                    "notes": [NASTY],
                }
                for name, count in cameras.items()
            }
        },
    )  # fmt: skip
    _json(
        run / "static_poses/static_poses.json",
        {"registered": 6, "given": 7, "mean_reprojection_px": 0.512, "mean_track_length": 4.2,
         "median_triangulation_angle_deg": 8.5, "points": 3, "models": [6], "mapper": "incremental",
         "frames": {}, "cameras": {}, "unregistered": ["static/000006.png"]},
    )  # fmt: skip
    points = struct.pack("<Q", 3)
    for n in range(3):
        points += struct.pack("<QdddBBBdQ", n, n, 0.0, 1.0, 9, 8, 7, 0.3, 0)
    (run / "static_poses/colmap").mkdir()
    (run / "static_poses/colmap/points3D.bin").write_bytes(points)
    write_scene(run / "scene", _scene(frames))
    _json(
        run / "rig/rig.json",
        {
            "cameras": {
                "cam0": {"model": "OPENCV", "K": [[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]],
                         "distortion": [0] * 5, "width": WIDTH, "height": HEIGHT,
                         "std": {"rotation_deg": 0.031, "position": 0.0021},
                         "intrinsics": "board", "inliers": 321, "rms_px": 0.25}
            },
            "scale": {"metric": True, "source": "board", "factor": 2.0, "std": 0.004},
        },
    )  # fmt: skip
    _json(
        run / "sync/sync.json",
        {
            "cameras": {
                "cam0": {"offset_s": 0.0, "drift_ppm": 0.0, "std_s": 0.0, "method": "reference",
                         "confidence": 1.0, "basis": "the reference"},
                "wit<b>ness": {"offset_s": -0.125, "drift_ppm": 23.5, "std_s": 0.00025, "method": "audio",
                               "confidence": 0.97, "basis": NASTY},
            },
            "reference": "cam0", "loop_s": None, "notes": [],
        },
    )  # fmt: skip
    curve = {
        "first": "cam0",
        "second": "wit<b>ness",
        "method": "audio",
        "delay_s": -0.125,
        "quality": 9.0,
        "accepted": True,
        "lags_s": [-0.25, -0.125, 0.0, 0.125],
        "values": [0.0, 1.0, 0.1, 0.0],
    }
    _json(run / "sync/curves.json", {"curves": [curve]})
    for stage in ("canonical", "deformation"):
        rows = [
            {"iteration": n, "seconds": n, "level": n // 2, "psnr": 20.0 + n, "mse": 0.01 / (n + 1)}
            for n in range(4)
        ]
        _json(run / stage / "metrics.json", {"seconds": 100.5, "iterations": 4, "curve": rows})
    flow = np.zeros((3, HEIGHT, WIDTH, 2), np.float32)
    flow[1, 5:20, 5:20] = (3.0, -1.0)
    valid = np.ones((3, HEIGHT, WIDTH), bool)
    for n in range(3):
        write_pair(pair_path(run / "flow", "cam0", n + 1), flow[n], BEST * valid[n].astype(np.uint8), {})
    _json(
        run / "flow/flow.json",
        {"method": "dis", "cameras": {"cam0": {"pairs": 3, "gaps": 0, "supported": 0.9, "valid": 0.81,
                                               "moving": 0.1, "moving_valid": 0.7, "round_trip_px": 0.2,
                                               "warp_ratio": 0.4, "large": 0.0}}},
    )  # fmt: skip
    _write_evaluate(run, rng)
    (run / "render").mkdir()
    (run / "render/orbit.mp4").write_bytes(b"not really a film")
    _json(
        run / "colour/colour.json",
        {"reference": "static", "total": {"points": 40, "before": 0.0625, "after": 0.015625}, "cameras": {
            "static": {"source": "reference", "kind": "none"},
            "cam0": {"source": "points", "kind": "gain", "stops": -0.375, "fitted": 120,
                     "apart": {"points": 40, "before": 0.0625, "after": 0.015625}},
            "wit<b>ness": {"source": "none", "kind": "none", "stops": 0.125, "fitted": 0,
                           "apart": {"points": 30, "before": 0.03125, "after": 0.03125}}}},
    )  # fmt: skip
    for stage in stage_names():
        if (run / stage).is_dir():
            stamp = {
                "id": f"id-{stage}",
                "run": "night-1",
                "finished": "2026-11-22 23:15:00",
                "seconds": 12.5,
            }
            _json(run / stage / "stamp.json", stamp | {"identity": {}})
            _json(run / stage / "health.json", {"stage": stage, "rows": [_row("ok"), _row("warn")]})
    return run


def _scene(frames: dict[str, list[Path]]) -> Scene:
    K = np.array([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]])

    def posed(name: str, n: int, split: str, time: float | None) -> PosedFrame:
        pose = np.column_stack([np.eye(3), [0.1 * n, 0.0, 2.0]])
        camera = Camera(WIDTH, HEIGHT, K, pose)
        look = Look(gains=(1.25, 1.25, 1.25)) if name == "cam0" else None
        return PosedFrame(frames[name][n], camera, name, n, time, time, split, look=look)  # type: ignore[arg-type]

    return Scene(
        static=tuple(posed("static", n, "test" if n == 0 else "train", None) for n in range(6)),
        dynamic=tuple(
            posed(name, n, "train" if name == "cam0" else "test", n / 3)
            for name in frames
            if name != "static"
            for n in range(4)
        ),
        box_from_world=np.diag([2.0, 2.0, 2.0, 1.0]),
        aabb=np.array([[-1.0, -1, -1], [1, 1, 1]]),
        near=0.5,
        far=6.0,
        kind="inward",
        background="shell",
        t0_s=0.0,
        t1_s=1.0,
        rest_time=0.0,
        image_scale=1.0,
        metric=True,
    )


def _write_evaluate(run: Path, rng: np.random.Generator) -> None:
    views = []
    for camera, n, time in [("wit<b>ness", 0, 0.0), ("wit<b>ness", 1, 0.5), ("static", 0, None)]:
        files = {}
        for kind in ("true", "rendered", "error", "rest"):
            path = run / "evaluate" / "views" / camera / f"{n:06d}_{kind}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
            files[kind] = path.relative_to(run / "evaluate").as_posix()
        view = {"camera": camera, "index": n, "time": time, "time_s": time, "psnr": 24.5 + n, "ssim": 0.812}
        if time is not None:
            view["static_baseline"] = {"psnr": 19.25, "ssim": 0.7}
        views.append({**view, **files})
    block = {
        "psnr": 25.0625,
        "ssim": 0.8125,
        "lpips_vgg": None,
        "views": 2,
        "why": {"lpips_vgg": "no weights"},
    }
    _json(
        run / "evaluate/metrics.json",
        {
            "test": block,
            "test_static": {**block, "psnr": 27.375},
            "test_moving": {"psnr": 22.75, "ssim": 0.75},
            "static_baseline": {"test": {"psnr": 21.0}, "test_moving": {"psnr": 17.5}},
            "per_view": views,
            "train": {"canonical_s": 100.5, "deformation_s": 200.25, "total_s": 300.75, "iterations": 1000,
                      "rays_per_s": 12345.6, "peak_gpu_gb": None, "peak_rss_gb": 1.25, "device": "cpu"},
            "model_mb": 12.25,
            "render_fps": 0.125,
            "versions": {"devrf": "0.1.0"},
            "seed": 7,
            "truth": {"pose_rotation_deg": 0.0625, "rig_position_m": 0.0078125, "sync_ms": 0.25},
        },
    )  # fmt: skip


def _row(verdict: str) -> dict:
    return {"check": f"a check {NASTY}", "value": 0.5, "unit": "px", "warn": 0.4, "fail": None,
            "verdict": verdict, "remedy": "" if verdict == "ok" else "Hold the camera still."}  # fmt: skip


def _json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


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


def test_speed_is_shown_where_it_was_measured(full_run):
    _, page = _page(full_run)
    assert "speed" not in page.ids
    rows = [
        {"name": "speed/tiny/test/psnr", "value": 31.25, "why": None},
        {"name": "speed/tiny/test/lpips_vgg", "value": None, "why": "no weights"},
        {"name": "speed/tiny/seconds", "value": 44.0, "why": None},
    ]
    file = full_run.with_name(f"{full_run.name}-bench") / "speed.json"
    _json(file, {"rows": rows, "curves": {"tiny": []}, "device": f"a device {NASTY}"})
    try:
        html, page = _page(full_run)
    finally:
        shutil.rmtree(file.parent)
    assert "speed" in page.ids and "Speed and accuracy" in page.text
    link = f"../../{full_run.name}-bench/speed.json"
    assert f'href="{link}"' in html and ">31.25<" in html and "no weights" in html
    assert NASTY in page.text


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
    _json(tmp_path / "rig/health.json", {"stage": "rig", "rows": rows})
    _, page = _page(tmp_path)
    assert "views: 147. " in page.text and "error: 0.500. " in page.text
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
    assert html.count('<figure class="chart">') == 2 * 2 + 1 + 1


def test_size_stays_small(full_run):
    html, _ = _page(full_run)
    assert len(html) < 1_000_000


def test_stage_is_in_the_pipeline():
    stage = next(s for s in STAGES if s.name == "report")
    assert set(stage.reads) == set(stage_names()) - {"report"}


def test_formats_page_lists_every_key_and_its_default():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    rows = {m[1]: m[2] for m in re.finditer(r"^\| `([a-z_.]+)` \| [^|]* \| ([^|]*) \|", page, flags=re.M)}
    for key, default in _keys(SceneConfig):
        assert key in rows, f"{key} is not in docs/formats.md"
        if isinstance(default, (str, int)) and not isinstance(default, bool):
            assert f"`{default}`" in rows[key], f"{key}: default {default}, docs/formats.md says {rows[key]}"


def _keys(model: type[BaseModel], prefix: str = "") -> list[tuple[str, object]]:
    found = []
    for name, field in model.model_fields.items():
        kinds = (field.annotation, *get_args(field.annotation))
        inner = [a for a in kinds if isinstance(a, type) and issubclass(a, BaseModel)]
        if inner and not field.is_required() and field.default is not None:
            found += _keys(inner[0], f"{prefix}{name}.")
        else:
            found.append((f"{prefix}{name}", field.default))
            found += _keys(inner[0], f"{prefix}{name}.") if inner else []
    return found


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
    _json(tmp_path / "run/ingest/ingest.json", {"cameras": {}})
    assert command("report") == 0
    assert "has not run" in Page((tmp_path / "run/report/index.html").read_text()).text
    assert command("status") == 0
