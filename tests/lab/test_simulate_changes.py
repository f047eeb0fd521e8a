"""What may differ between a simulated session's sweep and fixed cameras, and what an object does with light."""

from pathlib import Path

import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.video.audio import read_sound
from devrf.capture.video.reader import VideoReader
from devrf.lab.simulate.render.renderer import Finish, Renderer
from devrf.lab.simulate.scenes.catalogue import room
from devrf.lab.simulate.scenes.objects import make_object
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.camera_rig import fixed_cameras
from devrf.lab.simulate.session.session_files import background_at, lamp_shift_m, object_at
from devrf.lab.simulate.session.simulate_session import simulate_session

SMALL = SessionOptions(
    sweep_frames=2, fps=4, duration_s=0.8, rest_s=0.1, motion_speed=2, spp=4, board=False, sound=False
)


@pytest.mark.full
def test_clips_are_kept_and_the_sweep_can_be_restless(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    for name, options, kept in (
        ("calm", SMALL, ()),
        ("restless", SMALL.model_copy(update={"sweep_motion": 1.0, "sweep_fps": 2.0}), ("cam0", "witness")),
    ):
        clips = [tmp_path / "calm" / f"{clip}.mp4" for clip in kept]
        simulate_session(tmp_path / name, Simulation("sheet", 1, 0, (32, 24), options), kept=clips)
    calm, restless = tmp_path / "calm", tmp_path / "restless"
    for clip in ("cam0.mp4", "witness.mp4"):
        assert (calm / clip).read_bytes() == (restless / clip).read_bytes()
    before, after = (_last(folder / "static.mp4") for folder in (calm, restless))
    assert np.abs(before - after).max() > 40  # grey levels: the sheet is elsewhere


@pytest.mark.full
def test_a_clip_is_the_same_whatever_is_made_beside_it(tmp_path: Path) -> None:
    """Noise, light paths and microphones of one clip do not hang on which others are kept, or on what they show."""
    pytest.importorskip("mitsuba")
    options = SMALL.model_copy(update={"sound": True, "claps": 1})
    simulation = Simulation("sheet", 1, 0, (32, 24), options)
    simulate_session(tmp_path / "whole", simulation)
    kept = [tmp_path / "whole" / "static.mp4", tmp_path / "whole" / "cam0.mp4"]
    simulate_session(tmp_path / "again", simulation, kept=kept)
    whole, again = (tmp_path / folder / "witness.mp4" for folder in ("whole", "again"))
    assert np.abs(_last(whole) - _last(again)).max() <= 1  # grey levels
    one, other = (read_sound(path) for path in (whole, again))
    assert one is not None and other is not None
    np.testing.assert_array_equal(one.samples, other.samples)


def test_a_share_of_the_way() -> None:
    thing = make_object("sheet", np.random.default_rng(0), SMALL)
    rest, there = thing.rest.vertices, object_at(thing, 1.0, SMALL).vertices
    np.testing.assert_allclose(object_at(thing, 1.0, SMALL, 0.25).vertices, rest + 0.25 * (there - rest))


def test_lamp_and_background_move_with_the_object_and_rest_with_it() -> None:
    options = SMALL.model_copy(update={"lamp_travel_m": 1.4, "background_motion_m": 0.5})
    assert [lamp_shift_m(t, options) for t in (0.0, 0.1, 0.45, 0.8, 2.0)] == pytest.approx(
        [0, 0, 0.7, 1.4, 1.4]
    )
    behind = room(np.random.default_rng(0), 1.0).behind
    half_way_s = 0.1 + 0.5 / (0.6 * 2)
    for mesh, still, moved in zip(
        behind, background_at(behind, 0.1, options), background_at(behind, half_way_s, options), strict=True
    ):
        np.testing.assert_array_equal(still.vertices, mesh.vertices)
        way = moved.vertices - mesh.vertices
        np.testing.assert_allclose(np.abs(way), np.tile([0, 0.5, 0], (len(way), 1)), atol=1e-12)
        assert np.sign(way[0, 1]) == -np.sign(mesh.vertices[:, 1].mean())  # away from the wall


@pytest.mark.full
def test_what_is_clear_lets_through_and_what_shines_changes_nothing_around_it() -> None:
    pytest.importorskip("mitsuba")
    camera = fixed_cameras(np.random.default_rng(1), 1, (48, 36), SMALL)[0].camera
    thing = [make_object("column", np.random.default_rng(0), SMALL).rest]
    still = room(np.random.default_rng(0), 1.0).still

    def picture(finish: Finish, camera: Camera = camera) -> np.ndarray:
        return Renderer(still, 16, finish)(camera, thing, seed=0)

    solid, gauze, ghost = (picture(Finish(clear=c)) for c in (0.0, 0.5, 1.0))
    empty = Renderer(still, 16)(camera, [], seed=0)
    np.testing.assert_allclose(ghost, empty, atol=1e-6)
    np.testing.assert_allclose(gauze, (solid + empty) / 2, atol=1e-6)
    polished = picture(Finish(gloss=0.8))
    column = np.abs(solid - empty).max(-1) > 0.02
    assert np.abs(polished - solid)[column].mean() > 0.05
    away = np.abs(np.arange(48) - 24) > 20
    assert np.abs(polished - solid)[:, away].mean() < 0.005


def _last(path: Path) -> np.ndarray:
    with VideoReader(path) as reader:
        return [frame.rgb.astype(float) for frame in reader][-1]
