"""How many seeded faults the tests find: one small fault in a file at a time, as a slip of the hand would make it.

For each fault the tests run until one fails that passes without it: those first that import the file, the narrowest
first, then all others; of `make test`, and where these find nothing, of `make test-full`. In a work tree that has an
environment in `.venv` and nothing to lose:

    python benchmarks/seeded_faults.py TREE --json FILE [--only N ..]
"""

import argparse
import json
import re
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

LIMIT_S = 1800.0  # of one fault in one tier
TIERS = {"test": "not full", "full": "full"}  # the second is asked where the first finds nothing


@dataclass(frozen=True)
class Fault:
    """A slip: `right`, which stands once in the file, becomes `wrong`."""

    kind: str
    path: str
    right: str
    wrong: str


FAULTS = tuple(Fault(**fault) for fault in json.loads(Path(__file__).with_suffix(".json").read_text()))


def near_and_far(tree: Path, fault: Fault) -> tuple[list[str], list[str]]:
    """Files of tests that import a fault's file, those first that import the fewest others; and all the others."""
    module = "devrf." + fault.path.removesuffix(".py").replace("/", ".")
    imports = {
        file.relative_to(tree).as_posix(): re.findall(
            r"^\s*from (devrf[\w.]*) import", file.read_text(), re.MULTILINE
        )
        for file in sorted((tree / "tests").rglob("test_*.py"))
    }
    near = sorted((file for file in imports if module in imports[file]), key=lambda file: len(imports[file]))
    return near, [file for file in imports if file not in near]


def find(tree: Path, fault: Fault) -> dict:
    """Seed a fault and run the tests, those of the default tier first.

    Returns:
        The fault's path and kind, and the test that found it: `test`, in `make test`; `full`, in `make test-full`; null
        where none did, or where tests did not end in time.
    """
    file = tree / fault.path
    whole = file.read_text()
    if (count := whole.count(fault.right)) != 1:
        raise SystemExit(f"{fault.path}: {fault.right!r} stands {count} times; expected once")
    result: dict = {"path": fault.path, "kind": fault.kind}
    for tier in TIERS:
        result[tier] = result.get("test") or _first_that_fails(tree, fault, whole, tier)
    return result


def _first_that_fails(tree: Path, fault: Fault, whole: str, tier: str) -> str | None:
    """The first test of a tier that fails with a fault and passes without it."""
    file, until = tree / fault.path, time.monotonic() + LIMIT_S
    near, far = near_and_far(tree, fault)
    flaky: list[str] = []
    for files, workers in ((near, 0), (far, 2)):
        while files:
            file.write_text(whole.replace(fault.right, fault.wrong))
            left_out = [f"--deselect={test}" for test in flaky]
            try:
                failed = _pytest(
                    tree, ["-x", "-m", TIERS[tier], *left_out, *files], workers, until - time.monotonic()
                )
            finally:
                file.write_text(whole)
            if failed is None:
                break
            if _pytest(tree, [failed], 0, LIMIT_S) is None:
                return failed
            flaky.append(failed)
    return None


def _pytest(tree: Path, arguments: list[str], workers: int, limit_s: float) -> str | None:
    """Run tests; the first that failed, None where all passed or the time is over."""
    options = f"-p no:cacheprovider -q -rfE -n {workers} --dist loadfile --no-loadscope-reorder"
    command = [str(tree / ".venv/bin/python"), "-m", "pytest", *options.split(), *arguments]
    try:
        output = subprocess.run(
            command, cwd=tree, text=True, timeout=max(1.0, limit_s), stdout=subprocess.PIPE
        ).stdout
    except subprocess.TimeoutExpired:
        return None
    lines = [line for line in output.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return lines[0].split(" ", 1)[1].split(" - ")[0] if lines else None


def main() -> None:
    """Seed the faults in a tree."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tree", type=Path)
    parser.add_argument("--json", type=Path, help="where results are written, after every fault")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of faults, from 0; default: all")
    asked = parser.parse_args()
    tree = asked.tree.resolve()
    results = json.loads(asked.json.read_text()) if asked.json and asked.json.is_file() else {}
    for number in asked.only if asked.only is not None else range(len(FAULTS)):
        if str(number) not in results:
            results[str(number)] = found = find(tree, FAULTS[number])
            print(number, json.dumps(found), flush=True)
            if asked.json:
                asked.json.write_text(json.dumps(results, indent=1) + "\n")
    for tier in TIERS:
        print(f"{tier}: {sum(r[tier] is not None for r in results.values())} of {len(results)} found")


if __name__ == "__main__":
    main()
