"""The page that `init` prints: what was found and guessed (with why), what is not used, what is doubtful or missing."""

from pathlib import Path

from devrf.capture.survey import Look, Material
from devrf.pipelines.console import Talk, duration
from devrf.pipelines.init.found import Found, Roles
from devrf.pipelines.init.names import photos
from devrf.pipelines.init.roles import FEWEST_PHOTOS

LISTED = 10  # files that were not looked into


def summary(talk: Talk, folder: Path, material: Material, found: Found) -> None:
    """Print all of it, but for what was written."""
    roles = found.roles
    talk.say(f"found in {folder}", style="bold")
    chosen = [roles.sweep, *roles.cameras.values(), *roles.tests.values(), *roles.boards.values()]
    for s in {s.name: s for s in chosen if s is not None}.values():
        talk.say(f"  {s.name}: {_words(s.look)}; {roles.why[s.name]}")
        for note in s.look.notes:
            talk.say(f"    {note}")
    for file in (found.timestamps, found.given):
        if file is not None:
            talk.say(f"  {file}: {roles.why[file]}")
    if roles.board is not None:
        how = (
            "told from what is printed on it"
            if roles.boards or roles.joint
            else "as far as it is seen: count its squares"
        )
        talk.say(f"  board: {roles.board.spec.words}, {how}")
    if roles.cameras and roles.sweep is not None:
        how = "end" if found.rest == "end" else "begin"
        talk.say(f"  the clips {how} with the scene as the sweep shows it (rest: {found.rest})")
    _section(talk, "cannot be used as it is", _listed(roles.faulty), "bold red")
    _section(talk, "not used", _unused(folder, material, roles))
    _section(talk, "doubtful or missing", [*roles.doubts, *_missing(found)])


def nothing(folder: Path, material: Material, roles: Roles) -> str:
    """What to say where nothing can be used: everything that was seen."""
    seen = _listed(roles.faulty) + _unused(folder, material, roles)
    seen += [f"{path.relative_to(folder)}: not looked into" for path in material.ignored[:LISTED]]
    return (
        f"{folder}: nothing that can be used; expected a sweep (a clip from a moving camera, or a folder of at least "
        f"{FEWEST_PHOTOS} photos), or clips of fixed cameras. Seen:\n"
        + "\n".join(f"  {text}" for text in seen or ["nothing"])
    )


def _section(talk: Talk, title: str, texts: list[str], style: str = "bold") -> None:
    if texts:
        talk.say(title, style=style)
    for text in texts:
        talk.say(f"  {text}")


def _unused(folder: Path, material: Material, roles: Roles) -> list[str]:
    def named(path: Path) -> str:
        return path.relative_to(folder).as_posix()

    return [
        *_listed(roles.unused),
        *(
            f"{named(f)}: sound by itself; clocks are taken from the clips' own sound"
            for f in material.sounds
        ),
        *(f"{named(photo)}: HEIC or AVIF; convert it to JPEG" for photo in material.heic),
    ]


def _listed(files: dict[str, str]) -> list[str]:
    return [f"{name}: {why}" for name, why in files.items()]


def _missing(found: Found) -> list[str]:
    roles, out = found.roles, []
    if roles.board is not None and not roles.metric:
        out.append(
            "size of the board's squares: unknown, so the scale is arbitrary. Measure one, put it into "
            "capture.board.square_m (and marker_m), and remove metric: false"
        )
    elif roles.board is None and roles.sweep is not None:
        out.append("no calibration board: lenses come from the sweep, and the scale is arbitrary")
    silent = [name for name, s in {**roles.cameras, **roles.tests}.items() if not s.look.has_audio]
    if silent and len(roles.cameras) + len(roles.tests) > 1 and found.timestamps is None:
        out.append(
            f"no sound track: {', '.join(silent)}; clocks then come from flashes or motion, which is coarser"
        )
    if roles.sweep is not None and roles.cameras and not roles.tests:
        out.append("no test camera: results in motion are not measured on a view that was never trained on")
    return out


def _words(look: Look) -> str:
    if not look.is_clip:
        device = f", {look.device}" if look.device else ""
        return f"{photos(look.count)}, {look.width}x{look.height}{device}"
    fps = f", {look.fps:.4g} fps" if look.fps else ""
    sound = ", with sound" if look.has_audio else ""
    return f"{look.width}x{look.height}{fps}, {duration(look.duration_s or 0.0)}{sound}"
