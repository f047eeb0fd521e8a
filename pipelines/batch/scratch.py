"""A scene of a store on the machine that works on it: raw files and finished stages come, new ones go.

<scratch>/inputs/<digest>            raw files, once per machine
<scratch>/scenes/<scene>/scene/...   the scene's folder, hard links to those
<scratch>/scenes/<scene>/run/...     its run folder
"""

import contextlib
import hashlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from devrf.pipelines.batch.store import SizeAndDigest, Store
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.stamp import read_stamp

SCRATCH = "DEVRF_SCRATCH"  # environment variable: folder on a fast disk of this machine


@dataclass(frozen=True)
class Stored:
    """A scene that lies in a store.

    Attributes:
        url: The store.
        name: What the scene is called there.
        scene: File name of its scene.yaml.
        files: Path in the scene's folder -> size and digest.
        last: Whether nothing is to be done for it after this task.
    """

    url: str
    name: str
    scene: str
    files: dict[str, SizeAndDigest]
    last: bool


class Scratch:
    """The copy of a scene on this machine.

    Args:
        stored: The scene.
    """

    def __init__(self, stored: Stored) -> None:
        self._stored, self._store = stored, Store(stored.url)
        self._inputs = scratch_dir(stored.url) / "inputs"
        self._base = scratch_dir(stored.url) / "scenes" / stored.name
        self.scene = self._base / "scene" / stored.scene
        self.run_dir = self._base / "run"
        self._pushed: set[str] = set()

    def fetch(self, stages: tuple[str, ...]) -> None:
        """Get the raw files, and the stages that these stages are or read, as far as they are stored.

        Raises:
            StoreError: The store does not give what was put into it.
        """
        self._fetch_inputs()
        read = {name for stage in STAGES if stage.name in stages for name in stage.reads}
        for stage in (stage.name for stage in STAGES if stage.name in read.union(stages)):
            stamp = self._store.stamp(self._stored.name, stage)
            if stamp is None:
                continue
            self._pushed.add(stamp["id"])
            if (read_stamp(self.run_dir / stage) or {}).get("id") != stamp["id"]:
                self._store.pull(self._stored.name, stage, self.run_dir)

    def push(self, stages: tuple[str, ...]) -> None:
        """Store what has been finished since."""
        for stage in stages:
            stamp = read_stamp(self.run_dir / stage)
            if stamp is not None and stamp["id"] not in self._pushed:
                self._store.push(self._stored.name, self.run_dir / stage, stamp)
                self._pushed.add(stamp["id"])

    def remove(self) -> None:
        """Make room: the scene is finished, and raw files that no other scene here uses."""
        shutil.rmtree(self._base, ignore_errors=True)
        for file in self._inputs.glob("*"):
            with contextlib.suppress(FileNotFoundError):
                if file.stat().st_nlink == 1:
                    file.unlink()

    def _fetch_inputs(self) -> None:
        """Link the scene's folder anew, from files that are here already or come now."""
        folder = self.scene.parent
        shutil.rmtree(folder, ignore_errors=True)
        self._inputs.mkdir(parents=True, exist_ok=True)
        wanted = {entry: self._inputs / entry[1] for entry in self._stored.files.values()}
        missing = {entry: place for entry, place in wanted.items() if not place.is_file()}
        half = {entry: place.with_name(f"{place.name}.{os.getpid()}.tmp") for entry, place in missing.items()}
        self._store.get_inputs(half)
        for entry, place in missing.items():
            half[entry].replace(place)
        for name, entry in self._stored.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.link(wanted[entry], folder / name)


def scratch_dir(url: str) -> Path:
    """Where the scenes of a store lie on this machine while they are worked on."""
    base = os.environ.get(SCRATCH) or os.path.join(tempfile.gettempdir(), f"devrf-{os.getuid()}")
    return Path(base) / hashlib.blake2b(url.encode(), digest_size=6).hexdigest()
