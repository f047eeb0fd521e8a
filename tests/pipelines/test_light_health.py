"""Rows about light: what a fault says, and silence where there is none."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import Command

from devrf.calibration.colour.flicker import Change, Flicker, LightFound, judge_light
from devrf.capture.colour.light_course import LightCourse
from devrf.capture.colour.srgb import srgb_from_linear
from devrf.capture.photos.raw_set import develop_set, read_raw_sidecar
from devrf.capture.video.video_writer import write_video
from devrf.lab.simulate.session.dng import DngTags, mosaic, write_dng
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.health.light_rows import changes_alike, clip_measures, exposure_measures, raw_measures

LEVELS = {"black": (512, 512, 512, 512), "white": 16383}


def picture(gain: float = 1.0) -> np.ndarray:
    """Light from 0.002 to 0.8 over the picture, with a sensor's noise: 2 % of the value and 3 of 16383."""
    light = gain * np.geomspace(0.002, 0.8, 64)[None, :, None] * np.ones((48, 1, 3))
    noise = np.random.default_rng(0).standard_normal(light.shape)
    return np.maximum(light + (0.02 * light + 3 / 16383) * noise, 0)


def rows_of(tmp_path: Path, files: list[dict]) -> list[HealthRow]:
    """Through the real door: DNG files, developed as ingest does."""
    for n, file in enumerate(files):
        known = {**LEVELS, "raw": mosaic(picture(), "RGGB", LEVELS["black"], LEVELS["white"]), **file}
        write_dng(tmp_path / f"IMG_{n}.dng", known.pop("raw"), DngTags(**known))
    jobs = [(n, tmp_path / f"IMG_{n}.dng") for n in range(len(files))]
    develop_set(jobs, tmp_path / "out", "static")
    return judge(raw_measures("static", read_raw_sidecar(tmp_path / "out" / "raw" / "static.json")))


def test_healthy_photos_fire_nothing(tmp_path):
    assert rows_of(tmp_path, [{}, {}, {}]) == []


@pytest.mark.parametrize(
    ("file", "code", "says", "verdict"),
    [
        ({"neutral": (0.5, 1.0, 0.6)}, "noted", "white balance", "ok"),
        ({"orientation": 6}, "noted", " 0 degrees", "ok"),
        ({"white": 15000}, "coding", "16383 ", "warn"),
        ({"black": (2000, 2000, 2000, 2000)}, "coding", "black level", "warn"),
    ],
)
def test_a_photo_unlike_the_others_is_named(tmp_path, file, code, says, verdict):
    (row,) = rows_of(tmp_path, [{}, {}, {}, file])
    assert (row.code, row.about, row.verdict) == (code, "static", verdict)
    assert bool(row.remedy) == (verdict == "warn")
    assert isinstance(row.value, str) and "1 of 4 files" in row.value
    assert says in row.value and row.value.endswith("IMG_3.dng")


@pytest.mark.parametrize(
    ("stops", "alike"),
    [
        ((-0.15, -0.12, -0.11, -0.12), True),
        ((-0.15, -0.12, 0.11, -0.12), False),  # one the other way: its own doing
        ((-0.15, -0.12, None, -0.12), False),
        ((-0.15, -0.12, -1.5, -0.12), False),
        ((-0.15, -0.12), False),  # two may agree by chance
        ((None, None, None), False),
        ((), False),
    ],
)
def test_light_that_all_cameras_see_change_is_the_scene_s(stops, alike):
    changes = [None if s is None else Change(s, 0.5, 1.2) for s in stops]
    found = {f"cam{n}": LightFound(None, change, None) for n, change in enumerate(changes)}
    assert changes_alike(found) == alike


def test_exposure_of_photos_by_their_settings():
    alike = {f"IMG_{n}": -9.0 for n in range(6)}
    assert exposure_measures("static", alike) == [] and exposure_measures("static", {"IMG_0": None}) == []
    (row,) = judge(exposure_measures("static", {**alike, "IMG_7": -8.0, "IMG_8": None}))
    assert row.verdict == "warn" and re.fullmatch("1 of 7 photos .* 1.0 EV .*: IMG_7", str(row.value))


def test_highlights_and_levels_of_a_set(tmp_path):
    bright = mosaic(np.minimum(picture(2.0), 1), "RGGB", LEVELS["black"], LEVELS["white"])
    (row,) = rows_of(tmp_path, [{"raw": bright}, {}])
    assert row.code == "highlights" and " 1 % " in str(row.value)
    (row,) = rows_of(tmp_path, [{"raw": np.minimum(bright, 14000)}] * 2)  # saturates below what the file says
    assert row.code == "coding" and " 14000, " in str(row.value)
    (row,) = rows_of(tmp_path, [{"black": (0, 0, 0, 0)}] * 2)
    assert row.code == "coding" and " 3" in str(row.value)


