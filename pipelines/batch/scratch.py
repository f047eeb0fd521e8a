"""A scene of a store on the machine that works on it: raw files and finished stages come, new ones go.

<scratch>/scenes/<scene>/scene/...   the scene's folder
<scratch>/scenes/<scene>/run/...     its run folder
<scratch>/inputs/<digest>            raw files, hard links to those in the scenes' folders: fetched once for all of them

Scenes side by side share only `inputs`, and that by single links: none can take away what another uses. The folder is
its user's alone: whoever else could write there could say what runs; and what is linked is read and compared first.
"""

import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.errors import InputError
from devrf.pipelines.batch.store import DamagedError, SizeAndDigest, Store
from devrf.pipelines.runner.workspace import Workspace
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.digests import file_digest
from devrf.pipelines.stamps.stamp import is_whole, read_stamp, stamp_id

SCRATCH = "DEVRF_SCRATCH"  # environment variable: folder on a fast disk of this machine


@dataclass(frozen=True)
class Stored:
    """A scene that lies in a store.

    Attributes:
        url: The store.
        name: What the scene is called there.
        scene: File name of its scene.yaml.
        files: Path in the scene's folder -> size and digest.
    """

    url: str
    name: str
    scene: str
    files: dict[str, SizeAndDigest]


class Scratch:
    """The copy of a scene on this machine.

    Args:
        stored: The scene.
    Raises:
        InputError: Others could write where it is to lie.
    """

    def __init__(self, stored: Stored) -> None:
        self._stored, self._store = stored, Store(stored.url)
        folder = scratch_dir(stored.url)
        _make_own(folder)
        self._inputs = folder / "inputs"
        self._base = folder / "scenes" / stored.name
        self.scene = self._base / "scene" / stored.scene
        self.run_dir = self._base / "run"
        self.damaged: dict[str, str] = {}  # stage -> what is wrong with it in the store
        self._pushed: set[str] = set()

    def fetch(self, stages: tuple[str, ...]) -> tuple[str, ...]:
        """Get the raw files, and the stages that these stages are or read, as far as they are stored.

        Returns:
            Stages to run: these, begun earlier where what they read is damaged in the store and has to be made anew.
        Raises:
            InputError: A run works here.
            StoreError: The store does not answer, or not with the raw files that were put into it.
        """
        with Workspace(self.run_dir) as workspace:
            self._fetch_inputs()
            return self._fetch_stages(stages, workspace)

    def push(self, stages: tuple[str, ...]) -> None:
        """Store what has been finished since."""
        for stage in stages:
            stamp = read_stamp(self.run_dir / stage)
            if stamp is not None and is_whole(stamp) and stamp["id"] not in self._pushed:
                self._store.push(self._stored.name, self.run_dir / stage, stamp)
                self._pushed.add(stamp["id"])

    def remove(self) -> None:
        """Make room: the scene's folders, and raw files that no other scene here uses."""
        shutil.rmtree(self._base, ignore_errors=True)
        for file in self._inputs.glob("*"):
            with contextlib.suppress(FileNotFoundError):
                if file.stat().st_nlink == 1:
                    file.unlink()

    def _fetch_stages(self, stages: tuple[str, ...], workspace: Workspace) -> tuple[str, ...]:
        names = [stage.name for stage in STAGES]
        read = {name for stage in STAGES if stage.name in stages for name in stage.reads}
        wanted = [name for name in names if name in read.union(stages) and name not in self.damaged]
        for stage, stamp in self._store.stamps(self._stored.name, wanted).items():
            try:
                if stamp_id(self.run_dir / stage) != stamp["id"]:
                    self._store.pull(self._stored.name, stage, stamp, workspace)
                self._pushed.add(stamp["id"])
            except DamagedError as error:
                self.damaged[stage] = str(error)
        first, last = min(map(names.index, (stages[0], *self.damaged))), names.index(stages[-1])
        if first == names.index(stages[0]):
            return stages
        return self._fetch_stages(tuple(names[first : last + 1]), workspace)

    def _fetch_inputs(self) -> None:
        """Lay out the scene's folder anew: links to what is here already; what is not comes and is shared then."""
        shutil.rmtree(self.scene.parent, ignore_errors=True)
        self._inputs.mkdir(parents=True, exist_ok=True)
        missing: dict[SizeAndDigest, Path] = {}
        again: list[tuple[Path, Path]] = []  # one content under two names
        for name, entry in self._stored.files.items():
            place = self.scene.parent / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if not _linked(self._inputs / entry[1], place, entry):
                again += [(missing[entry], place)] if entry in missing else []
                missing.setdefault(entry, place)
        self._store.get_inputs(missing)
        for (_, digest), place in missing.items():
            with contextlib.suppress(FileExistsError):  # another scene brought it meanwhile
                os.link(place, self._inputs / digest)
        for first, place in again:
            os.link(first, place)


def scratch_dir(url: str) -> Path:
    """Where the scenes of a store lie on this machine while they are worked on."""
    name = f"devrf-{os.getuid()}-{hashlib.blake2b(url.encode(), digest_size=6).hexdigest()}"
    return Path(os.environ.get(SCRATCH) or tempfile.gettempdir()) / name


def _make_own(folder: Path) -> None:
    """Make a folder that only this user may enter; refuse one that is there and another's, or open to others."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=stat.S_IRWXU)
    there = folder.lstat()
    mode = stat.S_IMODE(there.st_mode)
    if not stat.S_ISDIR(there.st_mode):
        what = "is no folder"
    elif there.st_uid != os.getuid():
        what = f"belongs to user {there.st_uid}"
    elif mode & (stat.S_IRWXG | stat.S_IRWXO):
        what = f"is open to others (mode {mode:04o})"
    else:
        return
    raise InputError(
        "scratch-not-own",
        f"{folder}: {what}; expected a folder of user {os.getuid()} alone (mode 0700), or others could change what "
        f"runs; remove it, or set {SCRATCH} to a folder of your own",
    )


def _linked(shared: Path, place: Path, expected: SizeAndDigest) -> bool:
    """Link a raw file that is here already; not one that has become another, which is removed."""
    try:
        os.link(shared, place)
    except FileNotFoundError:
        return False
    if (place.stat().st_size, file_digest(place)) == expected:
        return True
    place.unlink()
    shared.unlink(missing_ok=True)
    return False
