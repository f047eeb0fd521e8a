"""The Dockerfile, as far as it can be checked where no image can be built: its names exist, its versions are ours."""

import re
import shlex
from fnmatch import fnmatch
from pathlib import Path

from tests.test_package import PYTHONS

REPOSITORY = Path(__file__).resolve().parent.parent
BUILT_OF = (
    "src",
    "examples/workshop",
    "capture",
    "calibration",
    "flow",
    "reconstruct",
    "pipelines",
    "lab",
)
BESIDE = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "NOTICE", "constraints.txt")
PREDEFINED = {"HOME", "PATH", "HOSTNAME"}


def instructions() -> list[tuple[str, str]]:
    """Each instruction's word and what follows it, continued lines as one."""
    text = re.sub(r"^\s*#.*\n", "", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", " ", text).splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in lines if line.strip())]


def of(word: str) -> list[str]:
    return [rest for found, rest in instructions() if found == word]


def test_every_variable_is_declared_where_it_is_used() -> None:
    anywhere: set[str] = set()  # before the first stage: for FROM alone
    here = anywhere
    for word, rest in instructions():
        known = anywhere if word == "FROM" else here | PREDEFINED
        assert set(re.findall(r"\$\{(\w+)", rest)) <= known, f"{word} {rest}"
        if word == "FROM":
            here = set()
        if word in ("ARG", "ENV"):
            here |= {pair.partition("=")[0] for pair in shlex.split(rest)}


def test_what_is_copied_is_there() -> None:
    stages = {rest.split(" AS ")[1] for rest in of("FROM") if " AS " in rest}
    for rest in of("COPY"):
        *sources, _ = rest.split()
        if sources[0].startswith("--from="):
            assert sources[0].removeprefix("--from=") in stages
        else:
            assert all((REPOSITORY / source).exists() for source in sources)


def test_nothing_that_an_image_needs_is_ignored() -> None:
    lines = (REPOSITORY / ".dockerignore").read_text().splitlines()
    patterns = [line for line in lines if line and not line.startswith("#")]
    files = [f.relative_to(REPOSITORY) for room in BUILT_OF for f in (REPOSITORY / room).rglob("*")]
    made = ("__pycache__", "runs")
    needed = [*map(Path, BESIDE), *(f for f in files if not set(made) & set(f.parts))]
    for file in needed:
        for pattern in patterns:
            parts = file.parts if pattern.startswith("**/") else file.parts[:1]
            assert not any(fnmatch(part, pattern.removeprefix("**/")) for part in parts), (file, pattern)


def test_versions_extras_and_the_way_in_are_those_of_the_package() -> None:
    project = (REPOSITORY / "pyproject.toml").read_text()
    (python,) = (rest.partition("=")[2] for rest in of("ARG") if rest.startswith("PYTHON="))
    assert python in PYTHONS
    extras = re.search(r"\.whl\)\[([\w,]+)\]", " ".join(of("RUN")))
    assert extras is not None and all(f"\n{name} = [" in project for name in extras[1].split(","))
    (entry,) = of("ENTRYPOINT")
    assert f"\n{entry.strip('[]').strip(chr(34))} = " in project.split("[project.scripts]")[1]
    installs = [part for part in re.split(r"&&", " ".join(of("RUN"))) if "pip install" in part]
    assert installs and all("--constraint" in part and "--no-cache-dir" in part for part in installs)
