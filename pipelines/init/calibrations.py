"""Calibrations of other tools that lie beside the clips: which of them place the cameras that were found."""

from collections.abc import Sequence
from pathlib import Path

from devrf.calibration.formats import find_calibration
from devrf.calibration.rigs.given import read_given
from devrf.capture.errors import DevrfError
from devrf.pipelines.init.found import Roles

SUFFIXES = frozenset((".toml", ".yml", ".yaml", ".xml", ".txt", ".json"))
NOT_OURS = frozenset(("scene.yaml", "ground_truth.json"))  # a truth is for comparing, never for calibrating


def given_calibration(folder: Path, files: Sequence[Path], roles: Roles) -> str | None:
    """The first calibration that places every camera, where nothing else would; the others are named as not used.

    Args:
        folder: What `init` looks at.
        files: Files in it of no other kind.
        roles: Its cameras; what is said of calibrations is added.
    """
    cameras = {**roles.cameras, **roles.tests}
    if not cameras:
        return None
    sizes = {name: (s.look.width, s.look.height) for name, s in cameras.items()}
    chosen = None
    for file in files:
        if file.suffix.lower() not in SUFFIXES or file.name in NOT_OURS:
            continue
        name = file.relative_to(folder).as_posix()
        try:
            words = find_calibration(file).format
        except DevrfError:
            continue  # another kind of file
        try:
            given = read_given(file, list(cameras), sizes)
        except DevrfError as error:
            roles.unused[name] = f"a calibration ({words}), but {str(error).removeprefix(f'{file}: ')}"
            roles.unfit.append(name)
            continue
        if given.rig is None or roles.sweep is not None or roles.joint or chosen is not None:
            what = "lenses" if given.rig is None else "lenses and poses"
            roles.unused[name] = (
                f"a calibration ({words}: {what}); to use it, name it in calibration.rig.given"
            )
            continue
        chosen = name
        roles.metric = given.rig.scale.metric
        roles.why[name] = f"a calibration ({words}): lenses and poses of the cameras"
        roles.doubts += [
            f"{name}: {note.check}: {note.text}. {note.remedy}" for note in given.notes if note.remedy
        ]
    return chosen
