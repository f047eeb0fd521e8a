"""`devrf-pipeline simulate`: words of the command line into options of the simulator."""

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import yaml
from pydantic import ValidationError

from devrf.capture.errors import InputError
from devrf.capture.simulate import simulate_session
from devrf.capture.simulate_options import SessionOptions
from devrf.pipelines.console import Talk


def simulate(
    talk: Talk,
    out: Path,
    scene: str,
    protocol: str,
    cameras: int,
    seed: int,
    size: str,
    settings: Sequence[str],
) -> None:
    """Render a session and say how to run it.

    Args:
        talk: Where to speak.
        out: New or empty folder.
        scene: Name of the scene.
        protocol: What is rendered: session.
        cameras: Number of fixed cameras.
        seed: Seed, 0 or more.
        size: WIDTHxHEIGHT, pixels.
        settings: Texts `option=value` for `SessionOptions`.
    Raises:
        InputError: With every mistake in the options.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", size.strip().lower())
    mistakes = [] if match else [f"--size {size}: expected WIDTHxHEIGHT in pixels, such as 480x360"]
    if seed < 0:
        mistakes.append(f"--seed {seed}: expected a whole number from 0")
    try:
        options = session_options(settings)
    except InputError as error:
        mistakes.append(str(error))
        options = SessionOptions()
    if mistakes or match is None:
        raise InputError("\n".join(mistakes))
    with talk.progress("simulate") as progress:
        scene_yaml = simulate_session(
            out,
            scene,
            cameras=cameras,
            seed=seed,
            size=(int(match[1]), int(match[2])),
            options=options,
            progress=progress,
            protocol=protocol,
        )
    talk.say(f"{scene_yaml}: a session with known truth; run it with: devrf-pipeline run {scene_yaml}")


def session_options(settings: Sequence[str]) -> SessionOptions:
    """Options from texts `name=value`, values read as YAML.

    Raises:
        InputError: Every unknown name and every value out of range.
    """
    names = list(SessionOptions.model_fields)
    values: dict[str, object] = {}
    mistakes = []
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            mistakes.append(f"--set {text}: expected name=value, such as fps=24")
        elif name.strip() not in names:
            near = difflib.get_close_matches(name.strip(), names, n=1)
            hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(names)}"
            mistakes.append(f"--set {name.strip()}: unknown option, {hint}")
        else:
            try:
                values[name.strip()] = yaml.safe_load(value)
            except yaml.YAMLError:
                mistakes.append(f"--set {text}: the value cannot be read as YAML")
    try:
        options = SessionOptions.model_validate(values)
    except ValidationError as error:
        for item in error.errors(include_url=False):
            name = ".".join(str(part) for part in item["loc"])
            mistakes.append(f"--set {name}: {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}")
        options = SessionOptions()
    if mistakes:
        raise InputError("\n".join(mistakes))
    return options
