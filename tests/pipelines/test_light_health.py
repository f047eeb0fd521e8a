"""Rows about light: what a fault says, and silence where there is none."""

from pathlib import Path

import numpy as np
import pytest
from tests.capture.dng import mosaic, write_dng

from devrf.calibration.flicker import Change, Flicker, LightFound
from devrf.capture.raw_set import RawOptions, develop_set, read_raw_sidecar
from devrf.pipelines.health import HealthRow
from devrf.pipelines.light_health import clip_rows, raw_rows

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
        write_dng(tmp_path / f"IMG_{n}.dng", **known)
    jobs = [(n, tmp_path / f"IMG_{n}.dng") for n in range(len(files))]
    develop_set(jobs, tmp_path / "out", "static", RawOptions())
    return raw_rows("static", read_raw_sidecar(tmp_path / "out" / "raw" / "static.json"))


def test_healthy_photos_fire_nothing(tmp_path):
    assert rows_of(tmp_path, [{}, {}, {}]) == []


@pytest.mark.parametrize(
    ("file", "check", "says", "verdict"),
    [
        ({"neutral": (0.5, 1, 0.6)}, "white balance of RAW photos", "another white balance", "ok"),
        ({"orientation": 6}, "turn of RAW photos", "turned by 0 degrees", "ok"),
        ({"white": 15000}, "white level of RAW photos", "16383 is used for all", "warn"),
        ({"exposure_s": 0.02}, "exposure of RAW photos", "up to 1.0 EV apart", "warn"),
        ({"black": (2000, 2000, 2000, 2000)}, "black level of RAW photos", "below their black level", "warn"),
    ],
)
def test_a_photo_unlike_the_others_is_named(tmp_path, file, check, says, verdict):
    (row,) = rows_of(tmp_path, [{}, {}, {}, file])
    assert (
        row.check == f"{check}, static" and row.verdict == verdict and bool(row.remedy) == (verdict == "warn")
    )
    assert isinstance(row.value, str) and "1 of 4 files" in row.value
    assert says in row.value and row.value.endswith("IMG_3.dng")


def test_highlights_and_levels_of_a_set(tmp_path):
    bright = mosaic(np.minimum(picture(2.0), 1), "RGGB", LEVELS["black"], LEVELS["white"])
    (row,) = rows_of(tmp_path, [{"raw": bright}, {}])
    assert row.check == "highlights of RAW photos, static" and "more than 1 % of the picture at white" in str(
        row.value
    )
    (row,) = rows_of(tmp_path, [{"raw": np.minimum(bright, 14000)}] * 2)  # saturates below what the file says
    assert row.check == "white level of RAW photos, static" and "saturate at 14000, below" in str(row.value)
    (row,) = rows_of(tmp_path, [{"black": (0, 0, 0, 0)}] * 2)
    assert row.check == "black level of RAW photos, static" and "nothing is darker than 3" in str(row.value)


def test_rows_of_clips():
    assert clip_rows("cam1", "cam1.mp4", LightFound(None, None, None, 1.0)) == []
    exposure, colour, lamps = clip_rows(
        "cam1",
        "cam1.mp4",
        LightFound(Flicker(100.0, 9.92, 0.105), Change(0.4, 2.1, 5.0), Change(-0.16, 3.0, 3.05), 1.0),
    )
    assert exposure.value == "+0.40 EV between 2.10 and 5.00 s" and "cam1.mp4" in exposure.remedy
    assert colour.value == "red or blue against green -10 % at 3.00 s"
    assert (
        str(lamps.value).startswith("flicker by 10 % on mains of 50 Hz") and "1/50 or 1/100 s" in lamps.remedy
    )
    (hidden,) = clip_rows("cam1", "cam1.mp4", LightFound(None, None, None, 0.2))
    assert hidden.verdict == "ok" and "not measured" in str(hidden.value)
