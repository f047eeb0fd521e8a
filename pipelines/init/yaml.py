"""The commented scene.yaml that `init` writes."""

import json
import re

from devrf.calibration.boards.spec import BoardSpec
from devrf.pipelines.init.found import Found, Roles, Seen

PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # what YAML reads as text without quotes ...
WORDS = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))  # ... but for these


def scene_yaml(name: str, found: Found) -> str:
    """The whole file."""
    roles = found.roles
    preset = "fast" if found.has_gpu else "tiny"
    why = (
        "an NVIDIA GPU is here; tiny for two CPU cores"
        if found.has_gpu
        else "no NVIDIA GPU here; fast with one"
    )
    lines = [
        "# Written by `devrf-pipeline init` from what the clips show; every key is in docs/configuration.md.",
        "# Paths are relative to this file. `devrf-pipeline check` looks at it before anything runs.",
        f"name: {_text(name)}",
        f"preset: {preset}                       # {why}",
        "capture:",
    ]
    if roles.sweep is not None:
        lines.append(f"  static: {_text(roles.sweep.name)}   # {roles.why[roles.sweep.name]}")
    lines += _clips(
        "cameras", roles.cameras, "fixed cameras of the moving scene; the first one's clock is everyone's"
    )
    lines += _clips("test_cameras", roles.tests, "never trained on")
    if found.timestamps is not None:
        lines.append(f"  timestamps: {_text(found.timestamps)}   # true times of the frames")
    if roles.cameras and roles.sweep is not None:
        lines.append(
            f"  rest: {found.rest}                      # the clips show the scene as in the sweep: start, end or none"
        )
    if roles.board is not None:
        lines += _board(roles.board.spec, roles)
    if found.given is not None:
        lines.append("calibration:")
        lines.append(f"  rig: {{given: {_text(found.given)}}}   # {roles.why[found.given]}")
    for file, reason in {**roles.faulty, **roles.unused}.items():
        lines.append(f"# not used: {file}: {reason}".replace("\n", " "))
    return "\n".join(lines) + "\n"


def dataset_yaml(name: str, dataset_format: str) -> str:
    """The file beside a finished data set."""
    return (
        "# Written by `devrf-pipeline init`; every key is in docs/configuration.md.\n"
        f"name: {_text(name)}\n"
        f"dataset: {{format: {dataset_format}, path: .}}\n"
    )


def _board(spec: BoardSpec, roles: Roles) -> list[str]:
    lines = [
        "  board:                         # told from the pictures, but for its size",
        f"    type: {spec.type}",
    ]
    what = {"charuco": "squares", "chessboard": "inner corners", "aruco_grid": "markers"}[spec.type]
    lines.append(
        f"    squares: [{spec.squares[0]}, {spec.squares[1]}]              # columns and rows of {what}"
    )
    if roles.metric:
        lines.append(
            "    metric: false                # nobody measured it: metres come from the calibration"
        )
    else:
        lines.append(
            "    metric: false                # nobody measured it: the scale stays arbitrary. To have metres,"
        )
        lines.append(
            "    #                              give true lengths in the next lines and remove this one"
        )
    share = spec.marker_m or 0.75
    if spec.type != "aruco_grid":
        lines.append("    square_m: 1.0                # side of a square")
    if spec.type != "chessboard":
        lines.append(f"    marker_m: {share:.2f}               # side of a marker, in proportion as seen")
        lines.append(f"    dictionary: {spec.dictionary}")
        lines.append(
            f"    inverted: {str(spec.inverted is True).lower()}              # true: printed white on black"
        )
    if spec.type == "aruco_grid":
        lines.append(
            f"    separation_m: {1 - share:.2f}           # gap between markers, in proportion as seen"
        )
    lines += ["  " + line for line in _clips("clips", roles.boards, "the board before one camera at a time")]
    lines += [
        "  " + line for line in _clips("joint_clips", roles.joint, "the board before several cameras at once")
    ]
    return lines


def _clips(key: str, clips: dict[str, Seen], comment: str) -> list[str]:
    if not clips:
        return []
    return [
        f"  {key}:   # {comment}",
        *(f"    {_text(name)}: {_text(s.name)}" for name, s in clips.items()),
    ]


def _text(text: str) -> str:
    plain = PLAIN.fullmatch(text) and text.lower() not in WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)
