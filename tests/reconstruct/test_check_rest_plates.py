"""Clean plates against the scene at rest: quiet where cameras are right, and each fault named for what it is."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift
from tests.make.models import moving_ball

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.health.at_rest_rows import (
    LEAST_TEXTURED,
    MOST_ODD,
    MOST_OF_PLATE,
    MOST_OF_REST,
    MOSTLY,
    at_rest_measures,
)
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.reconstruct.evaluation.aligned import aligned
from devrf.reconstruct.evaluation.check_rest import PlateFit, RestCheck, RestFit, check_rest
from devrf.reconstruct.evaluation.displacement import Displacement

WIDTH, HEIGHT, COUNT, RESTS = 128, 96, 21, 4
CAMERA = Camera(
    WIDTH, HEIGHT, np.array([[120.0, 0, 64], [0, 120, 48], [0, 0, 1]]), np.eye(3, 4) + 3 * np.eye(3, 4, 3)
)
SWEEP = [RestFit(32.0, Displacement(0.001, 0.0003), 0.01)] * 4


def room(seed: int = 0) -> np.ndarray:
    """A picture with texture of several sizes."""
    rng = np.random.default_rng(seed)
    sizes = [gaussian_filter(rng.standard_normal((HEIGHT, WIDTH, 3)), (s, s, 0)) * s for s in (1, 2, 5)]
    return (0.5 + 0.3 * np.sum(sizes, axis=0)).clip(0.1, 0.75)


ROOM = room()
PLAIN = np.full_like(ROOM, 0.6)
Change = Callable[[np.ndarray, int], np.ndarray]


def filmed(folder: Path, change: Change, stands: np.ndarray = ROOM) -> Scene:
    """A clip in which a square rests and then crosses the picture, and a sweep; `change` gets each of its pictures."""
    folder.mkdir()
    rng = np.random.default_rng(1)

    def saved(name: str, picture: np.ndarray) -> Path:
        noisy = picture + 0.005 * rng.standard_normal(picture.shape)
        cv2.imwrite(str(folder / name), (255 * noisy[..., ::-1]).round().clip(0, 255).astype(np.uint8))
        return folder / name

    dynamic = []
    for n in range(COUNT):
        picture, x = stands.copy(), 10 + 5 * max(0, n - RESTS + 1)
        picture[40:60, x : x + 20] = [0.9, 0.2, 0.1]
        path = saved(f"{n}.png", change(picture, n))
        dynamic.append(PosedFrame(path, CAMERA, "cam0", n, n / 10, n / (COUNT - 1), "train"))
    static = []
    for n in range(4):
        blurred = gaussian_filter(stands, (0.7, 0.7, 0))
        static.append(PosedFrame(saved(f"s{n}.png", blurred), CAMERA, "static", n, None, None, "test"))
    return Scene(
        tuple(static), tuple(dynamic), np.eye(4), np.array([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]]), 0.3, 9.0, "inward",
        "shell", 0.0, 2.0, 0.0, 1.0,
    )  # fmt: skip


def told(scene: Scene, stands: np.ndarray = ROOM) -> tuple[PlateFit, dict[str, HealthRow]]:
    """What is measured of the one camera, and its rows by their codes."""
    plates, rows = checked(scene, stands)
    return plates["cam0"], {row.code: row for row in rows}


def checked(scene: Scene, stands: np.ndarray = ROOM) -> tuple[dict[str, PlateFit], list[HealthRow]]:
    """What is measured against a model that shows what stands and the square at rest, blurred a little; the rows."""
    shown = stands.copy()
    shown[40:60, 10:30] = [0.9, 0.2, 0.1]
    rendered = gaussian_filter(shown, (0.7, 0.7, 0)).astype(np.float32)
    return plates_of(scene, rendered)


def plates_of(scene: Scene, rendered: np.ndarray) -> tuple[dict[str, PlateFit], list[HealthRow]]:
    """What is measured of plates against what a model shows, and the rows about them alone."""
    found = check_rest(scene, moving_ball("shell").rest, lambda camera: rendered)
    plates = dict(found.plates)
    return plates, judge(at_rest_measures(RestCheck({}, plates, SWEEP, found.sweep_psnr)))


def as_it_is(picture: np.ndarray, n: int) -> np.ndarray:
    return picture


def person(first: int) -> Change:
    """Somebody stands still from a picture on."""

    def change(picture: np.ndarray, n: int) -> np.ndarray:
        if n >= first:
            picture[30:90, 90:110] = [0.2, 0.1, 0.9]
        return picture

    return change


def test_a_camera_that_is_right_is_well(tmp_path: Path) -> None:
    fit, rows = told(filmed(tmp_path / "clip", as_it_is))
    assert [(row.code, row.verdict) for row in rows.values()] == [("rest-explained", "ok")]
    assert fit.psnr is not None and fit.psnr > 30 and 0.4 < fit.known < 0.9 and fit.textured > LEAST_TEXTURED
    assert fit.by_place < MOST_OF_PLATE / 2 and max(fit.rest_by_place, fit.rest_by_time) < MOST_OF_REST / 2
    assert fit.by_light < 0.1 and fit.odd < MOST_ODD / 2
    assert json.loads(json.dumps(asdict(fit), allow_nan=False))["known"] == fit.known


def test_a_camera_that_was_touched_is_named(tmp_path: Path) -> None:
    """Two pixels to the side: a sixtieth of the width."""
    fit, rows = told(filmed(tmp_path / "clip", lambda p, n: shift(p, (1, 2, 0), order=1, mode="nearest")))
    assert (
        rows["rest-plate"].verdict == rows["rest-explained"].verdict == "warn"
        and "cam0" in rows["rest-plate"].remedy
    )
    assert fit.displaced is not None
    assert fit.displaced.length == pytest.approx(np.hypot(1, 2) / WIDTH, abs=0.003)
    assert min(fit.by_place, fit.rest_by_place) > 0.7


def test_a_clock_that_is_late_is_told_from_a_camera_that_was_touched(tmp_path: Path) -> None:
    """The picture at rest is one of six later; two pictures before it the square is near where it rested."""
    scene = filmed(tmp_path / "clip", as_it_is)
    late = [
        replace(frame, path=scene.dynamic[min(COUNT - 1, n + 4)].path)
        for n, frame in enumerate(scene.dynamic)
    ]
    early = replace(scene, dynamic=tuple(late), rest_time=2 / (COUNT - 1))
    fit, rows = told(early)
    assert fit.rest_by_time > MOST_OF_REST and fit.by_place < MOST_OF_PLATE
    assert rows["rest-explained"].verdict == "warn" and "rest-plate" not in rows


@pytest.mark.parametrize("gains", [(1.25, 1.0, 0.8), (0.7, 0.7, 0.7)])
def test_other_light_is_told_as_such(tmp_path: Path, gains: tuple[float, float, float]) -> None:
    """Two cameras that saw the rest in other light: each has a row of its own, so one is enough here."""
    fit, rows = told(filmed(tmp_path / "clip", lambda p, n: p * gains))
    assert rows["rest-plate"].verdict == "warn" and "curtains" in rows["rest-plate"].remedy
    assert fit.by_light > MOSTLY and fit.by_place < MOST_OF_PLATE


def test_two_cameras_in_other_light_are_both_named(tmp_path: Path) -> None:
    """What most cameras show does not excuse them: each is held against the sweep."""
    gains = {"cam0": 0.7, "cam1": 0.7, "cam2": 1.0}
    clips = {name: filmed(tmp_path / name, lambda p, n, g=g: g * p) for name, g in gains.items()}
    dynamic = [replace(f, camera_name=name) for name, clip in clips.items() for f in clip.dynamic]
    plates, rows = checked(replace(clips["cam0"], dynamic=tuple(dynamic)))
    of_camera = {row.about: row for row in rows if row.code == "rest-plate"}
    assert {name: row.verdict for name, row in of_camera.items()} == {"cam0": "warn", "cam1": "warn"}
    for name in of_camera:
        assert name in of_camera[name].remedy and "curtains" in of_camera[name].remedy
    assert min(plates["cam0"].by_light, plates["cam1"].by_light) > MOSTLY > plates["cam2"].by_light


def test_somebody_who_stands_there_nearly_always_is_named_with_a_place(tmp_path: Path) -> None:
    fit, rows = told(filmed(tmp_path / "clip", person(1)))
    assert (
        rows["rest-plate"].verdict == "warn" and f"{100 * fit.odd_at[0]:.0f} %" in rows["rest-plate"].remedy
    )
    assert fit.odd == pytest.approx(60 * 20 / (HEIGHT * WIDTH), rel=0.3)
    assert fit.odd_at == pytest.approx((100 / WIDTH, 60 / HEIGHT), abs=0.02)


def test_somebody_who_stands_there_most_of_the_time_is_left_out(tmp_path: Path) -> None:
    fit, rows = told(filmed(tmp_path / "clip", person(5)))
    assert "rest-plate" not in rows and fit.odd < MOST_ODD
    assert fit.known < told(filmed(tmp_path / "other", as_it_is))[0].known - 0.08


def test_a_camera_that_never_sees_anything_at_rest(tmp_path: Path) -> None:
    """A tripod on a moving boat: every picture shows other things."""
    fit, rows = told(filmed(tmp_path / "clip", lambda p, n: room(n + 10)))
    assert fit.psnr is None and fit.known < 0.02
    assert (
        list(rows) == ["rest-plate"]
        and rows["rest-plate"].verdict == "warn"
        and "cam0" in rows["rest-plate"].remedy
    )


def test_a_camera_turned_to_a_blank_wall(tmp_path: Path) -> None:
    fit, rows = told(filmed(tmp_path / "clip", as_it_is, PLAIN), PLAIN)
    assert fit.textured < LEAST_TEXTURED and fit.displaced is None
    assert rows["rest-plate"].verdict == "warn" and "cam0" in rows["rest-plate"].remedy
    assert rows["rest-explained"].verdict == "ok"


def test_what_the_sweep_never_showed(tmp_path: Path) -> None:
    """The model shows something else altogether: no shift and no gain takes that away."""
    scene = filmed(tmp_path / "clip", as_it_is)
    other = gaussian_filter(ROOM, (6, 6, 0)).astype(np.float32)
    plates, _ = plates_of(scene, other)
    row = judge(at_rest_measures(RestCheck({}, plates, sweep_psnr=[30.0, 31.0])))[0]
    assert row.verdict == "warn" and "cam0" in row.remedy
    assert plates["cam0"].by_light < MOSTLY


def test_no_plates_no_rows(tmp_path: Path) -> None:
    """Before a plain background, of short clips, of test cameras and of cameras that move."""
    scene = filmed(tmp_path / "clip", as_it_is)
    moving = [
        replace(f, camera=replace(CAMERA, cam_from_world=CAMERA.cam_from_world + 0.01 * n * np.eye(3, 4, 3)))
        for n, f in enumerate(scene.dynamic)
    ]
    for changed in (
        replace(scene, background="white"),
        replace(scene, dynamic=scene.dynamic[:4]),
        replace(scene, dynamic=tuple(replace(f, split="test") for f in scene.dynamic)),
        replace(scene, dynamic=tuple(moving)),
    ):
        assert plates_of(changed, ROOM) == ({}, [])


def test_a_picture_is_laid_on_another_one() -> None:
    """Shifted, turned and scaled by a little: nearly all of the error goes; of noise nothing does."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    x, y = u - 64, v - 48
    map_x = (64 + 1.02 * x - 0.015 * y + 2.5).astype(np.float32)
    map_y = (48 + 0.015 * x + 1.02 * y - 1.5).astype(np.float32)
    turned = cv2.remap(
        ROOM.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    where = np.zeros((HEIGHT, WIDTH), bool)
    where[8:-8, 8:-8] = True

    def error(one: np.ndarray) -> float:
        return float(((one - turned)[where] ** 2).mean())

    assert error(aligned(ROOM, turned, where)) < 0.05 * error(ROOM)
    noise = room(5)
    assert ((aligned(ROOM, noise, where) - noise)[where] ** 2).mean() > 0.85 * (
        (ROOM - noise)[where] ** 2
    ).mean()
    np.testing.assert_array_equal(aligned(PLAIN, PLAIN, where), PLAIN)
