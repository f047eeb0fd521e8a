"""`devrf-pipeline simulate`: what the words of the command line become, and what it says of wrong ones."""

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress
from devrf.lab import simulate_command
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions, ForwardOptions
from devrf.lab.simulate.protocol.forward import simulate_forward
from devrf.lab.simulate.protocol.simulate_dataset import Made, simulate_dataset
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.pipelines.terminal.console import Talk

SHORT, CUT = SessionOptions(duration_s=0.2), SessionOptions(strip_m=0.02)


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        ("session", ("sheet", 4, (480, 360), SessionOptions)),
        ("devrf", ("arm", 4, (400, 400), DatasetOptions)),
        ("devrf-forward", ("flower", 3, (480, 270), ForwardOptions)),
    ],
)
def test_each_protocol_has_its_own_defaults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: str, expected: tuple
) -> None:
    got: list[tuple] = []

    def render(out: Path, made: Simulation, *, progress: Progress) -> Path | Made:
        got.append((made.scene, made.cameras, made.size, type(made.options)))
        assert made.seed == 0 and made.options.spp == 12
        return out / "scene.yaml" if protocol == "session" else Made(out / "scene.yaml", 1)

    chosen = simulate_command.PROTOCOLS[protocol]
    changed = type(chosen)(chosen.options, render, chosen.scene, chosen.cameras, chosen.size)
    monkeypatch.setitem(simulate_command.PROTOCOLS, protocol, changed)
    simulate_command.simulate(Talk(), tmp_path, None, protocol, None, 0, None, ["spp=12"])
    assert got == [expected]


@pytest.mark.parametrize(
    ("size", "settings", "expected"), [(None, [], (640, 30.0)), ("64x48", ["other_fps=0"], (64, 0.0))]
)
def test_a_scene_has_usual_options_that_others_replace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: str | None, settings: list[str], expected: tuple
) -> None:
    got: list[tuple] = []

    def render(out: Path, made: Simulation, *, progress: Progress) -> Path:
        got.append((made.size[0], made.options.other_fps))
        assert made.scene == made.options.room == "workshop" and made.options.portrait
        return out / "scene.yaml"

    chosen = simulate_command.PROTOCOLS["session"]
    changed = type(chosen)(chosen.options, render, chosen.scene, chosen.cameras, chosen.size)
    monkeypatch.setitem(simulate_command.PROTOCOLS, "session", changed)
    simulate_command.simulate(Talk(), tmp_path, "workshop", "session", None, 0, size, settings)
    assert got == [expected]


def test_a_complete_data_set_is_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    chosen = simulate_command.PROTOCOLS["devrf"]
    made = Made(tmp_path / "scene.yaml", 0)
    changed = type(chosen)(chosen.options, lambda *_, **__: made, "arm", 4, "64x64")
    monkeypatch.setitem(simulate_command.PROTOCOLS, "devrf", changed)
    simulate_command.simulate(Talk(), tmp_path, None, "devrf", None, 0, None, [])
    said = "".join(capsys.readouterr()).replace("\n", " ")
    assert f"devrf-pipeline run {made.scene_yaml}" in said


@pytest.mark.parametrize(
    ("protocol", "size", "settings", "refusal", "named"),
    [
        ("devfr", None, [], "option-unknown-value", ("devfr", "session, devrf, devrf-forward")),
        ("devrf", "400", [], "option-malformed", ("--size 400: ", "400x400")),
        ("devrf", None, ["tims=3"], "option-malformed", ("tims", "times?")),
        ("devrf", None, ["fps=3"], "option-malformed", ("fps: ", "static_views")),
        ("devrf-forward", None, ["spread=9"], "option-malformed", ("spread: 9",)),
        ("session", None, ["fps"], "option-malformed", ("--set fps: ", "name=value")),
    ],
)
def test_wrong_words_are_named(
    tmp_path: Path, protocol: str, size: str | None, settings: list[str], refusal: str, named: tuple[str, ...]
) -> None:
    with refused(refusal, *named, kind=InputError):
        simulate_command.simulate(Talk(), tmp_path / "x", None, protocol, None, 0, size, settings)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("make", "change", "refusal"),
    [
        (simulate_session, {"scene": "flagg"}, ("scene-unknown", "flagg", "sheet, column")),
        (simulate_session, {"cameras": 0}, ("option-out-of-range", "cameras 0")),
        (simulate_session, {"size": (63, 48)}, ("option-out-of-range", "63x48")),
        (simulate_session, {"options": SHORT}, ("options-contradict", "duration_s 0.2")),
        (
            simulate_session,
            {"scene": "column", "options": CUT},
            ("options-contradict", "strip_m 0.02", "sheet"),
        ),
        (simulate_dataset, {"scene": "sheet"}, ("scene-unknown", "sheet", "robot, flower, arm")),
        (simulate_dataset, {"cameras": 0}, ("option-out-of-range", "cameras 0", "1 to 8")),
        (simulate_dataset, {"cameras": 9}, ("option-out-of-range", "cameras 9", "1 to 8")),
        (simulate_dataset, {"size": (8, 48)}, ("option-out-of-range", "8x48")),
        (simulate_forward, {"size": (200, 80)}, ("option-out-of-range", "200x80", "2:1")),
        (simulate_forward, {"scene": "flagg"}, ("scene-unknown", "flagg", "robot")),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_written(
    tmp_path: Path, make, change: dict, refusal: tuple
):
    scene, options = {
        simulate_session: ("sheet", SessionOptions()),
        simulate_dataset: ("arm", DatasetOptions()),
        simulate_forward: ("flower", ForwardOptions()),
    }[make]
    with refused(*refusal, kind=InputError):
        make(tmp_path / "out", replace(Simulation(scene, 3, 0, (64, 40), options), **change))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("model", "unknown", "bad"),
    [
        (SessionOptions, {"sweep_frame": 70}, {"noise": -0.1}),
        (DatasetOptions, {"tims": 3}, {"times": 1}),
        (ForwardOptions, {"tims": 3}, {"times": 1}),
    ],
)
def test_options_are_strict_and_documented(model: type[BaseModel], unknown: dict, bad: dict) -> None:
    for values in (unknown, bad):
        with pytest.raises(ValidationError, match=next(iter(values))):
            model.model_validate(values)
    assert all(field.description for field in model.model_fields.values())


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for protocol in simulate_command.PROTOCOLS:
        with refused("folder-unwritable", tmp_path / "file", kind=InputError):
            simulate_command.simulate(Talk(), tmp_path / "file" / "x", None, protocol, None, 0, None, [])
