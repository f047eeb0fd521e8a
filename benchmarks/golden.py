"""Values that must not change: the program is run on eleven cases and compared with what was recorded.

    python benchmarks/golden.py check                # everything; an hour on two cores
    python benchmarks/golden.py check --subset       # broken scene.yaml, a small session, its exports; three minutes
    python benchmarks/golden.py record --seeds       # anew, with the spread over three seeds; prints what is other now

What is run stands in golden.yaml, what is compared in golden_facts.py, what was recorded in results/golden.json, and
what went on purpose, with its reason, in results/golden-gone.json. `--program` names another version's Python. Cases
are kept in `--work` and only run again when the code has changed; one that was interrupted goes on. All run on the CPU
with two threads: on one machine a training is then the same bit for bit, also one that was killed and went on.
"""

import argparse
import fnmatch
import json
import os
import platform
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent))  # also where a test loads this file

from golden_cases import REPOSITORY, Case, cases
from golden_facts import Values, export_values, run_values, said_values, turned_deg

RECORDED = REPOSITORY / "benchmarks" / "results" / "golden.json"
GONE = RECORDED.with_name("golden-gone.json")
SEEDS = (1, 2)  # beside 0, which is recorded
# The first pattern that fits a name's end decides; what fits none must be equal.
BOUNDS = (
    (r"\.psnr", 0.1),  # dB
    (r"\.(ssim|lpips_\w+)", 0.005),
    (r"clock\..*\.offset_s", 0.001),
    (r"truth\.\w+_deg(_median)?", 0.02),
    (r"truth\.\w+_m(_median)?", 0.001),
    (r"truth\.\w+_percent(_median)?", 0.05),
    (r"truth\.sync_ms(_median)?", 1.0),
    (r"truth\.scale", 0.001),
    (r"poses\.\w+", 0.02),  # degrees
)
COUNTED = r"(ply|obj|glb)_(vertex|face)|colmap_points3D"  # what training or matching decides
COUNT_SHARE = 0.02
TRAINING_TIMES = 1.2  # the example's trainings, beside those of the version they are compared with
CASES = cases()
DIGEST = """
import hashlib, importlib, importlib.util, pathlib
digest = hashlib.sha256()
for room in ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab"):
    if importlib.util.find_spec("devrf." + room) is None:
        continue  # an earlier version
    folder = importlib.import_module("devrf." + room).__path__[0]
    for file in sorted(pathlib.Path(folder).rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            digest.update(file.name.encode() + file.read_bytes())
print(digest.hexdigest()[:16], folder)
"""
# Commands in one process: their arguments come by the standard input; exit codes and errors go into a file.
IN_PROCESS = """
import json, sys
from typer.testing import CliRunner
from devrf.pipelines.cli.main import app
done = []
for name, arguments in json.load(sys.stdin).items():
    result = CliRunner().invoke(app, arguments)
    print(name, result.exit_code, result.stderr, flush=True)
    done.append({"name": name, "exit": result.exit_code, "said": result.stderr})
open(sys.argv[1], "w").write(json.dumps(done))
"""
FIRST_SEVERITIES = """
import sys
from dataclasses import replace
from devrf.lab.bench.stability.axes import AXES
from devrf.pipelines.cli.main import app
for name, axis in AXES.items():
    AXES[name] = replace(axis, severities=axis.severities[:1])
app(sys.argv[1:])
"""


class Difference(NamedTuple):
    """A value beyond its bound, as it is printed."""

    what: str
    recorded: str
    now: str
    bound: str


