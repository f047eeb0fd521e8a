"""The small session that the suite damages where no other scene is given, and how sessions are made in its folders."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from typing import Any

from devrf.capture.errors import InputError
from devrf.capture.progress import Progress, no_progress
from devrf.capture.simulate.session import simulate_session
from devrf.capture.simulate.session_options import SessionOptions
from devrf.pipelines.console import Talk

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


def session(out: Path, talk: Talk) -> Path:
    """The session's scene.yaml in `out`.

    Raises:
        InputError: Another session lies there, of an older version.
    """
    made_by = {"scene": SCENE, "cameras": CAMERAS, "seed": 0, "size": SIZE, "options": OPTIONS}
    folder = out / "session"
    if folder.exists() and how_it_was_made(folder) != how(**made_by):
        raise InputError(
            f"{folder}: not the session that bench stability renders now, so its cases would not compare; give another "
            "--out, or delete that folder"
        )
    with talk.progress("simulate") as progress:
        return rendered(folder, made_by, progress=progress)


def rendered(
    folder: Path, made_by: Mapping[str, Any], kept: Sequence[Path] = (), progress: Progress = no_progress
) -> Path:
    """A session's scene.yaml; rendered where it is not there yet or was made otherwise, whole or not at all.

    Args:
        folder: Of the session.
        made_by: The arguments of `simulate_session`.
        kept: Clips that are there already.
        progress: Told after every picture.
    """
    if how_it_was_made(folder) != how(**made_by):
        rmtree(folder, ignore_errors=True)
        new = folder.with_name(f".new-{folder.name}")
        rmtree(new, ignore_errors=True)
        simulate_session(new, **made_by, kept=kept, progress=progress)
        new.rename(folder)
    return folder / "scene.yaml"


def how(
    scene: str, cameras: int, seed: int, size: tuple[int, int], options: SessionOptions
) -> dict[str, Any]:
    """The arguments of `simulate_session` as they are compared."""
    return {
        "scene": scene,
        "cameras": cameras,
        "seed": seed,
        "size": list(size),
        "options": options.model_dump(mode="json"),
    }


def how_it_was_made(folder: Path) -> dict[str, Any] | None:
    """The same of a session that lies there, by its truth; None where there is none."""
    truth = folder / "ground_truth.json"
    if not truth.is_file() or not (folder / "scene.yaml").is_file():
        return None
    content = json.loads(truth.read_text(encoding="utf-8"))
    cameras = len(content["cams"]) - 1  # the last is the witness
    return content["made_by"] | {"cameras": cameras, "size": [content["width"], content["height"]]}
