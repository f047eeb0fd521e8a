"""What cannot be written is refused before the work, whatever the rights say."""

from pathlib import Path

import pytest
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_file, check_folder


def test_a_folder_that_is_missing_with_those_above_it(tmp_path: Path) -> None:
    check_folder(tmp_path / "a" / "b", "--out")
    check_file(tmp_path / "a" / "b.json", "--json", ())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", ["/proc/x", "/sys/x"])
def test_folders_that_take_no_files_even_of_root(place: str) -> None:
    with refused("folder-unwritable", f"--out {place}", kind=InputError):
        check_folder(Path(place), "--out")


def test_a_file_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with refused("folder-unwritable", tmp_path / "file", kind=InputError):
        check_folder(tmp_path / "file" / "x", "--out")
    with refused("file-is-folder", tmp_path, kind=InputError):
        check_file(tmp_path, "--json", ())


def test_only_a_file_of_ours_is_written_over(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    for content in ("", '{"go": true, "rows": []}'):
        file.write_text(content)
        check_file(file, "--json", ('"go": ', '"rows": '))
    for other in (b"name: mine\n", b'{"rows": []}', b"\x89PNG\xff"):
        file.write_bytes(other)
        with refused("file-exists", f"--json {file}", kind=InputError):
            check_file(file, "--json", ('"go": ', '"rows": '))
    check_file(Path("/dev/null"), "--json", ("x",))  # holds nothing to be lost


@pytest.mark.parametrize("name", ["a" * 300, "zero\0byte"])
def test_names_that_no_system_takes(tmp_path: Path, name: str) -> None:
    with refused("folder-unwritable", name, kind=InputError):
        check_folder(tmp_path / name / "x", "--out")
    with refused("file-unwritable", name, kind=InputError):
        check_file(tmp_path / name, "--json", ())
