"""Calibrations of other tools that lie beside the clips: which of them place the cameras that were found."""

from collections.abc import Sequence
from pathlib import Path

from devrf.calibration.formats import find_calibration
from devrf.calibration.rigs.given import read_given
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.health.judge import judge
from devrf.pipelines.init.material import Roles

SUFFIXES = frozenset((".toml", ".yml", ".yaml", ".xml", ".txt", ".json", ".npy"))
NOT_OURS = frozenset(("scene.yaml", "ground_truth.json"))  # a truth is for comparing, never for calibrating


def take_calibration(folder: Path, files: Sequence[Path], roles: Roles) -> None:
    """Take the first that places every camera, where nothing else would; the others are named as not used."""
    sizes = {name: (s.look.width, s.look.height) for name, s in roles.fixed.items()}
    clips = {name: s.look for name, s in roles.fixed.items()}
    for file in files if sizes else ():
        if file.suffix.lower() not in SUFFIXES or file.name in NOT_OURS:
            continue
        name = file.relative_to(folder).as_posix()
        try:
            words = find_calibration(file).format
        except DevrfError:
            continue  # another kind of file
        try:
            given = read_given(file, list(sizes), sizes, clips=clips)
        except DevrfError as error:
            roles.left[name] = f"a calibration ({words}), but {str(error).removeprefix(f'{file}: ')}"
            continue
        if given.rig is None or roles.sweep is not None or roles.joint or roles.given is not None:
            roles.left[name] = f"a calibration ({words}); to use it, name it in calibration.rig.given"
            continue
        roles.given, roles.metric = name, given.rig.scale.metric
        roles.why[name] = f"a calibration ({words}): lenses and poses of the cameras"
        doubts = [row for row in judge(given.measures) if row.verdict != "ok"]
        roles.doubts += [f"{name}: {row.title}: {row.value}. {row.remedy}" for row in doubts]
