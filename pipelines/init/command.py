"""`devrf-pipeline init DIR`: look at what a crew brought home, write a commented scene.yaml, say what is missing."""

import re
import shutil
from pathlib import Path

from devrf.capture.errors import DevrfError, InputError
from devrf.capture.formats.datasets import guess_format
from devrf.capture.progress import Progress
from devrf.capture.session import TIMESTAMP_COLUMNS, Rest
from devrf.capture.survey import Look, Material, find_material, look_at_clip, look_at_photos, still_ends
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk, duration
from devrf.pipelines.init.roles import FEWEST_PHOTOS, Found, Roles, called, guess_roles, see
from devrf.pipelines.init.yaml import dataset_yaml, scene_yaml

PICTURES = 12  # of each clip that are looked at
REST_SHARE = 0.005  # of the picture: more changes from picture to picture where something moves
CALIBRATIONS = frozenset((".toml", ".yml", ".yaml", ".xml", ".txt"))
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
        path.write_text(dataset_yaml(name, dataset), encoding="utf-8")
        talk.say(f"{folder}: a finished data set ({dataset}); wrote {path}")
        return path
    material = find_material(folder)
    with talk.progress("looking") as progress:
        found = survey(folder, material, progress)
    roles = found.roles
    if roles.sweep is None and not roles.cameras:
        raise InputError(_nothing(folder, material, roles))
    text = scene_yaml(name, found)
    path.write_text(text, encoding="utf-8")
    load_scene(path)  # what is written must be what `run` takes
    _summary(talk, folder, path, material, found)
    return path


def survey(folder: Path, material: Material, progress: Progress) -> Found:
    """Look at everything and guess."""
    looks: list[Look] = []
    broken: dict[str, str] = {}
    work = [(clip, True) for clip in material.clips] + [(photos, False) for photos in material.photos]
    for n, (path, is_clip) in enumerate(work):
        relative = path.relative_to(folder).as_posix()
        progress(0.6 * n / len(work), relative)
        few = (
            not is_clip
            and len(material.photos[path]) < FEWEST_PHOTOS
            and called(relative) not in ("sweep", "board")
        )
        if few or called(relative) in ("white", "chart", "matte"):
            count = 1 if is_clip else len(material.photos[path])
            broken[relative] = (
                f"{count} {'clip' if is_clip else 'photos'} of no role that can be guessed; not used"
            )
            continue
        try:
            looks.append((look_at_clip if is_clip else look_at_photos)(path, PICTURES))
        except DevrfError as error:
            broken[relative] = str(error).splitlines()[0].replace(f"{folder}/", "")
    progress(0.6, "boards and movement")
    roles = guess_roles(*see(looks, folder))
    roles.unused |= broken
    progress(0.95, "rest")
    rest = _rest(roles)
    return Found(roles, rest, _timestamps(folder, material, roles), shutil.which("nvidia-smi") is not None)


def _rest(roles: Roles) -> Rest:
    """Whether the fixed cameras' clips begin or end with nothing moving."""
    if roles.sweep is None or not roles.cameras:
        return "start"
    ends = [still_ends(s.look) for s in roles.cameras.values()]
    still = [
        sum(share is not None and share <= REST_SHARE for share in end) for end in zip(*ends, strict=True)
    ]
    if max(still) == 0:
        roles.doubts.append(
            "something moves at the start and at the end of every clip: rest: start is a guess. Let the cameras see "
            "the scene as in the sweep for a second before the action"
        )
    return "end" if still[1] > still[0] else "start"


def _timestamps(folder: Path, material: Material, roles: Roles) -> str | None:
    """A table of true times that has rows for all cameras."""
    for table in material.tables:
        with table.open(encoding="utf-8-sig", errors="replace") as file:
            columns = [word.strip() for word in file.readline().split(",")]
            if not set(TIMESTAMP_COLUMNS) <= set(columns):
                continue
            at = columns.index("camera")
            named = {cells[at].strip() for line in file if len(cells := line.split(",")) == len(columns)}
        relative = table.relative_to(folder).as_posix()
        missing = [name for name in (*roles.cameras, *roles.tests) if name not in named]
        if not missing:
            roles.why[relative] = "true times of the cameras' frames"
            return relative
        roles.unused[relative] = f"a table of times without rows for {', '.join(missing)}"
    return None


