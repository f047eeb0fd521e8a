"""The scene at rest against fixed cameras: silent where they are right, heard where they or the pictures are wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from tests.judged import fired, judged

from devrf.capture.scene import PosedFrame, Scene
from devrf.lab.simulate.session.damage import zoomed
from devrf.pipelines.health.at_rest_rows import at_rest_measures
from devrf.reconstruct.evaluation.check_rest import RestCheck, RestFit, check_rest
from devrf.reconstruct.evaluation.displacement import Displacement
from devrf.reconstruct.fields.canonical_model import RestModel


def words(scene: Scene, rest: RestModel) -> dict[str, str]:
    """Code -> verdict."""
    return {row.code: row.verdict for row in judged(at_rest_measures(check_rest(scene, rest))).values()}


def changed(scene: Scene, change: Callable[[PosedFrame], PosedFrame], name: str = "cam1") -> Scene:
    """The scene with one camera's pictures changed."""
    return replace(scene, dynamic=tuple(change(f) if f.camera_name == name else f for f in scene.dynamic))


def test_cameras_that_are_right_fire_nothing(ball, rest: RestModel) -> None:
    found = check_rest(ball.scene, rest)
    assert list(found.cameras) == ["cam0", "cam1", "cam2"]  # no test camera is asked
    assert len(found.sweep) == len(found.sweep_psnr) == 2 and not found.plates
    assert list(fired(at_rest_measures(found))) == []


def test_a_voxel_is_measured_at_the_middle_of_the_box(ball, rest: RestModel) -> None:
    """The box around the ball is some 1.1 wide, R = 40; cameras 2.6 to 2.9 away, 60 / 48 of a width focal length."""
    cameras = check_rest(ball.scene, rest).cameras
    side = float((rest.canonical.aabb[1] - rest.canonical.aabb[0]).max()) / 40
    camera = ball.scene.dynamic[0].camera
    away = float((camera.centre**2).sum() ** 0.5)
    assert cameras["cam0"].voxel == pytest.approx(side * 60 / 48 / away, rel=0.15)


def test_a_clip_that_does_not_begin_at_rest_is_seen(ball, rest: RestModel) -> None:
    """cam1's first picture shows the ball where it is at the end."""
    last = [f for f in ball.scene.dynamic if f.camera_name == "cam1"][-1]
    scene = changed(ball.scene, lambda f: replace(f, path=last.path))
    assert words(scene, rest)["rest-unlike"] == "warn"


@pytest.mark.parametrize("missing", [2, 3])
def test_a_camera_that_begins_later_is_not_compared_in_motion(ball, rest: RestModel, missing: int) -> None:
    """Its first picture shows a ball that has moved, which is no fault of the camera."""
    clips = ball.scene.dynamic
    late = tuple(f for f in clips if f.camera_name != "cam1" or f.index >= missing)
    assert set(words(replace(ball.scene, dynamic=late), rest).values()) == {"ok"}


def test_a_wrong_focal_length_and_other_exposure_are_seen(ball, rest: RestModel, tmp_path: Path) -> None:
    scene = changed(ball.scene, lambda f: replace(f, camera=zoomed(f.camera, 1.2)))
    assert "warn" in words(scene, rest).values()

    def darker(frame: PosedFrame) -> PosedFrame:
        picture = cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        picture[..., :3] //= 2
        cv2.imwrite(str(tmp_path / frame.path.name), picture)
        return replace(frame, path=tmp_path / frame.path.name)

    assert words(changed(ball.scene, darker), rest)["rest-unlike"] == "warn"


def test_where_the_clips_never_rest_their_still_pixels_are_asked(ball, rest: RestModel) -> None:
    """Before plain white nothing is still but the background: nothing is told, nothing is claimed."""
    found = check_rest(replace(ball.scene, rest_time=None), rest)
    assert all(fit.displaced is None for fit in found.cameras.values())
    assert fired(at_rest_measures(found)) == {}


def test_a_scene_at_rest_alone_has_no_cameras_to_ask(ball, rest: RestModel) -> None:
    assert at_rest_measures(check_rest(replace(ball.scene, dynamic=(), rest_time=None), rest)) == []


RIGHT = RestFit(25.0, Displacement(0.002, 0.0005), 0.01)


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (replace(RIGHT, displaced=Displacement(0.007, 0.0005)), "rest-beside"),
        (replace(RIGHT, psnr=21.0), "rest-unlike"),
    ],
)
def test_what_is_too_much(wrong: RestFit, code: str) -> None:
    """Half a voxel and two standard deviations are 0.6 % of the width; 3 dB below 24 to 25 are 21.5."""
    found = RestCheck({"left": RIGHT, "right": wrong}, sweep=[RIGHT, replace(RIGHT, psnr=24.0)])
    assert list(fired(at_rest_measures(found))) == [f"{code} right"]


FAR = Displacement(0.08, 0.0, found=False)  # as far as is searched in a picture wider than high


def test_one_picture_of_the_sweep_that_is_not_found_again_does_not_excuse_cameras() -> None:
    """A blurred one of four; a camera 2 % beside is named all the same, and so is one that is not found again."""
    sweep = [RIGHT, RIGHT, RIGHT, replace(RIGHT, displaced=FAR)]
    for found in (Displacement(0.02, 0.0005), FAR):
        cameras = {"left": RIGHT, "right": replace(RIGHT, displaced=found)}
        assert list(fired(at_rest_measures(RestCheck(cameras, sweep=sweep)))) == ["rest-beside right"]


def test_where_half_of_the_sweep_is_not_found_again_nothing_is_said_of_cameras() -> None:
    """Nor of one that is higher than wide, where as far as is searched is more widths."""
    high = replace(RIGHT, displaced=Displacement(0.14, 0.0, found=False))
    found = RestCheck({"high": high}, sweep=[RIGHT, replace(RIGHT, displaced=FAR)])
    assert [m for m in at_rest_measures(found) if m.code == "rest-beside"] == []


def test_a_sweep_that_lies_beside_its_own_model_says_how_much_is_usual() -> None:
    shaky = [replace(RIGHT, displaced=Displacement(0.008, 0.0005))] * 2
    cameras = {"cam0": replace(RIGHT, displaced=Displacement(0.007, 0.0005))}
    assert fired(at_rest_measures(RestCheck(cameras, sweep=shaky))) == {}