def main(argv: Sequence[str] | None = None) -> int:
    """Record or check; 1 where something is not as it was."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("record", "check"))
    parser.add_argument("--subset", action="store_true", help="what is run after every commit")
    parser.add_argument(
        "--only", nargs="+", choices=[case.name for case in CASES], metavar="CASE", default=()
    )
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "devrf-golden")
    parser.add_argument(
        "--program", type=Path, default=Path(sys.executable), help="Python of the version to run"
    )
    parser.add_argument(
        "--beside", type=Path, help="Python of the version whose seconds of training are compared"
    )
    parser.add_argument(
        "--data", type=Path, default=os.environ.get("DEVRF_DATA", REPOSITORY.parent / "shared/data")
    )
    parser.add_argument("--seeds", action="store_true", help="record: the spread over three seeds too")
    asked = parser.parse_args(argv)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what it runs ends with it
    golden = Golden(asked.program.absolute(), asked.work.resolve(), Path(asked.data).resolve())
    chosen = [c for c in CASES if (c.name in asked.only if asked.only else c.subset or not asked.subset)]
    recorded = json.loads(RECORDED.read_text()) if RECORDED.is_file() else {}
    listed = json.loads(GONE.read_text()) if asked.what == "check" else {}
    found: list[Difference] = []
    if asked.what == "check":
        missing = [case.name for case in chosen if case.name not in recorded]
        print("not recorded yet:", ", ".join(missing) or "none")
        chosen = [case for case in chosen if case.name in recorded]
    for case in CASES:
        if case.name not in {name for c in chosen for name in (c.name, c.exported)}:
            continue
        seconds, values = golden.run(case)
        print(f"{case.name}: {len(values)} values, {seconds:.0f} s", flush=True)
        if case in chosen:
            before = recorded.get(case.name, {"values": {}, "spread": {}})
            found += differences(before["values"], values, before["spread"], listed, case.name)
        if case in chosen and asked.what == "record":
            spread = golden.spread(case, values) if asked.seeds else before["spread"]
            about = {**golden.about(), "seconds": seconds, "seeds": 3 if spread and asked.seeds else 1}
            recorded[case.name] = {**about, "spread": spread, "values": values}
            RECORDED.write_text(json.dumps(recorded, indent=1, ensure_ascii=False) + "\n")
    if asked.beside:
        found += golden.training_seconds(Golden(asked.beside.absolute(), golden.work / "beside", golden.data))
    for row in (Difference("what", "recorded", "now", "bound"), *found) if found else ():
        print(f"{row.what:<90} {row.recorded:>16} {row.now:>16}  {row.bound}")
    print(f"{len(found)} values are {'other now' if asked.what == 'record' else 'beyond their bounds'}")
    return int(asked.what == "check" and bool(found))


def differences(
    recorded: Values, now: Values, spread: Mapping[str, float], listed: Mapping[str, Any], case: str = ""
) -> list[Difference]:
    """What is not as it was.

    Args:
        recorded, now: Values by name.
        spread: Standard deviation over seeds of some of them.
        listed: What changed on purpose: `gone` and `new`, each a reason by a pattern of `CASE/NAME`; `renamed`, triples
            of a regular expression for a name, its replacement and the reason.
        case: Of the values.
    """
    was, found = _renamed(recorded, listed.get("renamed", ())), []
    for name in sorted(was.keys() | now.keys()):
        for one, other, kind in ((was, now, "gone"), (now, was, "new")):
            patterns = listed.get(kind, {})
            if name not in other and not any(fnmatch.fnmatchcase(f"{case}/{name}", p) for p in patterns):
                texts = (_text(one[name]), kind) if kind == "gone" else (kind, _text(one[name]))
                found.append(Difference(f"{case}/{name}", texts[0], texts[1], "listed, if on purpose"))
        if name in was and name in now:
            bound = bound_of(name, was[name], spread.get(name, 0.0))
            off = _distance(was[name], now[name])
            if off > bound:
                last = f"turned by {off:.3g}" if isinstance(now[name], dict) else _text(now[name])
                allowed = f"{bound:.3g}" if bound else "equal"
                found.append(Difference(f"{case}/{name}", _text(was[name]), last, allowed))
    return found


def bound_of(name: str, value: Any, spread: float) -> float:
    """How far a value may be off: its bound or twice its spread, a share of a count, 0 for all else."""
    if re.search(f"({COUNTED})$", name):
        return COUNT_SHARE * value
    return next((max(bound, 2 * spread) for pattern, bound in BOUNDS if re.search(f"{pattern}$", name)), 0.0)


def _distance(was: Any, now: Any) -> float:
    """Of numbers or poses; of anything else 0 where equal, else infinite."""
    if isinstance(was, dict) and isinstance(now, dict):
        return turned_deg(was, now)
    if isinstance(was, int | float) and isinstance(now, int | float):
        return abs(now - was)
    return 0.0 if was == now else float("inf")


def _renamed(values: Values, rules: Sequence[Sequence[str]]) -> Values:
    """Under the names of today; verdicts of rows that have come to share a name stand together."""
    result: Values = {}
    for name, value in values.items():
        for old, new, _ in rules:
            name = re.sub(old, new, name)
        shared = name in result and isinstance(value, str)
        result[name] = " ".join(sorted(f"{result[name]} {value}".split())) if shared else value
    return result


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return f"{len(value)} poses"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Golden:
    """The program, where its cases lie, and the captures they are made of."""

    program: Path
    work: Path
    data: Path

    def run(self, case: Case) -> tuple[float, Values]:
        """Seconds and values of a case; it is run where this code has not done so, or goes on where it was."""
        folder, digest = self.work / case.name, self._version()[0]
        state = folder / "golden.json"
        done = json.loads(state.read_text()) if state.is_file() else {}
        if done.get("digest") != digest:
            shutil.rmtree(folder, ignore_errors=True)
            done = {"digest": digest, "exit": {}, "seconds": 0.0}
        folder.mkdir(parents=True, exist_ok=True)
        case.prepare(folder, self.data)
        state.write_text(json.dumps(done))
        commands = {name: self._arguments(text, folder) for name, text in case.commands.items()}
        for name, arguments in {"all": commands}.items() if case.in_process else commands.items():
            if name not in done["exit"]:
                begun = time.monotonic()
                done["exit"][name] = self._call(case, folder, arguments)
                done["seconds"] += time.monotonic() - begun
                state.write_text(json.dumps(done))
        values: Values = {f"exit.{name}": code for name, code in done["exit"].items()}
        values |= said_values(folder / "said.json", not case.exported) if case.in_process else {}
        values |= _of_runs(folder, case.runs)
        for name in case.formats:
            values |= {f"{name}.{key}": value for key, value in export_values(folder / name).items()}
        return round(done["seconds"], 1), values

    def spread(self, case: Case, values: Values) -> dict[str, float]:
        """Standard deviation of the quality over three seeds; runs what is not there yet."""
        folder, of_seeds = self.work / case.name, [values]
        if case.again is None or ("*" not in case.runs and not (folder / case.runs).exists()):
            return {}
        for seed in SEEDS:
            runs = case.again_runs.format(seed=seed)
            if "*" not in runs and not (folder / runs).exists():
                shutil.copytree(folder / case.runs, folder / runs)  # stages before the trainings are the same
            text = case.again.replace("{command}", list(case.commands.values())[-1])
            self._call(case, folder, self._arguments(text, folder, seed))
            of_seeds.append(_of_runs(folder, runs))
        names = [name for name in values if re.search(r"\.(psnr|ssim)$", name)]
        found = {name: [v[name] for v in of_seeds if v.get(name) is not None] for name in names}
        return {name: round(statistics.stdev(v), 5) for name, v in found.items() if len(v) == len(of_seeds)}

    def training_seconds(self, other: "Golden") -> list[Difference]:
        """The example's trainings by this program and by another, in turns; of each the faster of two."""
        seconds: dict[tuple[str, Golden], list[float]] = {}
        for turn in range(3):
            for one in (other, self):
                folder = one.work / "example"
                if turn == 0:
                    one.run(CASES[0])
                    continue
                forced = " --from canonical --until deformation --force canonical --force deformation"
                one._call(CASES[0], folder, one._arguments(CASES[0].commands["run"] + forced, folder))
                for stage in ("canonical", "deformation"):
                    metrics = json.loads((folder / "run" / stage / "metrics.json").read_text())
                    seconds.setdefault((stage, one), []).append(metrics["seconds"])
        found = []
        for stage in ("canonical", "deformation"):
            before, now = min(seconds[stage, other]), min(seconds[stage, self])
            print(f"seconds of {stage}: {before:.1f} before, {now:.1f} now")
            if now > TRAINING_TIMES * before:
                texts = f"{before:.1f}", f"{now:.1f}", f"{TRAINING_TIMES} times"
                found.append(Difference(f"seconds of {stage}", *texts))
        return found

    def about(self) -> dict[str, str]:
        """Which code it is, and on which machine it runs."""
        git = ["git", "-C", self._version()[1]]
        head, changed = (
            subprocess.run([*git, *command], capture_output=True, text=True).stdout.strip()
            for command in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "-uno"))
        )
        cpu = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
        machine = f"{cpu.group(1) if cpu else platform.machine()}, {os.cpu_count()} cores"
        return {"commit": head + (" and changes" if changed else ""), "machine": machine}

    def _version(self) -> tuple[str, str]:
        """Digest of the program's code, and a folder of it."""
        done = subprocess.run([self.program, "-c", DIGEST], check=True, capture_output=True, text=True)
        digest, _, folder = done.stdout.strip().partition(" ")
        return digest, folder

    def _arguments(self, text: str, folder: Path, seed: int = 0) -> list[str]:
        return text.format(case=folder, work=self.work, seed=seed).split()

    def _call(self, case: Case, folder: Path, arguments: Sequence[str] | Mapping[str, list[str]]) -> int:
        """Run one command of a case, or all of them in one process; its exit code."""
        said = None
        if case.in_process:
            command, said = [self.program, "-c", IN_PROCESS, folder / "said.json"], json.dumps(arguments)
        else:
            start = [self.program.parent / "devrf-pipeline"]
            if case.first_severities:
                start = [self.program, "-c", FIRST_SEVERITIES]
            command = [*start, *arguments]
        environment = os.environ | {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "PASSIVE"}
        log = folder / "log.txt"
        print(f"{time.strftime('%H:%M:%S')} {case.name}: {log}", flush=True)
        with log.open("a") as out:
            return subprocess.run(
                command, input=said, text=True, env=environment, stdout=out, stderr=out
            ).returncode


def _of_runs(folder: Path, pattern: str) -> Values:
    """Values of all run folders that a pattern fits; where it has a `*`, by what stands there."""
    parts, values = Path(pattern).parts, Values()
    for run in sorted(folder.glob(pattern)):
        name = run.relative_to(folder).parts[parts.index("*")] + "." if "*" in parts else ""
        values |= {name + key: value for key, value in run_values(run).items()}
    return values


if __name__ == "__main__":
    sys.exit(main())