def test_rows_of_clips():
    assert list(clip_measures("cam1", "cam1.mp4", LightFound(None, None, None))) == []
    light = LightFound(Flicker(9.92, 0.105), Change(0.4, 2.1, 5.0), Change(-0.16, 3.0, 3.05), 0.06)
    exposure, colour, lamps = judge(clip_measures("cam1", "cam1.mp4", light))
    assert re.fullmatch(r"\+0.40 EV .* 2.10 and 5.00 s; .* 4 %", str(exposure.value))
    assert "cam1.mp4" in exposure.remedy
    assert re.fullmatch(".* -10 % at 3.00 s; .* 4 %", str(colour.value))
    assert re.search("10 %.* 9.92 ", str(lamps.value)) and "1/50 or 1/100 s" in lamps.remedy


def test_light_that_gains_make_up_for_is_no_warning_but_in_test_pictures():
    """They are compared as they were filmed."""
    light = LightFound(None, Change(0.4, 2.1, 5.0), None, left=0.02)
    (row,) = judge(clip_measures("cam1", "cam1.mp4", light))
    assert row.verdict == "ok" and ": 1.4 % " in str(row.value)
    (row,) = judge(clip_measures("cam1", "cam1.mp4", light, trains=False))
    assert row.verdict == "warn" and "1.4 %" not in str(row.value) and row.remedy


def test_a_session_with_faults_of_light(devrf: Command, tmp_path):
    """Through the command line: clips that change their light, RAW photos as sweep and as board stills."""
    rng = np.random.default_rng(0)
    wall = rng.uniform(0.05, 0.35, (12, 16, 3)).repeat(10, axis=0).repeat(10, axis=1)
    time_s = np.arange(50) / 25
    lights = {
        "cam0": np.exp2(0.4 * np.clip(time_s - 0.5, 0, 1))[:, None] * np.ones(3),
        "cam1": np.exp2(np.clip(time_s - 0.5, 0, 1)[:, None] * np.array([0.12, 0.0, -0.12])),
        "cam2": (1 + 0.05 * np.sin(2 * np.pi * 120 * time_s))[:, None] * np.ones(3),
        "cam3": np.ones((50, 3)),
    }
    for name, light in lights.items():
        moving = [wall.copy() for _ in light]
        for n, scene in enumerate(moving):
            scene[30:70, 2 * n : 2 * n + 30] = 0.5
        write_video(
            tmp_path / f"{name}.mp4",
            (
                np.clip(
                    255 * srgb_from_linear(np.minimum(scene * gain, 1)) + rng.normal(size=wall.shape), 0, 255
                )
                .round()
                .astype(np.uint8)
                for scene, gain in zip(moving, light, strict=True)
            ),
            25.0,
        )
    for folder, count in (("sweep", 3), ("board", 2)):
        (tmp_path / folder).mkdir()
        for n in range(count):
            raw = mosaic(picture(1 - 0.1 * n), "RGGB", LEVELS["black"], LEVELS["white"])
            neutral = (0.5, 1.0, 0.6) if n == 2 else (1.0, 1.0, 1.0)
            exposure_s = 0.02 if n == 2 else 0.01
            write_dng(
                tmp_path / folder / f"IMG_{n}.dng",
                raw,
                DngTags(neutral=neutral, exposure_s=exposure_s, **LEVELS),
            )
    (tmp_path / "scene.yaml").write_text(
        "name: light\noutput: run\ncapture:\n  static: sweep\n"
        "  cameras: {cam0: cam0.mp4, cam1: cam1.mp4, cam2: cam2.mp4, cam3: cam3.mp4}\n"
        "  raw: {white_balance: [2, 1, 1, 1]}\n"
        "  board: {squares: [8, 6], square_m: 0.06, marker_m: 0.045, clips: {cam0: board}}\n"
    )
    result = devrf("run", tmp_path, "--until", "ingest")
    assert result.code == 0, result.said
    out = tmp_path / "run" / "ingest"
    rows = [row for row in json.loads((out / "health.json").read_text())["rows"] if row["code"] != "noted"]
    of_light = {row["about"]: row["value"] for row in rows if row["code"] == "light-changes"}
    assert of_light["cam0"].startswith("+0.4") and "gains" in of_light["cam0"]
    assert re.search(r" [+-]\d+ % ", of_light["cam1"]) and " times a second" in of_light["cam2"]
    assert "1 of 3 photos are exposed unlike most, up to 1.0 EV" in of_light["static"]
    assert of_light.keys() == {"cam0", "cam1", "cam2", "static"}
    assert not [row for row in rows if row["code"] == "highlights" and row["about"] == "cam3"]
    for name, count in (("static", 3), ("board_cam0", 2)):
        assert len(list((out / "frames" / name).glob("*.png"))) == count
        assert read_raw_sidecar(out / "raw" / f"{name}.json")["recipe"]["white_balance"] == [2, 1, 1, 1]
    assert judge_light(LightCourse.read(out / "light" / "cam3.npy")).steady
