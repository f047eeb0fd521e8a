"""`devrf-pipeline demo`: the example session that comes with the program, in a folder of the user's."""

import filecmp
import shutil
from pathlib import Path

import devrf
from devrf.capture.system.errors import InputError
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told

INSTALLED = Path(devrf.__file__).with_name("example")  # by setup.py, which takes it from ...
IN_A_CLONE = Path(__file__).parents[2] / "examples" / "workshop"
OURS = (".mp4", ".json", ".npz", ".yaml", ".md")


def lay_out(talk: Talk, folder: Path) -> Path:
    """Put the example's files into a folder; those of an earlier demo are left as they are.

    Returns:
        Its scene.yaml.
    Raises:
        InputError: The folder holds a file of such a name that is another one, or cannot be written.
    """
    example = INSTALLED if INSTALLED.is_dir() else IN_A_CLONE
    sources = sorted(path for path in example.iterdir() if path.suffix in OURS)
    remedy = "name another folder: devrf-pipeline demo DIR"
    with disk_told(folder, remedy, InputError):
        folder.mkdir(parents=True, exist_ok=True)
        for source in sources:
            place = folder / source.name
            if place.exists() and not (place.is_file() and filecmp.cmp(source, place, shallow=False)):
                raise InputError("file-exists", f"{place}: is no file of the example; {remedy}")
        missing = [source for source in sources if not (folder / source.name).exists()]
        for source in missing:
            shutil.copyfile(source, folder / source.name)
    if missing:
        talk.say(
            f"the example session is in {folder}: its clips, its truth, and scene.yaml, which says what to do"
        )
    return folder / "scene.yaml"
