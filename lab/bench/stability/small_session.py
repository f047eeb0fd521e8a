"""The small session that the suite damages where no other scene is given, and how sessions are made in its folders."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import rmtree

from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.lab.simulate_command import session_code
from devrf.pipelines.terminal.console import Talk

SCENE, CAMERAS, SIZE = "sheet", 4, (240, 180)
OPTIONS = SessionOptions(
    sweep_frames=48,
    sweep_radius_m=1.2,
    fps=10.0,
    duration_s=1.3,
    motion_speed=1.5,
    camera_distance_m=1.1,  # so near that motion fills the picture: else blur of the walls decides
    offset_range_s=0.1,
    noise=0.003,
    claps=3,
    board=False,  # too small to be read in such pictures; lengths are not metres without it
)
SETTINGS = (
    "preset=tiny",
    "reconstruct.image_scale=0.5",
    "reconstruct.resolution=56",
    "reconstruct.rays=1536",
    "reconstruct.canonical_iterations=300",
    "reconstruct.motion_iterations=100",
)


TRUTH = "ground_truth.json"


@dataclass(frozen=True)
class Simulated(Simulation[SessionOptions]):
    """How a session was simulated, and by what.

    Attributes:
        code: Version of the simulator's code; None where nobody has said.
    """

    code: str | None = field(default_factory=session_code)

    @classmethod
    def of(cls, truth: Path) -> "Simulated | None":
        """The same of a session that lies there; None where its truth does not say, or not in words of today."""
        try:
            content = json.loads(truth.read_text(encoding="utf-8"))
            made_by = content["made_by"]
            return cls(
                made_by["scene"],
                len(content["cams"]) - 1,  # the last is the witness
                made_by["seed"],
                (content["width"], content["height"]),
                SessionOptions.model_validate(made_by["options"]),
                made_by.get("code"),
            )
        except (FileNotFoundError, KeyError, TypeError, ValueError):
            return None


def session(out: Path, talk: Talk) -> Path:
    """The session's scene.yaml in `out`.

    Raises:
        InputError: Another session lies there, or one of another version.
    """
    made, folder = Simulated(SCENE, CAMERAS, 0, SIZE, OPTIONS), out / "session"
    if folder.exists() and not is_rendered(folder, made):
        there = Simulated.of(folder / TRUTH)
        same = there is not None and replace(there, code=made.code) == made
        code = "session-outdated" if same else "session-differs"
        what = (
            "rendered by another version of the simulator" if same else "not the session that is rendered now"
        )
        text = f"{folder}: {what}, so its cases would not compare; give another --out, or delete that folder"
        raise InputError(code, text)
    with talk.progress("simulate") as progress:
        return rendered(folder, made, progress=progress)


def rendered(
    folder: Path, made: Simulated, kept: Sequence[Path] = (), progress: Progress = no_progress
) -> Path:
    """A session's scene.yaml; rendered where it is not there yet or was made otherwise, whole or not at all.

    Args:
        folder: Of the session.
        made: How.
        kept: Clips that are there already.
        progress: Told after every picture.
    Raises:
        InputError: The simulator refuses it, or the folder; what lay there still does.
    """
    if not is_rendered(folder, made):
        new = folder.with_name(f".new-{folder.name}")
        rmtree(new, ignore_errors=True)
        simulate_session(new, made, kept=kept, code=made.code, progress=progress)
        rmtree(folder, ignore_errors=True)
        new.rename(folder)
    return folder / "scene.yaml"


def is_rendered(folder: Path, made: Simulated) -> bool:
    """Whether this session lies there."""
    return (folder / "scene.yaml").is_file() and Simulated.of(folder / TRUTH) == made
