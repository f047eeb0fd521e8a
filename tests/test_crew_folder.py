"""A folder as a stranger brings it home: `init`, `check` and `ingest` name each oddity once, and rightly.

A film of a 360° camera, phones held three ways, photos of which some are there twice, and names of another alphabet.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from tests.capture.test_projection import all_around
from tests.conftest import Command
from tests.make.clips import film
from tests.test_bad_input import SIZE, draw, places, texture

PHOTOS, COPIES = 24, (3, 8)
HELD_DEG = {"левый": 0, "правый": 90, "верхний": 180}  # how the phone's file says to turn its pictures
FRAMES = 24


@pytest.fixture(scope="module")
def brought(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder; phones see the upright scene whichever way they are held."""
    folder = tmp_path_factory.mktemp("brought") / "Съёмка во дворе"
    photos = folder / "Фото"
    photos.mkdir(parents=True)
    rng, target = np.random.default_rng(0), np.array([0.35, 0.35, 0.6])
    walls = [texture(rng) for _ in range(3)]
    for n, place in enumerate(places(PHOTOS)):
        cv2.imwrite(str(photos / f"IMG_{n:04d}.jpg"), draw(walls, place, target)[:, :, ::-1])
    for n in COPIES:
        shutil.copy(photos / f"IMG_{n:04d}.jpg", photos / f"IMG_{n:04d} (1).jpg")
    for place, (name, held_deg) in zip(places(9)[2::2], HELD_DEG.items(), strict=False):
        view, shown = draw(walls, place, target), []
        for n in range(FRAMES):
            picture = view.copy()
            cv2.circle(picture, (90 + 5 * n, 140), 18, (230, 60, 40), -1)
            shown.append(picture[:, 70:250] if held_deg == 90 else picture)
        stored = [np.rot90(picture, -held_deg // 90) for picture in shown]
        film(folder / f"{name}.mp4", stored, rate=12, rotation=held_deg)
    film(folder / "VID_360.mp4", [all_around(0.1 * n) for n in range(12)], rate=12)
    return folder


@pytest.mark.full
def test_a_folder_as_a_stranger_brings_it(brought: Path, devrf: Command) -> None:
    done = devrf("init", brought)
    assert done.code == 0, done.said
    capture = yaml.safe_load((brought / "scene.yaml").read_text("utf-8"))["capture"]
    assert capture["static"] == "Фото"
    assert sorted(capture["cameras"].values()) == sorted(f"{name}.mp4" for name in HELD_DEG)
    (line,) = [line for line in done.out.splitlines() if "VID_360.mp4" in line]
    assert "equirectangular" in line and line.count("VID_360.mp4") == 1
    assert done.out.count("copies of others") == 1 and "2 of them are copies" in done.out

    file = brought / "check.json"
    done = devrf("check", brought / "scene.yaml", "--preset", "tiny", "--json", file)
    assert done.code == 0, done.said
    odd = {row["code"] for row in json.loads(file.read_text("utf-8"))["rows"] if row["verdict"] != "ok"}
    assert odd == {
        "rest-unseen",
        "clock-unknown",
        "scale",
    }  # they move from the first picture on; no sound; no ruler

    done = devrf("run", brought / "scene.yaml", "--until", "ingest", "--preset", "tiny")
    assert done.code == 0, done.said
    (log,) = brought.rglob("devrf.log")
    assert log.parent.name == "Съёмка-во-дворе"
    cameras = json.loads((log.parent / "ingest" / "ingest.json").read_text("utf-8"))["cameras"]
    assert {name: camera["rotation_deg"] for name, camera in cameras.items()} == {"static": 0, **HELD_DEG}
    assert {name: (camera["width"], camera["height"]) for name, camera in cameras.items()} == {
        "static": SIZE,
        "левый": SIZE,
        "правый": (180, 240),
        "верхний": SIZE,
    }
    notes = [note for camera in cameras.values() for note in camera["notes"]]
    for said in ("2 of 26 photos are copies", "turned by 90 degrees", "turned by 180 degrees"):
        assert sum(said in note for note in notes) == 1
    assert sum(frame["used"] for frame in cameras["static"]["frames"]) == PHOTOS
    assert not any(camera["faults"] for camera in cameras.values())
