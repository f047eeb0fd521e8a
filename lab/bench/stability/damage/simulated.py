"""Damage to what is filmed, or to how: a simulated session or data set made again with other options, in a folder.

It applies wherever a scene's truth says how it was simulated, and is made once for all seeds. Where only the fixed
cameras see a difference, the sweep's clip is kept as it is, and the other way round.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from devrf.capture.system.errors import InputError
from devrf.lab.bench.stability.damage.intact import Damage, Damaging, DoesNotApply, Intact, with_capture
from devrf.lab.bench.stability.small_session import TRUTH, Simulated, is_rendered, rendered
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.render.folder import MADE_BY
from devrf.lab.simulate.render.mitsuba import load_mitsuba
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.simulate_session import check_simulation
from devrf.lab.simulate_command import session_code
from devrf.pipelines.config.scene import SceneConfig


def again(
    change: Callable[[SessionOptions, float], dict[str, Any]],
    scene: str | None = None,
    *,
    sweep_stays: bool = False,
    cameras_stay: bool = False,
) -> Damaging:
    """A damage that simulates the session again.

    Args:
        change: Given the options and the severity: which options become what.
        scene: Another object in front of the cameras; None: the same.
        sweep_stays, cameras_stay: Clips that these options do not change.
    """

    def damage(intact: Intact) -> Damage:
        was = simulated(intact)
        folder = intact.folder.resolve().parent / "session"  # the same for all seeds
        kept = [
            path
            for name, path in _clips(intact).items()
            if (sweep_stays if name == "static" else cameras_stay)
        ]
        try:
            options = was.options.model_dump() | change(was.options, intact.severity)
            made = replace(was, scene=scene or was.scene, options=SessionOptions.model_validate(options))
            check_simulation(made)
            if not is_rendered(folder, made):
                load_mitsuba()
        except (InputError, ValidationError) as error:
            code = error.code if isinstance(error, InputError) else "option-out-of-range"
            raise DoesNotApply(code, str(error)) from error
        rendered(folder, made, kept)  # a folder that cannot be written says nothing about the damage
        return Damage(_filmed_in(intact, folder))

    return damage


def larger(intact: Intact) -> Damage:
    """So many times the motion; of a simulated data set, too."""
    dataset = intact.config.dataset
    if dataset is None:
        return _LARGER(intact)
    path = intact.config.path(intact.scene_dir, dataset.path)
    try:
        made = json.loads((path / MADE_BY).read_text(encoding="utf-8"))
        was = DatasetOptions.model_validate(made["options"])
        if made["protocol"] != "devrf":
            raise ValueError(made["protocol"])
    except (OSError, KeyError, ValueError):
        text = "it is no data set that the simulator made by protocol devrf"
        raise DoesNotApply("session-not-simulated", text) from None
    folder = intact.folder.resolve().parent / "dataset"  # the same for all seeds
    try:
        options = DatasetOptions.model_validate(was.model_dump() | _scaled(was, intact.severity))
    except ValidationError as error:
        raise DoesNotApply("option-out-of-range", str(error)) from error
    size = tuple(made["size"])
    simulate_dataset(folder, Simulation(made["scene"], made["cameras"], made["seed"], size, options))
    other = dataset.model_copy(update={"path": str(folder)})
    return Damage(intact.config.model_copy(update={"dataset": other}))


def _scaled(was: SessionOptions | DatasetOptions, times: float) -> dict[str, float]:
    return {"motion_scale": times * was.motion_scale}


_LARGER = again(_scaled, sweep_stays=True)


def narrower(intact: Intact) -> Damage:
    """The training cameras draw together at one end by so many percent of their angle; the witness stays.

    The simulator's witness stands in the middle of an even number of cameras. Of an odd number it stands between two
    of them and would move with them: other test views, which the undisturbed bar says nothing about.
    """
    if simulated(intact).cameras % 2:
        text = "with an odd number of simulated cameras this axis would move the test camera"
        raise DoesNotApply("witness-would-move", text)
    return _NARROWER(intact)


_NARROWER = again(
    lambda was, percent: {
        "spread_deg": was.spread_deg * (1 - percent / 100),
        "fan_deg": was.fan_deg - was.spread_deg * percent / 200,
    },
    sweep_stays=True,
)


def simulated(intact: Intact) -> Simulated:
    """How the scene was simulated.

    Raises:
        DoesNotApply: It was not, or nobody knows how, or what is rendered now would differ by more than the damage.
    """
    whole = intact.capture is not None and intact.capture.static is not None
    truth = intact.config.truth_path(intact.scene_dir) if whole else None
    found = None if truth is None else Simulated.of(truth)
    if found is None:
        text = "it is no simulated session with its sweep, whose truth says how to make it again"
        raise DoesNotApply("session-not-simulated", text)
    if found.code != session_code():
        raise DoesNotApply(
            "session-outdated",
            "the session was rendered by another version of the simulator; render it anew with devrf-pipeline simulate",
        )
    return found


def _clips(intact: Intact) -> dict[str, Path]:
    """All clips of the scene by the names that the simulator gives them."""
    capture, path = intact.capture, intact.config.path
    assert capture is not None and capture.static is not None  # of a simulated session
    clips = {"static": capture.static, **capture.all_cameras}
    return {name: path(intact.scene_dir, clip) for name, clip in clips.items()}


def _filmed_in(intact: Intact, folder: Path) -> SceneConfig:
    """The configuration with this session's files."""
    clips = {name: str(folder / path.name) for name, path in _clips(intact).items()}
    capture = intact.capture
    assert capture is not None
    changes: dict[str, Any] = {
        "static": clips["static"],
        "cameras": {name: clips[name] for name in capture.cameras},
    }
    if isinstance(capture.test_cameras, dict):
        changes["test_cameras"] = {name: clips[name] for name in capture.test_cameras}
    if capture.board is not None:
        boards = {name: str(folder / Path(clip).name) for name, clip in capture.board.clips.items()}
        changes["board"] = capture.board.model_copy(update={"clips": boards})
    config = with_capture(intact.config, **changes)
    evaluate = config.evaluate.model_copy(update={"truth": str(folder / TRUTH)})
    return config.model_copy(update={"evaluate": evaluate})
