"""Flashes: pictures of a rolling shutter, written as clips and read back by ingest, with known moments."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.flash import Brightness, find_flashes, flash_delay
from devrf.calibration.clocks.sync import synchronise
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.video.audio import Sound
from devrf.lab.simulate.session.flash import RollingShutter, exposed, film_flashes

FPS, SECONDS = 30.0, 4.0
FLASHES_S = (0.83, 1.347, 2.291, 3.018)


def seen(path: Path, out: Path) -> Brightness:
    """The brightness that ingest keeps of a clip."""
    course = extract_clip(path, out, path.stem, "camera", path.name, Keep()).courses.brightness
    return Brightness(course[:, 0], course[:, 1:])


def clips(
    tmp_path: Path,
    offsets_s: Sequence[float],
    flashes_s: Sequence[float] = FLASHES_S,
    lamp_s: float | None = None,
    **shutter: float,
) -> dict[str, Brightness]:
    courses = {}
    for i, offset_s in enumerate(offsets_s):
        path = tmp_path / f"cam{i}.mp4"
        camera = RollingShutter(offset_s, seconds=SECONDS, **shutter)
        film_flashes(path, camera, flashes_s, lamp_s, seed=i)
        courses[f"cam{i}"] = seen(path, tmp_path / "ingest")
    return courses


SPANS = {f"cam{i}": (0.0, SECONDS - 1 / FPS) for i in range(3)}
OFFSETS_S = (0.0, 0.1237, -0.2081)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Brightness]:
    """The flashes, seen by three cameras."""
    return clips(tmp_path_factory.mktemp("flashes"), OFFSETS_S)


def test_flashes_to_a_fraction_of_a_frame(filmed: dict[str, Brightness]):
    """Four flashes, readout given: bands of 20 / 24 ms, four flashes, both edges of each: below half a
    millisecond; and the statement of doubt holds (three standard deviations)."""
    extras = Extras(filmed, readout_s=dict.fromkeys(SPANS, 0.02))
    result = synchronise(SPANS, {}, {}, "flash", extras=extras)
    for name, offset_s in list(zip(SPANS, OFFSETS_S, strict=True))[1:]:
        clock = result.cameras[name]
        assert clock.method == "flash" and clock.confidence > 0.6
        assert abs(clock.offset_s - offset_s) < min(1e-3, 3 * clock.std_s)
    assert any(n.startswith("camera cam1: 4 flashes") for n in result.notes)
    assert result.loops and abs(result.loops[0].closure_s) < 2e-3


@pytest.mark.full
def test_unknown_readout_is_found_by_several_flashes(tmp_path):
    """The prior for the readout is 23 ms, the truth 14: one flash may be off by the difference, (23 - 14) ms;
    four that hit different rows are not."""
    courses = clips(tmp_path, OFFSETS_S[:2], readout_s=0.014, exposure_s=0.022)
    found = flash_delay(*(find_flashes(c) for c in courses.values()))
    assert found is not None and found.accepted and found.matches == 4
    assert abs(found.delay_s - OFFSETS_S[1]) < min(3e-3, 3 * found.std_s)


@pytest.mark.full
def test_a_lamp_switched_on(tmp_path):
    """A single step: known to the readout's doubt (15 % of a frame, 5 ms) and the exposure's ramp."""
    result = synchronise(
        SPANS, {}, {}, "flash", extras=Extras(clips(tmp_path, OFFSETS_S, flashes_s=(), lamp_s=1.71))
    )
    for name, offset_s in list(zip(SPANS, OFFSETS_S, strict=True))[1:]:
        clock = result.cameras[name]
        assert clock.method == "flash" and abs(clock.offset_s - offset_s) < min(0.5 / FPS, 3 * clock.std_s)


def test_stated_doubt_covers_the_error():
    """Row brightness without a codec, 60 pairs: errors within two standard deviations in at least 90 %."""
    inside = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        offset_s, flashes_s = rng.uniform(-0.3, 0.3), np.sort(rng.uniform(0.9, 3.1, rng.integers(1, 5)))
        courses = []
        for start_s in (0.0, offset_s):
            readout_s = rng.uniform(0.012, 0.03)
            camera = RollingShutter(start_s, readout_s=readout_s, exposure_s=0.022)
            bands, count = (np.arange(24) + 0.5) / 24, int(SECONDS * FPS)
            lit = np.stack([exposed(camera, n, bands, list(flashes_s)) for n in range(count)])
            courses.append(Brightness(np.arange(count) / FPS, 90 + 60 * lit + rng.normal(0, 0.3, lit.shape)))
        found = flash_delay(*(find_flashes(c) for c in courses))
        assert found is not None
        inside += abs(found.delay_s - offset_s) < 2 * found.std_s
    assert inside >= 54


@pytest.mark.full
def test_a_flash_that_one_camera_did_not_see(filmed: dict[str, Brightness], tmp_path):
    path = film_flashes(tmp_path / "cam2.mp4", RollingShutter(OFFSETS_S[2]), (), seed=2)
    blind = filmed | {"cam2": seen(path, tmp_path / "ingest")}
    result = synchronise(SPANS, {}, {}, "flash", extras=Extras(blind))
    assert result.cameras["cam1"].confidence > 0.5 and result.cameras["cam2"].confidence == 0
    assert any(n.startswith("camera cam2: saw no flash") for n in result.notes)


@pytest.mark.full
def test_lamps_that_blink_are_no_flash(tmp_path):
    courses = clips(tmp_path, OFFSETS_S[:2], flashes_s=list(np.arange(0.2, 3.8, 0.4)))
    result = synchronise({n: SPANS[n] for n in courses}, {}, {}, "flash", extras=Extras(courses))
    assert result.cameras["cam1"].confidence < 0.5
    assert any("periodic" in n for n in result.notes)


@pytest.mark.parametrize("strength", [0.0, 1.0])
def test_a_still_wall_and_a_flash_in_the_noise_are_none(tmp_path, strength):
    path = film_flashes(tmp_path / "a.mp4", RollingShutter(), FLASHES_S, strength=strength)
    assert find_flashes(seen(path, tmp_path / "ingest")).events == ()


def step(at: int, count: int = 120, frames: int = 120) -> Brightness:
    """Light that is switched on before frame `at`, for so many frames."""
    after = np.arange(count) - at
    lit = ((after >= 0) & (after < frames))[:, None] * np.ones(24)
    return Brightness(
        np.arange(count) / FPS, 60 + 60 * lit + np.random.default_rng(at).normal(0, 0.1, lit.shape)
    )


@pytest.mark.parametrize("at", [3, 11, 109, 117])
@pytest.mark.parametrize("frames", [1, 120])
def test_light_that_changes_at_the_end_of_a_file_is_no_event(at, frames):
    assert find_flashes(step(at, frames=frames)).events == ()
    assert len(find_flashes(step(60, frames=frames)).events) == 1


def test_a_lone_step_never_overrules_sound():
    """The light goes on in both files at 1 s, and their sound says that the second began 0.3 s later."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=5 * 48_000).astype(np.float32) * 0.1
    sounds = {
        "cam0": Sound(noise[: 4 * 48_000], 48_000, 0.0),
        "cam1": Sound(noise[14_400 : 14_400 + 4 * 48_000], 48_000, 0.0),
    }
    spans = {n: SPANS[n] for n in sounds}
    clock = synchronise(spans, sounds, {}, extras=Extras({n: step(30) for n in sounds})).cameras["cam1"]
    assert clock.method == "audio" and clock.offset_s == pytest.approx(0.3, abs=1e-3)
