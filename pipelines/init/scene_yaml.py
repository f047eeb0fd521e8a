"""The commented scene.yaml that `init` writes."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

from devrf.calibration.boards.spec import BoardSpec
from devrf.pipelines import config
from devrf.pipelines.init.material import FootageContent, Roles

PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # what YAML reads as text without quotes ...
WORDS = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))  # ... but for these
OF_BOARD = {"charuco": "squares", "chessboard": "inner corners", "aruco_grid": "markers"}
SCHEMA = Path(config.__file__).with_name("scene.schema.json")  # written by `make pages`
HEAD = """# yaml-language-server: $schema={schema}
# Written by `devrf-pipeline init` from what the clips show; every key is in docs/configuration.md.
# Paths are relative to this file. `devrf-pipeline check` looks at it before anything runs.
"""


def scene_yaml(name: str, roles: Roles, preset: str) -> str:
    """The whole file of a capture."""
    return _head() + "\n".join(_lines(name, roles, preset)) + "\n"


def dataset_yaml(name: str, dataset_format: str) -> str:
    """The file beside a finished data set."""
    return f"{_head()}name: {_text(name)}\ndataset: {{format: {dataset_format}, path: .}}\n"


def _head() -> str:
    """Its first line tells editors by which schema to complete and check what is typed."""
    return HEAD.format(schema=SCHEMA.as_uri())


def _lines(name: str, roles: Roles, preset: str) -> Iterator[str]:
    yield f"name: {_text(name)}"
    yield f"preset: {preset}   # fast with an NVIDIA GPU, tiny for two CPU cores"
    yield "capture:"
    if roles.sweep is not None:
        yield f"  static: {_text(roles.sweep.name)}   # {roles.why[roles.sweep.name]}"
    yield from _clips("cameras", roles.cameras, "of the moving scene; the first one's clock is everyone's")
    yield from _clips("test_cameras", roles.tests, "never trained on")
    if roles.timestamps is not None:
        yield f"  timestamps: {_text(roles.timestamps)}   # true times of the frames"
    if roles.cameras and roles.sweep is not None:
        yield "  rest: auto   # when the clips show the scene as in the sweep: auto, start, middle, end or none"
    if roles.board is not None:
        yield from _board(roles.board.spec, roles.metric)
        yield from (
            "  " + line for line in _clips("clips", roles.boards, "the board before one camera at a time")
        )
        yield from (
            "  " + line for line in _clips("joint_clips", roles.joint, "before several cameras at once")
        )
    if roles.given is not None:
        yield f"calibration:\n  rig: {{given: {_text(roles.given)}}}   # {roles.why[roles.given]}"
    for file, reason in roles.left.items():
        yield f"# not used: {file}: {reason}".replace("\n", " ")


def _board(spec: BoardSpec, metric: bool) -> Iterator[str]:
    columns, rows = spec.squares
    yield "  board:   # told from the pictures, but for its size"
    yield f"    type: {spec.type}"
    yield f"    squares: [{columns}, {rows}]   # columns and rows of {OF_BOARD[spec.type]}"
    if metric:
        yield "    metric: false   # nobody measured it: metres come from the calibration"
    else:
        yield "    metric: false   # nobody measured it: the scale stays arbitrary. To have metres, give true"
        yield "    #                 lengths in the next lines and remove this one"
    share = spec.marker_m or 0.75
    if spec.type != "aruco_grid":
        yield "    square_m: 1.0   # side of a square"
    if spec.type != "chessboard":
        yield f"    marker_m: {share:.2f}   # side of a marker, in proportion as seen"
        yield f"    dictionary: {spec.dictionary}"
        yield f"    inverted: {str(spec.inverted is True).lower()}   # true: printed white on black"
    if spec.type == "aruco_grid":
        yield f"    separation_m: {1 - share:.2f}   # gap between markers, in proportion as seen"


def _clips(key: str, clips: dict[str, FootageContent], comment: str) -> list[str]:
    lines = [f"    {_text(name)}: {_text(s.name)}" for name, s in clips.items()]
    return [f"  {key}:   # {comment}", *lines] if clips else []


def _text(text: str) -> str:
    plain = PLAIN.fullmatch(text) and text.lower() not in WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)
