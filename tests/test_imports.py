"""Imports point one way: lab -> pipelines -> reconstruct -> flow -> calibration -> capture; the API is above all."""

import ast
import functools
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

import devrf

REPOSITORY = Path(__file__).resolve().parent.parent
ORDER = (
    "capture",
    "calibration",
    "flow",
    "reconstruct",
    "pipelines",
    "lab",
)  # each may import those before it


@functools.cache
def parsed(source: str) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """The imports of a source, at any depth."""
    return tuple(n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Import | ast.ImportFrom))


def wrong_way(room: str, source: str) -> list[str]:
    """Imports in a file of a room that point the wrong way."""
    others = {*ORDER[ORDER.index(room) + 1 :], "api", *devrf.__all__}
    return [name for name in imported(source) if name.split(".")[1] in others]


def imported(source: str) -> list[str]:
    """Every devrf.* module that a source names in an import, at any depth."""
    names = []
    for node in parsed(source):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return [name for name in names if name.startswith("devrf.")]


@pytest.mark.parametrize("room", ORDER)
def test_imports_point_one_way(room: str) -> None:
    paths = sorted((REPOSITORY / room).rglob("*.py"))
    assert len(paths) > 5
    for path in paths:
        assert wrong_way(room, path.read_text()) == [], (
            f"{path.relative_to(REPOSITORY)} imports the wrong way"
        )


def test_the_rule_can_fail() -> None:
    assert wrong_way("capture", "import devrf.flow.store") == ["devrf.flow.store"]
    assert wrong_way("flow", "def f():\n    from devrf import pipelines") == ["devrf.pipelines"]
    assert wrong_way("calibration", "from devrf.reconstruct.rendering.rays import x") == [
        "devrf.reconstruct.rendering.rays.x"
    ]
    assert wrong_way("pipelines", "from devrf.lab import sources") == ["devrf.lab.sources"]
    assert wrong_way("pipelines", "from devrf.capture.camera import Camera") == []
    assert wrong_way("pipelines", "import devrf.api.steps") == ["devrf.api.steps"]
    assert wrong_way("lab", "from devrf import load") == ["devrf.load"]


MOST_MODULES = 15  # in a folder


def inside(room: str) -> dict[str, set[str]]:
    """What a room holds directly, files and folders, and which of these each imports."""
    out: dict[str, set[str]] = {}
    for path in (REPOSITORY / room).rglob("*.py"):
        mine, *_ = path.relative_to(REPOSITORY / room).with_suffix("").parts
        names = [name.split(".") for name in imported(path.read_text())]
        others = {parts[2] for parts in names if parts[1] == room and len(parts) > 2}
        out.setdefault(mine, set()).update(others - {mine})
    return out


def ordered(room: str, page: str) -> list[str]:
    """What a room holds directly, as docs/architecture.md lists it from the ground up."""
    row = re.search(rf"^\| `{room}/` \| ((?:\w+/?(?:, )?)+) \|$", page, re.MULTILINE)
    assert row, f"docs/architecture.md has no row of {room}/"
    return [name.removesuffix("/") for name in row[1].split(", ")]


def upwards(imports: dict[str, set[str]], order: list[str]) -> dict[str, set[str]]:
    """Imports of what comes later in the order."""
    wrong = {name: others - set(order[: order.index(name)]) for name, others in imports.items()}
    return {name: others for name, others in wrong.items() if others}


@pytest.mark.parametrize("room", ORDER)
def test_a_room_is_read_from_the_ground_up(room: str) -> None:
    imports = {name: others - {"__init__"} for name, others in inside(room).items() if name != "__init__"}
    order = ordered(room, (REPOSITORY / "docs" / "architecture.md").read_text())
    assert sorted(order) == sorted(imports)
    assert upwards(imports, order) == {}


def test_an_import_upwards_is_found() -> None:
    assert upwards({"a": set(), "b": {"a"}}, ["a", "b"]) == {}
    assert upwards({"a": {"b"}, "b": {"a"}}, ["a", "b"]) == {"a": {"b"}}


@pytest.mark.parametrize("room", ORDER)
def test_a_file_is_found_by_its_name(room: str) -> None:
    modules = [path for path in (REPOSITORY / room).rglob("*.py") if path.name != "__init__.py"]
    folders = Counter(path.parent for path in modules)
    assert {folder: n for folder, n in folders.items() if n > MOST_MODULES} == {}
    names = Counter(path.name for path in modules)
    assert {name for name, n in names.items() if n > 1} == set()


YAML_IS_THE_FORMAT = REPOSITORY / "calibration" / "formats" / "kalibr.py"


def test_domain_folders_know_nothing_of_yaml_or_the_command_line() -> None:
    for room in ORDER[: ORDER.index("pipelines")]:
        for path in (REPOSITORY / room).rglob("*.py"):
            if path == YAML_IS_THE_FORMAT:
                continue
            for node in parsed(path.read_text()):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                known = {name.split(".")[0] for name in names} & {"yaml", "typer", "rich"}
                assert not known, f"{path.relative_to(REPOSITORY)} imports {known}"


