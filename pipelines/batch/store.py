"""A store that all machines of a batch reach, through fsspec: a shared folder, S3, Google Cloud Storage, …

    inputs/<digest>                  a raw file, by its content
    runs/<scene>/<stage>.json        the stamp of a finished stage: the last thing that is written of it
    runs/<scene>/<stage>/<id>/...    its files; `id` names one making of it

So a stage that was pushed by half is none, and one that replaces another does so at once. What is fetched is compared
with sizes and digests: of the stamp, or of the batch that named the input.
"""

import json
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from devrf.capture.durable import write_json
from devrf.capture.errors import DevrfError, InputError
from devrf.pipelines.runner.workspace import Workspace
from devrf.pipelines.stamps.digests import file_digest
from devrf.pipelines.stamps.stamp import STAMP, is_whole, parse_stamp

SizeAndDigest = tuple[int, str]


class StoreError(DevrfError):
    """The store cannot be used, or gave back something else than was put into it."""


class DamagedError(StoreError):
    """A file in the store is missing, or is not what was put there."""


class Store:
    """A store at a URL.

    Args:
        url: `s3://bucket/path`, `file:///path`, …; credentials are found as each protocol's library does.
    Raises:
        InputError: No such protocol, its library is not installed, or no place is named.
    """

    def __init__(self, url: str) -> None:
        try:
            import fsspec.core
        except ImportError:
            text = "--store: fsspec is not installed; pip install 'devrf[store]'"
            raise InputError("package-missing", text) from None
        try:
            self._fs, self._root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise InputError("store-protocol-unknown", f"--store {url}: {error}") from None
        if not self._root.strip("/"):
            text = f"--store {url}: names no bucket or folder; expected one, such as {url}NAME"
            raise InputError("store-without-folder", text)
        self.url = url

    def check(self) -> None:
        """Write a file and remove it again: where that does not succeed, no scene could be stored.

        Raises:
            InputError: Says why.
        """
        trial = self._path(f"trial-{secrets.token_hex(4)}")
        try:
            self._make_folders([trial])
            self._fs.pipe_file(trial, b"trial")
            self._fs.rm(trial)
        except Exception as error:  # each protocol's library has errors of its own
            raise InputError(
                "store-unwritable",
                f"--store {self.url}: cannot be written ({type(error).__name__}: {error}); check address, credentials "
                "and network",
            ) from error

    def put_inputs(self, files: Mapping[str, Path]) -> None:
        """Store raw files that are not there yet.

        Args:
            files: Digest -> where the file lies.
        """
        sizes = {digest: path.stat().st_size for digest, path in files.items()}
        new = [digest for digest, size in sizes.items() if self._inputs.get(digest) != size]
        self._put([files[digest] for digest in new], [f"inputs/{digest}" for digest in new])
        self._inputs.update(sizes)

    def get_inputs(self, files: Mapping[SizeAndDigest, Path]) -> None:
        """Fetch raw files.

        Raises:
            DamagedError: One is not there, or is not what it was.
        """
        try:
            self._get([(f"inputs/{digest}", path, (size, digest)) for (size, digest), path in files.items()])
        except DamagedError as error:  # the batch stores what is missing
            text = f"{error}; remove it there, if it is there, and run the batch again"
            raise DamagedError(error.code, text) from error

    def stamps(self, scene: str, stages: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Stamps of those of a scene's stages that are finished, asked for side by side."""
        there = {entry["name"].rsplit("/", 1)[-1] for entry in self._list(f"runs/{scene}")}
        # What is missing costs more to ask for; of what is listed the size is known, which s3fs would ask for first.
        stages = [stage for stage in stages if f"{stage}.json" in there]
        places = [self._path(f"runs/{scene}/{stage}.json") for stage in stages]
        found = {}
        with self._errors():
            for stage, text in zip(stages, self._fs.cat_ranges(places, None, None), strict=True):
                if isinstance(text, FileNotFoundError):
                    continue
                if isinstance(text, Exception):
                    raise text
                stamp = parse_stamp(text)
                if stamp is not None and is_whole(stamp):
                    found[stage] = stamp
        return found

    def push(self, scene: str, folder: Path, stamp: Mapping[str, Any]) -> None:
        """Store a finished stage.

        Args:
            scene: Name of the scene.
            folder: The stage's folder.
            stamp: What stands in its stamp.
        """
        where = f"runs/{scene}/{folder.name}"
        names = list(stamp["files"])
        self._put([folder / name for name in names], [f"{where}/{stamp['id']}/{name}" for name in names])
        old = [e["name"] for e in self._list(where) if not e["name"].rstrip("/").endswith(f"/{stamp['id']}")]
        with self._errors():
            self._make_folders([self._path(f"{where}.json")])
            self._fs.pipe_file(self._path(f"{where}.json"), json.dumps(stamp).encode())
            for place in old:  # what it replaces
                self._fs.rm(place, recursive=True)

    def pull(self, scene: str, stage: str, stamp: Mapping[str, Any], workspace: Workspace) -> None:
        """Put a finished stage into a run folder, whole or not at all.

        Raises:
            DamagedError: It is not what was stored.
        """
        folder = workspace.new_folder(stage)
        try:
            folder.mkdir()
            self.get(scene, stage, stamp, folder)
            write_json(folder / STAMP, stamp)
            workspace.commit(stage, folder)
        except BaseException:
            workspace.discard(folder)
            raise

    def get(
        self,
        scene: str,
        stage: str,
        stamp: Mapping[str, Any],
        folder: Path,
        names: Sequence[str] | None = None,
    ) -> None:
        """Fetch files of a stage (None: all) into a folder.

        Raises:
            DamagedError: One is not there, or is not what was stored.
        """
        wanted = [name for name in stamp["files"] if names is None or name in names]
        where = f"runs/{scene}/{stage}/{stamp['id']}"
        files = [(f"{where}/{name}", folder / name, tuple(stamp["files"][name])) for name in wanted]
        for _, path, _ in files:
            if not path.resolve().is_relative_to(folder.resolve()):
                text = f"{self.url}/runs/{scene}/{stage}.json: names a file outside of the stage ({path})"
                raise StoreError("store-path-outside", f"{text}; remove it there")
        self._get(files)

    @cached_property
    def _inputs(self) -> dict[str, int]:
        """Digest -> size of the raw files that are there, listed once."""
        return {entry["name"].rsplit("/", 1)[-1]: entry["size"] for entry in self._list("inputs")}

    def _put(self, files: Sequence[Path], names: Sequence[str]) -> None:
        """All at once: a store far away takes many files side by side."""
        if not files:
            return
        places = [self._path(name) for name in names]
        with self._errors():
            self._make_folders(places)
            self._fs.put([str(path) for path in files], places)

    def _get(self, files: Sequence[tuple[str, Path, SizeAndDigest]]) -> None:
        for _, path, _ in files:
            path.parent.mkdir(parents=True, exist_ok=True)
        if not files:
            return
        with self._errors():
            try:
                self._fs.get([self._path(name) for name, _, _ in files], [str(path) for _, path, _ in files])
            except FileNotFoundError as error:
                text = f"{self.url}: a file is missing ({error})"
                raise DamagedError("store-file-missing", text) from error
        for name, path, (size, digest) in files:
            there = path.stat().st_size
            if there != size or file_digest(path) != digest:
                path.unlink()
                raise DamagedError(
                    "store-file-damaged",
                    f"{self.url}/{name}: is not what was stored ({there} bytes, expected {size} and digest {digest})",
                )

    def _list(self, folder: str) -> list[dict[str, Any]]:
        with self._errors():
            self._fs.invalidate_cache()
            try:
                return self._fs.ls(self._path(folder), detail=True)
            except FileNotFoundError:
                return []

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Each protocol's library has errors of its own; all of them mean that the store cannot be used."""
        try:
            yield
        except DevrfError:
            raise
        except Exception as error:
            text = (
                f"--store {self.url}: {type(error).__name__}: {error}; check address, credentials and network"
            )
            raise StoreError("store-unreachable", text) from error

    def _make_folders(self, places: Sequence[str]) -> None:
        if "file" in self._fs.protocol:  # others have no folders
            for parent in {os.path.dirname(place) for place in places}:
                self._fs.makedirs(parent, exist_ok=True)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"
