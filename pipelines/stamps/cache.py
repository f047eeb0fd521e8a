"""The cache: finished stages of earlier configurations, and of other scenes with the same inputs.

Every stage that is finished, or about to be replaced, is kept as `<cache>/<stage>/<key>`, the key a digest of what made
it. A stage whose key is there is taken from the cache instead of run. Files are hard links where the cache lies on the
run folder's disk, else copies. As in the run folder, an entry appears and vanishes by one renaming; whatever is taken
is compared with the digests in its stamp first, so that no torn, damaged or half removed entry is ever used. Runs may
share a cache at the same time without locks. A cache carries the tag by which backups know one; a folder that holds
something else is refused, because what is old is removed from a cache.
"""

import os
import secrets
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.amounts import GB
from devrf.capture.errors import InputError
from devrf.pipelines.stage import Stage
from devrf.pipelines.stamps.digests import CACHE_TAG, file_digest
from devrf.pipelines.stamps.stamp import STAMP, identity_key, is_whole, read_stamp, size_in

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

TAG_TEXT = (
    "Signature: 8a477f597d28d172789f06886806bc55\n"  # Cache Directory Tagging Specification, bford.info/cachedir
    "# Finished stages, kept by devrf-pipeline; may be deleted at any time.\n"
)
USERS = "DEVRF_CACHE"  # environment variable: folder of scenes that name none
NEW, OLD = ".new-", ".old-"
ABANDONED_S = 24 * 3600.0  # folders of that age that nobody finished were left by a killed run


@dataclass(frozen=True)
class Cache:
    """A folder of finished stages.

    Attributes:
        folder: Where; made when something is kept.
        max_gb: Most it may hold; what was used longest ago goes first. Links count as much as copies.
    """

    folder: Path
    max_gb: float

    def has(self, stage: Stage, made_from: dict) -> str | None:
        """Content of the entry made from this; None where there is none."""
        stamp = None if stage.quotes_stamps else read_stamp(self._entry(stage.name, made_from))
        whole = stamp is not None and stamp["identity"] == made_from and is_whole(stamp)
        return stamp.get("content") if stamp is not None and whole else None

    def take(self, stage: Stage, made_from: dict, out: Path) -> bool:
        """Put the stage made from this into the empty folder `out`, if it is here and whole.

        Raises:
            OSError: It cannot be read, or `out` not be written: a full disk, say.
        """
        entry = self._entry(stage.name, made_from)
        if self.has(stage, made_from) is None:
            return False
        try:
            _link(entry, out)
            whole = _is_whole(out)
        except FileNotFoundError:  # another run removed it
            whole = False
        if whole:
            _used(entry)
        else:
            self._remove(entry)
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir(exist_ok=True)
        return whole

    def keep(self, stage: Stage, folder: Path) -> None:
        """Keep a finished stage's folder.

        Raises:
            OSError: The cache cannot be written.
        """
        stamp = read_stamp(folder)
        size = None if stamp is None or stage.quotes_stamps else size_in(stamp)
        if stamp is None or size is None or "content" not in stamp:
            return
        entry = self._entry(stage.name, stamp["identity"])
        if self.has(stage, stamp["identity"]) is not None:
            _used(entry)
            return
        self._remove(entry)  # a damaged one, if there is one
        if size > self.max_gb * GB:
            self._trim()
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self.folder / CACHE_TAG).exists():
            (self.folder / CACHE_TAG).write_text(TAG_TEXT)
        new = entry.with_name(f"{NEW}{secrets.token_hex(6)}")
        new.mkdir(parents=True)
        try:
            _link(folder, new)
            new.rename(entry)
        except BaseException as error:
            shutil.rmtree(new, ignore_errors=True)
            if not (isinstance(error, OSError) and entry.exists()):  # another run kept the same first
                raise
        self._trim()

    def _entry(self, stage: str, made_from: dict) -> Path:
        return self.folder / stage / identity_key(stage, made_from)

    def _trim(self) -> None:
        """Remove what was used longest ago until the rest fits, and what killed runs left."""
        entries: list[tuple[float, int, Path]] = []
        for path in self.folder.glob("*/*"):
            try:
                used = path.stat().st_mtime
            except OSError:
                continue  # another run removed it
            half_made = path.name.startswith((NEW, OLD))
            stamp = None if half_made else read_stamp(path)
            size = None if stamp is None else size_in(stamp)
            if size is not None:
                entries.append((used, size, path))
            elif half_made and used < time.time() - ABANDONED_S:
                shutil.rmtree(path, ignore_errors=True)
        too_much = sum(size for _, size, _ in entries) - self.max_gb * GB
        for _, size, path in sorted(entries):
            if too_much <= 0:
                break
            self._remove(path)
            too_much -= size

    def _remove(self, entry: Path) -> None:
        old = entry.with_name(f"{OLD}{secrets.token_hex(6)}")
        try:
            entry.rename(old)
        except OSError:
            return  # another run removed it
        shutil.rmtree(old, ignore_errors=True)


def cache_of(config: "SceneConfig", scene_dir: Path) -> Cache | None:
    """The cache that scene.yaml names, else the user's own, else none."""
    wish = config.cache
    folder = wish.folder or os.environ.get(USERS)
    return Cache(config.path(scene_dir, folder), wish.max_gb) if folder and wish.max_gb > 0 else None


def check_cache(cache: Cache, run_dir: Path) -> None:
    """Refuse a folder that is no cache, or that is mixed up with the run folder.

    Raises:
        InputError: Says what is in the way.
    """
    folder, where = cache.folder, f"cache.folder (or {USERS}): {cache.folder}"
    if folder.is_dir():
        foreign = not (folder / CACHE_TAG).exists() and next(folder.iterdir(), None)
        if foreign:
            raise InputError(
                "folder-exists",
                f"{where}: holds something else ({foreign.name}), and old things are removed from a cache; name a new "
                "or an empty folder",
            )
    elif folder.exists():
        raise InputError("folder-is-file", f"{where}: is a file; name a folder")
    if run_dir == folder or run_dir in folder.parents or folder in run_dir.parents:
        text = f"{where}: lies in the run folder {run_dir}, or holds it; name a folder beside it"
        raise InputError("cache-inside-run", text)


def _used(entry: Path) -> None:
    """Note that an entry was used now, where the cache can be written."""
    with suppress(OSError):
        os.utime(entry)


def _link(source: Path, target: Path) -> None:
    """Hard links of all files of a folder in another, which is there; copies where there can be none."""
    for path in sorted(source.rglob("*")):
        new = target / path.relative_to(source)
        if path.is_dir():
            new.mkdir(exist_ok=True)
            continue
        try:
            os.link(path, new)
        except FileNotFoundError:
            raise
        except OSError:  # another disk, or a file system without links
            shutil.copy2(path, new)


def _is_whole(folder: Path) -> bool:
    """Whether a folder holds what its stamp says, byte for byte."""
    stamp = read_stamp(folder)
    if stamp is None:
        return False
    return (
        is_whole(stamp)
        and {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        == {*stamp["files"], STAMP}
        and all(file_digest(folder / name) == digest for name, (_, digest) in stamp["files"].items())
    )
