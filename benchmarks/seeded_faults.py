"""How many seeded faults the tests find: one small fault in a file at a time, as a slip of the hand would make it.

Coverage is recorded first, a context a test, in the processes that tests start too; then, for each fault, only tests
that touched the line run, those that touch the fewest files first, until one fails that passes without the fault. Both
steps run in a work tree that has an environment in `.venv` (with pytest-cov) and nothing to lose:

    python benchmarks/seeded_faults.py record TREE                       # into TREE/.coverage-of-tests, about an hour
    python benchmarks/seeded_faults.py find TREE --json FILE [--only N ..]
"""

import argparse
import json
import os
import re
import sqlite3
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

DATA = ".coverage-of-tests"
SETTINGS = """[run]
parallel = true
patch = subprocess
context = ${DEVRF_TEST-}
"""  # a process that a test starts says which test it belongs to
PLUGIN = """import os
def pytest_runtest_logstart(nodeid, location):
    os.environ["DEVRF_TEST"] = nodeid
"""
LIMIT_S = 900.0  # of one fault in one tier
ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines")


@dataclass(frozen=True)
class Fault:
    """A slip: `right`, which stands once in the file, becomes `wrong`.

    `touched` stands in a line of the same file that runs whenever the fault does; of code that Warp compiles no
    line is recorded. Default: `right` itself.
    """

    kind: str
    path: str
    right: str
    wrong: str
    touched: str = ""


FAULTS = tuple(Fault(**fault) for fault in json.loads(Path(__file__).with_suffix(".json").read_text()))


def record(tree: Path) -> None:
    """Run all tests of a tree with coverage; tests that fail are told by `find` later."""
    data = tree / DATA
    data.mkdir(exist_ok=True)
    (data / "settings").write_text(
        SETTINGS + f"data_file = {data / 'data'}\nsource =\n" + "".join(f"    {tree / r}\n" for r in ROOMS)
    )
    (data / "devrf_named.py").write_text(PLUGIN)
    environment = {"PYTHONPATH": str(data), "COVERAGE_RCFILE": str(data / "settings")}
    options = ["-p", "devrf_named", "--cov", f"--cov-config={data / 'settings'}", "--cov-context=test"]
    options += ["--cov-report=term", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    subprocess.run([*_command(tree), *options], cwd=tree, env={**os.environ, **environment})


def touching(tree: Path, fault: Fault) -> list[str]:
    """Tests that ran the line of a fault, those first that run the fewest files of the program."""
    from coverage import CoverageData

    if not (tree / DATA / "data").is_file():
        raise SystemExit(f"no coverage of tests in {tree}: `record` it first")
    data = CoverageData(str(tree / DATA / "data"))
    data.read()
    file = tree / fault.path
    wanted = fault.touched or fault.right
    line = file.read_text().split(wanted)[0].count("\n") + 1
    contexts = (data.contexts_by_lineno(str(file)) or {}).get(line, [])
    files = dict(
        sqlite3.connect(tree / DATA / "data").execute(
            "select context, count(*) from line_bits join context on context.id = context_id group by context"
        )
    )
    cost = {_test(context): files[context] for context in sorted(contexts, key=files.__getitem__) if context}
    return sorted(cost, key=lambda test: (cost[test], test))


def _test(context: str) -> str:
    """The test of a context, which says whether its body ran or its fixtures, too."""
    return re.sub(r"\|(run|setup|teardown)$", "", context)


def find(tree: Path, fault: Fault) -> dict:
    """Seed a fault and run the tests that touch it, of the default tier first.

    Returns:
        The fault's path and kind, `touched_by` (tests), and the test that found it: `test`, in `make test`; `full`, in
        `make test-full`; null where none did.
    """
    file = tree / fault.path
    whole = file.read_text()
    if (count := whole.count(fault.right)) != 1:
        raise SystemExit(f"{fault.path}: {fault.right!r} stands {count} times; expected once")
    tests = touching(tree, fault)
    result: dict = {"path": fault.path, "kind": fault.kind, "touched_by": len(tests), "test": None}
    for tier in ("test", "full"):
        result[tier] = result["test"] or _first_that_fails(tree, fault, whole, tests, tier)
    return result


def _first_that_fails(tree: Path, fault: Fault, whole: str, tests: list[str], tier: str) -> str | None:
    """The first test of a tier that fails with a fault and passes without it."""
    file, marked = tree / fault.path, ["-m", "not full" if tier == "test" else "full or not full"]
    left, until = list(tests), time.monotonic() + LIMIT_S
    while left and time.monotonic() < until:
        file.write_text(whole.replace(fault.right, fault.wrong))
        try:
            failed = _pytest(tree, ["-n", "0", "-x", *marked, *left], until - time.monotonic())
        finally:
            file.write_text(whole)
        if failed is None:
            return None
        if _pytest(tree, ["-n", "0", failed], LIMIT_S) is None:
            return failed
        left = left[left.index(failed) + 1 :] if failed in left else []
    return None


def _command(tree: Path) -> list[str]:
    return [str(tree / ".venv/bin/python"), "-m", "pytest", "-p", "no:cacheprovider", "-q", "-rfE"]


def _pytest(tree: Path, arguments: list[str], limit_s: float) -> str | None:
    """Run tests; the first that failed, None where all passed or the time is over."""
    command = [*_command(tree), *arguments]
    try:
        output = subprocess.run(command, cwd=tree, text=True, timeout=limit_s, stdout=subprocess.PIPE).stdout
    except subprocess.TimeoutExpired:
        return None
    lines = [line for line in output.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return lines[0].split(" ", 1)[1].split(" - ")[0] if lines else None


def main() -> None:
    """Record coverage of a tree's tests, or seed the faults there."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=("record", "find"))
    parser.add_argument("tree", type=Path)
    parser.add_argument("--json", type=Path, help="where results are written, after every fault")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of faults, from 0; default: all")
    asked = parser.parse_args()
    tree = asked.tree.resolve()
    if asked.step == "record":
        return record(tree)
    results = json.loads(asked.json.read_text()) if asked.json and asked.json.is_file() else {}
    for number in asked.only if asked.only is not None else range(len(FAULTS)):
        if str(number) not in results:
            results[str(number)] = found = find(tree, FAULTS[number])
            print(number, json.dumps(found), flush=True)
            if asked.json:
                asked.json.write_text(json.dumps(results, indent=1) + "\n")
    for tier in ("test", "full"):
        print(f"{tier}: {sum(r[tier] is not None for r in results.values())} of {len(results)} found")


if __name__ == "__main__":
    main()
