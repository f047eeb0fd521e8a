"""`devrf-pipeline init DIR`: look at what a crew brought home, write a commented scene.yaml, say what is missing."""

import re
import shutil
from pathlib import Path

from devrf.capture.errors import DevrfError, InputError
from devrf.capture.formats.datasets import guess_format
from devrf.capture.progress import Progress
from devrf.capture.session import Rest, read_timestamps
from devrf.capture.stillness import AT_REST
from devrf.capture.survey import Look, Material, find_material, look_at, still_ends
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.init.calibrations import given_calibration
from devrf.pipelines.init.found import Found, Roles
from devrf.pipelines.init.names import BY_NAME, called, roles_called
from devrf.pipelines.init.roles import FEWEST_PHOTOS, guess_roles, see
from devrf.pipelines.init.summary import nothing, summary
from devrf.pipelines.init.yaml import dataset_yaml, scene_yaml

PICTURES = 12  # of each clip that are looked at
SCENE = "scene.yaml"


def init(talk: Talk, folder: Path, name: str | None, force: bool) -> Path:
    """Write `folder/scene.yaml` and print a page on what was found, guessed and is missing.

    Returns:
        The file.
    Raises:
        InputError: There is no such folder, a scene.yaml is there already, or nothing in the folder can be used.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder with the raw files")
    path = folder / SCENE
    if path.exists() and not force:
        raise InputError(
            f"{path}: is there already; use --force to replace it, or `devrf-pipeline check {folder}`"
        )
    name = name or _scene_name(folder)
    dataset = guess_format(folder)
    if dataset is not None:
        _write(path, dataset_yaml(name, dataset))
        talk.say(f"{folder}: a finished data set ({dataset}); wrote {path}")
        return path
    material = find_material(folder)
    with talk.progress("looking") as progress:
        found = survey(folder, material, progress)
    roles = found.roles
    if roles.sweep is None and not roles.cameras:
        raise InputError(nothing(folder, material, roles))
    summary(talk, folder, material, found)
    if roles.sweep is None and not roles.joint and found.given is None:
        raise InputError(_unplaced(folder, roles))
    _write(path, scene_yaml(name, found))
    talk.say(f"wrote {path}; look through it, then: devrf-pipeline check {path}", style="bold")
    return path


def survey(folder: Path, material: Material, progress: Progress) -> Found:
    """Look at everything and guess."""
    looks: list[Look] = []
    left_out: dict[str, str] = {}
    broken: dict[str, str] = {}
    work = [(clip, True) for clip in material.clips] + [(photos, False) for photos in material.photos]
    for n, (path, is_clip) in enumerate(work):
        relative = path.relative_to(folder).as_posix()
        progress(0.6 * n / len(work), relative)
        if called(relative) in BY_NAME:
            left_out[relative] = BY_NAME[called(relative)]
        elif not is_clip and _too_few(relative, len(material.photos[path])):
            left_out[relative] = (
                f"{len(material.photos[path])} of the {FEWEST_PHOTOS} photos that a sweep needs at least"
            )
        else:
            try:
                looks.append(look_at(path, PICTURES))
            except DevrfError as error:
                broken[relative] = str(error).splitlines()[0].removeprefix(f"{path}: ")
    progress(0.6, "boards and movement")
    roles = guess_roles(*see(looks, folder))
    roles.unused |= left_out
    roles.faulty |= broken
    given = given_calibration(folder, material.ignored, roles)
    progress(0.95, "rest")
    rest = _rest(roles)
    times = _timestamps(folder, material, roles)
    return Found(roles, rest, times, given, shutil.which("nvidia-smi") is not None)


def _unplaced(folder: Path, roles: Roles) -> str:
    """What to say where nothing tells the cameras' places."""
    calibration = "put a calibration you own into the folder"
    if roles.unfit:
        calibration = (
            f"make {roles.unfit[0]} fit, which is there but is for other pictures or cameras: film at the size that "
            "it was calibrated at, or leave the clip of the camera that it does not fit out of the folder"
        )
    return (
        f"{folder}: clips of fixed cameras alone do not tell where the cameras are; film a sweep of the scene at "
        f"rest, or a board that several cameras see at once, or {calibration}; nothing was written"
    )


def _too_few(relative: str, count: int) -> bool:
    """Whether a folder of photos can neither be a sweep nor show a board."""
    return count < FEWEST_PHOTOS and not {"sweep", "board"} & set(roles_called(relative))


def _rest(roles: Roles) -> Rest:
    """Whether the fixed cameras' clips begin or end with nothing moving."""
    if roles.sweep is None or not roles.cameras:
        return "start"
    ends = [still_ends(s.look) for s in roles.cameras.values()]
    still = [sum(share is not None and share <= AT_REST for share in end) for end in zip(*ends, strict=True)]
    if max(still) == 0:
        roles.doubts.append(
            "something moves at the start and at the end of every clip: rest: start is a guess. Let the cameras see "
            "the scene as in the sweep for a second before the action"
        )
    return "end" if still[1] > still[0] else "start"


def _timestamps(folder: Path, material: Material, roles: Roles) -> str | None:
    """The first table of true times that has rows for all cameras."""
    cameras = [*roles.cameras, *roles.tests]
    for table in material.tables if cameras else []:
        relative = table.relative_to(folder).as_posix()
        try:
            read_timestamps(table, cameras)
        except DevrfError as error:
            if "time" in table.stem.lower():
                roles.unused[relative] = f"no table of times: {str(error).removeprefix(f'{table}: ')}"
            continue
        roles.why[relative] = "true times of the cameras' frames"
        return relative
    return None


def _write(path: Path, text: str) -> None:
    """All of it or nothing, and only what `run` takes: a full disk leaves the file that was there."""
    new = path.with_name(f".{path.name}.new")
    try:
        new.write_text(text, encoding="utf-8")
        load_scene(new)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def _scene_name(folder: Path) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name).strip("-")[:100] or "scene"
