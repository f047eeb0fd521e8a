"""Fixtures of the fault suite."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.faults.fuzzing import Fuzzer, fuzzer
from tests.faults.harness import Tiny
from tests.faults.tiny_stages import prepare

TinyMaker = Callable[[], Tiny]


@pytest.fixture
def new_tiny(tmp_path: Path) -> TinyMaker:
    """Makes folders for the tiny pipeline."""
    made: list[Tiny] = []

    def make() -> Tiny:
        made.append(Tiny(tmp_path / f"tiny{len(made)}"))
        prepare(made[-1].folder)
        return made[-1]

    return make


@pytest.fixture
def tiny(new_tiny: TinyMaker) -> Tiny:
    """A folder of its own for the tiny pipeline."""
    return new_tiny()


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder of a run that nothing disturbed."""
    folder = Tiny(tmp_path_factory.mktemp("reference"))
    prepare(folder.folder)
    assert folder.run().returncode == 0
    return folder.run_dir


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzer]:
    """What takes hostile input; a generated `~` is an empty folder for it and for all processes beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        with fuzzer() as one:
            yield one
