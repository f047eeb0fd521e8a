"""`devrf-pipeline simulate`: words of the command line into options of the simulator."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress
from devrf.lab.simulate.protocol.dataset_options import DatasetOptions, ForwardOptions
from devrf.lab.simulate.protocol.forward import simulate_forward
from devrf.lab.simulate.protocol.simulate_dataset import simulate_dataset
from devrf.lab.simulate.scenes.objects import OBJECTS
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Options, Simulation
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.pipelines.config.words import suggestion
from devrf.pipelines.stamps.code_version import code_version
from devrf.pipelines.terminal.console import Talk


@dataclass(frozen=True)
class Protocol:
    """What can be rendered: the options it takes, who renders it, and what is meant where nothing is said."""

    options: type[BaseModel]
    render: Callable[..., Any]
    scene: str
    cameras: int
    size: str


def session_code() -> str:
    """Version of the code that renders sessions: of the sources that it needs, not of the renderer's library."""
    return code_version(*(f"lab/simulate/{part}" for part in ("render", "scenes", "session")))


def _session(out: Path, simulation: Simulation[SessionOptions], *, progress: Progress) -> Path:
    return simulate_session(out, simulation, code=session_code(), progress=progress)


PROTOCOLS = {
    "session": Protocol(SessionOptions, _session, "sheet", 4, "480x360"),
    "devrf": Protocol(DatasetOptions, simulate_dataset, "arm", 4, "400x400"),
    "devrf-forward": Protocol(ForwardOptions, simulate_forward, "flower", 3, "480x270"),
}


def simulate(
    talk: Talk,
    out: Path,
    scene: str | None,
    protocol: str,
    cameras: int | None,
    seed: int,
    size: str | None,
    settings: Sequence[str],
) -> None:
    """Render a session or a data set and say how to run it.

    Args:
        talk: Where to speak.
        out: New or empty folder; for a data set also one that was begun with the same arguments.
        scene: Name of the scene; None for the protocol's first.
        protocol: What is rendered, a name out of `PROTOCOLS`.
        cameras: Number of fixed cameras; None for the protocol's usual number.
        seed: Seed, 0 or more.
        size: WIDTHxHEIGHT, pixels; None for the protocol's usual size.
        settings: Texts `option=value` for the protocol's options.
    Raises:
        InputError: With every mistake in the options.
    """
    if protocol not in PROTOCOLS:
        text = f"--protocol {protocol}: unknown, expected one of {', '.join(PROTOCOLS)}"
        raise InputError("option-unknown-value", text)
    chosen = PROTOCOLS[protocol]
    kind = OBJECTS.get(scene or chosen.scene) if protocol == "session" else None
    size = size or (kind and kind.size) or chosen.size
    match = re.fullmatch(r"(\d+)x(\d+)", size.strip().lower())
    mistakes = [] if match else [f"--size {size}: expected WIDTHxHEIGHT in pixels, such as {chosen.size}"]
    if seed < 0:
        mistakes.append(f"--seed {seed}: expected a whole number from 0")
    options = None
    try:
        options = options_from(chosen.options, [*(kind.usual if kind else ()), *settings])
    except InputError as error:
        mistakes.append(str(error))
    if mistakes or match is None or options is None:
        raise InputError("option-malformed", "\n".join(mistakes))
    with talk.progress("simulate") as progress:
        count = chosen.cameras if cameras is None else cameras
        pixels = int(match[1]), int(match[2])
        made = chosen.render(
            out, Simulation(scene or chosen.scene, count, seed, pixels, options), progress=progress
        )
    if protocol == "session":
        talk.say(f"{made}: a session with known truth; run it with: devrf-pipeline run {made}")
        return
    path = made.scene_yaml
    if not made.rendered:
        talk.say(f"{path.parent}: already complete, made with the same arguments; nothing was rendered")
    talk.say(f"{path}: a data set with known truth; run it with: devrf-pipeline run {path}")


def options_from(model: type[Options], settings: Sequence[str]) -> Options:
    """Options from texts `name=value`, values read as YAML.

    Raises:
        InputError: Every unknown name and every value out of range.
    """
    names = list(model.model_fields)
    values: dict[str, object] = {}
    mistakes = []
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            mistakes.append(f"--set {text}: expected name=value, such as {names[0]}=24")
        elif name.strip() not in names:
            hint = suggestion(name.strip(), names) or f", expected one of {', '.join(names)}"
            mistakes.append(f"--set {name.strip()}: unknown option{hint}")
        else:
            try:
                values[name.strip()] = yaml.safe_load(value)
            except yaml.YAMLError:
                mistakes.append(f"--set {text}: the value cannot be read as YAML")
    try:
        options = model.model_validate(values)
    except ValidationError as error:
        for item in error.errors(include_url=False):
            name = ".".join(str(part) for part in item["loc"])
            mistakes.append(f"--set {name}: {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}")
        options = None
    if mistakes or options is None:
        raise InputError("option-malformed", "\n".join(mistakes))
    return options