def test_pycolmap_is_imported_in_one_place_and_after_zlib() -> None:
    """Imported before zlib it corrupts the heap; imported beside torch it may end the process."""
    users = []
    for room in ORDER:
        for path in (REPOSITORY / room).rglob("*.py"):
            lines = path.read_text().splitlines()
            found = [
                n
                for n, line in enumerate(lines)
                if line.strip().startswith(("import pycolmap", "from pycolmap"))
            ]
            if found:
                users.append(path.name)
                zlib = [n for n, line in enumerate(lines) if line.strip().startswith("import zlib")]
                assert zlib and zlib[0] < found[0], f"{path} imports pycolmap before zlib"
    assert len(users) == 1, users


COMMAND = "from devrf.pipelines.cli.main import app\ntry: app({})\nexcept SystemExit: pass\n"
PLANNING = (
    "import devrf.pipelines.config.load, devrf.pipelines.cli.run_command, devrf.pipelines.stamps.stamp\n"
)


@pytest.mark.parametrize(
    ("program", "heavy"),
    [
        (COMMAND.format(["--version"]), "torch pycolmap cv2 warp scipy mitsuba av matplotlib"),
        (COMMAND.format(["run", "--help"]), "torch pycolmap cv2 warp scipy mitsuba av matplotlib"),
        pytest.param(PLANNING, "torch cv2 scipy numpy", id="what plans a run and finds nothing to do"),
        ("import devrf\n", "torch numpy cv2 scipy yaml pydantic jaxtyping"),
        ("from devrf import *\n", "torch warp pycolmap matplotlib"),
    ],
)
def test_what_starts_without_heavy_libraries(program: str, heavy: str) -> None:
    program += f"import sys\nsys.exit(' '.join({set(heavy.split())!r} & sys.modules.keys()) or 0)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("room", ORDER)
def test_a_room_is_not_imported_by_its_bare_name(room: str) -> None:
    """`import capture` from the repository root would make second copies of every class."""
    result = subprocess.run(
        [sys.executable, "-c", f"import {room}"], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert result.returncode and f"devrf.{room}" in result.stderr


MOST_PARAMETERS, MOST_METHODS = 6, 12
WIDE, LARGE = 3, 0  # functions and classes that have more: never more of these than there are


@functools.cache
def trees() -> dict[Path, ast.AST]:
    """Every file of the program, parsed."""
    paths = [path for room in (*ORDER, "src") for path in (REPOSITORY / room).rglob("*.py")]
    return {path.relative_to(REPOSITORY): ast.parse(path.read_text()) for path in paths}


def unlike_others(path: Path) -> bool:
    """Kernels, whose arguments are what a GPU takes, and functions of the command line, whose are its options."""
    return "kernels" in path.parts or path.parts[1] == "cli" or path.stem.endswith(("_command", "_commands"))


def definitions(node: ast.AST) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """All functions and classes in a tree, at any depth."""
    for child in getattr(node, "body", ()):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield child
        yield from definitions(child)


def wide_functions(tree: ast.AST) -> list[str]:
    """Functions with many parameters."""
    wide = []
    for node in definitions(tree):
        if isinstance(node, ast.FunctionDef) and "wp." not in "".join(map(ast.unparse, node.decorator_list)):
            given = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            if len(set(given) - {"self", "cls"}) > MOST_PARAMETERS:
                wide.append(node.name)
    return wide


def large_classes(tree: ast.AST) -> list[str]:
    """Classes with many methods, properties counted."""
    classes = [node for node in definitions(tree) if isinstance(node, ast.ClassDef)]
    return [c.name for c in classes if sum(isinstance(n, ast.FunctionDef) for n in c.body) > MOST_METHODS]


def test_functions_take_few_parameters_and_classes_have_few_methods() -> None:
    wide, large = [], []
    for name, tree in trees().items():
        wide += [] if unlike_others(name) else [f"{name}: {found}" for found in wide_functions(tree)]
        large += [f"{name}: {found}" for found in large_classes(tree)]
    assert len(wide) <= WIDE, sorted(wide)
    assert len(large) <= LARGE, sorted(large)


def test_a_wide_function_and_a_large_class_are_found() -> None:
    seven = ", ".join("abcdefg")
    methods = "".join(f"\n    def m{n}(self): ..." for n in range(MOST_METHODS + 1))
    tree = ast.parse(f"def f({seven}): ...\ndef g(self, a, *, b): ...\nclass C:{methods}")
    assert wide_functions(tree) == ["f"] and large_classes(tree) == ["C"]


def public_classes(trees: Mapping[Path, ast.AST]) -> dict[str, list[Path]]:
    """Names of classes without a leading underscore -> where they are defined."""
    found: dict[str, list[Path]] = {}
    for path, tree in trees.items():
        for node in definitions(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(path)
    return found


def test_the_name_of_a_class_has_one_meaning() -> None:
    assert {name: paths for name, paths in public_classes(trees()).items() if len(paths) > 1} == {}


def test_a_second_class_of_a_name_is_found() -> None:
    one, other = (
        ast.parse("class C: ...\nclass _D: ..."),
        ast.parse("def f():\n    class C: ...\nclass _D: ..."),
    )
    assert public_classes({Path("a.py"): one, Path("b.py"): other}) == {"C": [Path("a.py"), Path("b.py")]}