def _scene_name(folder: Path) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", folder.resolve().name).strip("-")[:100] or "scene"


def _nothing(folder: Path, material: Material, roles: Roles) -> str:
    """What to say where nothing can be used: everything that was seen."""
    seen = [
        *(f"  {name}: {why}" for name, why in roles.unused.items()),
        *(f"  {path.relative_to(folder)}: sound" for path in material.sounds),
        *(
            f"  {path.relative_to(folder)}: a HEIC or AVIF photo; convert it to JPEG"
            for path in material.heic
        ),
        *(f"  {path.relative_to(folder)}: not looked into" for path in material.ignored[:10]),
    ]
    expected = "expected a sweep (a clip from a moving camera, or a folder of at least "
    expected += f"{FEWEST_PHOTOS} photos), or clips of fixed cameras"
    return f"{folder}: nothing that can be used; {expected}. Seen:\n" + ("\n".join(seen) or "  nothing")


def _summary(talk: Talk, folder: Path, path: Path, material: Material, found: Found) -> None:
    roles = found.roles
    talk.say(f"found in {folder}", style="bold")
    chosen = [roles.sweep, *roles.cameras.values(), *roles.tests.values(), *roles.boards.values()]
    for s in dict.fromkeys(s.name for s in chosen if s is not None):
        look = next(c.look for c in chosen if c is not None and c.name == s)
        talk.say(f"  {s}: {_words(look)}; {roles.why[s]}")
        for note in look.notes:
            talk.say(f"    {note}")
    if found.timestamps is not None:
        talk.say(f"  {found.timestamps}: {roles.why[found.timestamps]}")
    if roles.board is not None:
        talk.say(f"  board: {roles.board.spec.words}, told from what is printed on it")
    if roles.cameras and roles.sweep is not None:
        talk.say(f"  rest: {found.rest}: when the clips show the scene as in the sweep")
    if roles.unused or material.sounds or material.heic:
        talk.say("not used", style="bold")
    for name, why in roles.unused.items():
        talk.say(f"  {name}: {why}")
    for sound in material.sounds:
        talk.say(
            f"  {sound.relative_to(folder)}: sound by itself; clocks are taken from the clips' own sound"
        )
    for photo in material.heic:
        talk.say(f"  {photo.relative_to(folder)}: HEIC or AVIF; convert it to JPEG")
    files = [f for f in material.ignored if f.suffix.lower() in CALIBRATIONS and f.name != SCENE]
    if files:
        names = ", ".join(f.relative_to(folder).as_posix() for f in files[:5])
        talk.say(f"  {names}: if this is a calibration you own, name it in calibration.rig.given")
    missing = [*roles.doubts, *_missing(roles)]
    if missing:
        talk.say("doubtful or missing", style="bold")
    for text in missing:
        talk.say(f"  {text}")
    talk.say(f"wrote {path}; look through it, then: devrf-pipeline check {path}", style="bold")


def _missing(roles: Roles) -> list[str]:
    out = []
    if roles.board is not None:
        out.append(
            "size of the board's squares: unknown, so the scale is arbitrary. Measure one, put it into "
            "capture.board.square_m (and marker_m), and remove metric: false"
        )
    else:
        out.append("no calibration board: lenses come from the sweep, and the scale is arbitrary")
    silent = [name for name, s in {**roles.cameras, **roles.tests}.items() if not s.look.has_audio]
    if silent and len(roles.cameras) + len(roles.tests) > 1:
        out.append(
            f"no sound track: {', '.join(silent)}; clocks then come from flashes or motion, which is coarser"
        )
    if roles.cameras and not roles.tests:
        out.append("no test camera: results in motion are not measured on a view that was never trained on")
    return out


def _words(look: Look) -> str:
    if not look.is_clip:
        return f"{look.count} photos, {look.width}x{look.height}" + (
            f", {look.device}" if look.device else ""
        )
    fps = f", {look.fps:.4g} fps" if look.fps else ""
    sound = ", with sound" if look.has_audio else ""
    return f"{look.width}x{look.height}{fps}, {duration(look.duration_s or 0.0)}{sound}"
