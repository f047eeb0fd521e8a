"""`devrf-pipeline init DIR`: look at what a crew brought home, write a commented scene.yaml, say what is missing."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from devrf.capture.formats.datasets import DatasetFormat, guess_formats, read_dataset
from devrf.capture.ingest.survey import Footage, Material, find_material, look_at
from devrf.capture.system.amounts import counted
from devrf.capture.system.durable import whole
from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.file_names import safe
from devrf.capture.system.progress import Progress
from devrf.capture.video.timestamps import read_timestamps
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.init.calibrations import take_calibration
from devrf.pipelines.init.material import Roles
from devrf.pipelines.init.names import BY_NAME, called, roles_called
from devrf.pipelines.init.related_files import not_read, sort_clips
from devrf.pipelines.init.roles import FEWEST_PHOTOS, guess_roles, see
from devrf.pipelines.init.scene_yaml import dataset_yaml, scene_yaml
from devrf.pipelines.terminal.console import Talk, duration

PICTURES = 12  # of each clip that are looked at
SCENE = "scene.yaml"


def init(talk: Talk, folder: Path, name: str | None, force: bool) -> Path:
    """Write `folder/scene.yaml` and print a page on what was found, guessed and is missing.

    Returns:
        The file.
    Raises:
        InputError: There is no such folder, a scene.yaml is there already, or nothing in the folder can be used.
    """
    if not os.path.isdir(folder):
        raise InputError("folder-missing", f"{folder}: no such folder; name the folder with the raw files")
    if not os.access(folder, os.R_OK | os.X_OK):
        text = f"{folder}: may not be read; make it readable for this user, or copy it"
        raise InputError("folder-unreadable", text)
    path = folder / SCENE
    if path.exists() and not force:
        text = f"{path}: is there already; use --force to replace it, or `devrf-pipeline check {folder}`"
        raise InputError("file-exists", text)
    name = name or safe(folder.resolve().name, other="-").strip("-")[:100] or "scene"
    with talk.progress("looking") as progress:
        dataset, no_set = _dataset(folder)
        if dataset is not None:
            _write(path, dataset_yaml(name, dataset))
            talk.say(f"{folder}: a finished data set ({dataset}); wrote {path}")
            return path
        material = find_material(folder)
        if no_set is not None and not material.clips:
            raise no_set
        roles = survey(folder, material, progress)
    if no_set is not None and roles.given is None:
        roles.doubts.append(f"no finished data set, though files are called as those of one: {no_set}")
    if roles.sweep is None and not roles.cameras:
        seen = [f"  {file}: {why}" for file, why in roles.left.items()] or ["  nothing"]
        raise InputError(
            "folder-without-clips",
            f"{folder}: nothing that can be used; expected a sweep (a clip from a moving camera, or a folder of at "
            f"least {FEWEST_PHOTOS} photos), or clips of fixed cameras. Seen:\n" + "\n".join(seen),
        )
    for line in (f"found in {folder}", *_page(roles)):
        talk.say(line)
    if roles.sweep is None and not roles.joint and roles.given is None:
        raise InputError(
            "rig-without-source",
            f"{folder}: clips of fixed cameras alone do not tell where the cameras are; film a sweep of the scene at "
            "rest, or a board that several cameras see at once, or put a calibration of all of them at the size that "
            "was filmed into the folder; nothing was written",
        )
    _write(path, scene_yaml(name, roles, "tiny" if shutil.which("nvidia-smi") is None else "fast"))
    talk.say(f"wrote {path}; look through it, then: devrf-pipeline check {path}", style="bold")
    return path


def _dataset(folder: Path) -> tuple[DatasetFormat | None, InputError | None]:
    """Which data set a folder is: one that can be read; else why not, of the likeliest."""
    why = None
    for dataset in guess_formats(folder):
        try:
            read_dataset(dataset, folder)
        except DevrfError as error:
            why = why or InputError(error.code, f"{error} (looked at as a data set, {dataset})")
        else:
            return dataset, None
    return None, why


def survey(folder: Path, material: Material, progress: Progress) -> Roles:
    """Look at everything and guess."""
    looks: list[Footage] = []
    left: dict[str, str] = {}
    own = sort_clips(folder, material)
    work = [*own.clips, *material.photos]
    for n, path in enumerate(work):
        relative, count = path.relative_to(folder).as_posix(), len(material.photos.get(path, ()))
        progress(0.6 * n / len(work), relative)
        if called(relative) in BY_NAME:
            left[relative] = BY_NAME[called(relative)]
        elif 0 < count < FEWEST_PHOTOS and not {"sweep", "board"} & set(roles_called(relative)):
            left[relative] = f"{count} of the {FEWEST_PHOTOS} photos that a sweep needs at least"
        else:
            try:
                looks.append(look_at(path, PICTURES))
            except DevrfError as error:
                left[relative] = str(error).splitlines()[0].removeprefix(f"{path}: ")
    progress(0.6, "boards and movement")
    roles = guess_roles(*see(looks, folder))
    roles.left |= {**left, **own.left, **not_read(folder, material)}
    roles.doubts += own.doubts
    why = "sound by itself; clocks are taken from the clips' own sound"
    roles.left |= {file.relative_to(folder).as_posix(): why for file in material.sounds}
    take_calibration(folder, material.others, roles)
    _find_times(folder, material, roles)
    _find_missing(roles)
    return roles


def _find_times(folder: Path, material: Material, roles: Roles) -> None:
    """The first table of true times that has rows for all cameras."""
    for table in material.tables if roles.fixed else []:
        relative = table.relative_to(folder).as_posix()
        try:
            read_timestamps(table, list(roles.fixed))
        except DevrfError as error:
            if "time" in table.stem.lower():
                roles.left[relative] = f"no table of times: {str(error).removeprefix(f'{table}: ')}"
            continue
        roles.timestamps, roles.why[relative] = relative, "true times of the cameras' frames"
        return


def _find_missing(roles: Roles) -> None:
    """What the crew can still do something about."""
    if roles.board is not None and not roles.metric:
        roles.doubts.append(
            "size of the board's squares: unknown, so the scale is arbitrary. Measure one, put it into "
            "capture.board.square_m (and marker_m), and remove metric: false"
        )
    elif roles.board is None and roles.sweep is not None:
        roles.doubts.append("no calibration board: lenses come from the sweep, and the scale is arbitrary")
    silent = [name for name, s in roles.fixed.items() if not s.look.has_audio]
    if silent and len(roles.fixed) > 1 and roles.timestamps is None:
        roles.doubts.append(
            f"no sound track: {', '.join(silent)}; clocks then come from flashes or motion, which is coarser"
        )
    if roles.sweep is not None and roles.cameras and not roles.tests:
        roles.doubts.append("no test camera: motion is not measured on a view that was never trained on")


def _page(roles: Roles) -> Iterator[str]:
    """What was found, then what is not used, doubtful or missing."""
    chosen = [roles.sweep, *roles.fixed.values(), *roles.boards.values()]
    looks = {s.name: s.look for s in chosen if s is not None}
    for file, why in roles.why.items():
        yield f"  {file}: {_words(looks[file])}; {why}" if file in looks else f"  {file}: {why}"
    if roles.board is not None:
        yield f"  board: {roles.board.spec.words}, as far as it is seen"
    for title, lines in (
        ("not used", [f"{file}: {why}" for file, why in roles.left.items()]),
        ("doubtful or missing", roles.doubts),
    ):
        yield from [title, *(f"  {line}" for line in lines)] if lines else ()


def _words(look: Footage) -> str:
    size = f"{look.width}x{look.height}"
    if look.is_clip:
        rate = f", {(look.count - 1) / look.duration_s:.4g} fps" if look.duration_s else ""
        sound = ", with sound" if look.has_audio else ""
        return "; ".join([f"{size}{rate}, {duration(look.duration_s)}{sound}", *look.notes])
    return "; ".join([f"{counted(look.count, 'photo')}, {size} {look.device}".strip(), *look.notes])


def _write(path: Path, text: str) -> None:
    """All of it or nothing, and only what `run` takes: a full disk leaves the file that was there."""
    with whole(path) as new:
        new.write_text(text, encoding="utf-8")
        load_scene(new)
