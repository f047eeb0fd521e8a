"""Files that users and other programs write, as nobody should, through the commands that read them: what is said.

    python -m benchmarks.fuzz [--only WORD] [--json FILE]     # from the repository's root

Each input that somebody thought of, once: deep JSON, numbers beyond all numbers, names that no system takes, pipes,
folders in place of files (damage at random is that of `tests/faults/test_fuzz_files.py`). A row per input that was
taken wrongly (a traceback, a fault of the program, an exit code that does not belong there, more than 10 s or 1 GB
before a message), and rows of all.
"""

import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.script import arguments, finish
from tests.faults.fuzz_material import FRAMES, SIZE, pictures, scene_yaml
from tests.faults.fuzzing import Fuzzer, Outcome, fuzzer
from tests.faults.mutations import NUMBERS

from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, write_rig
from devrf.capture.camera import Camera
from devrf.capture.video.video_writer import write_video
from devrf.lab.bench.bench_rows import Row

MOST_S, MOST_MB = 10.0, 1000.0
CLIPS = {"cam0": "cam0.mp4", "cam1": "cam1.mp4"}
DRY = ("run", "SCENE", "--dry-run", "--until", "sync")
OPTIONS = {
    "evaluate.truth": "truth.json",
    "calibration.rig.given": "rig.json",
    "capture.timestamps": "times.csv",
}
DEEP = {"lists": "[" * 60_000, "objects": '{"a":' * 60_000, "lists, closed": "[" * 5000 + "]" * 5000}
ODD = {
    **DEEP, "nothing": "", "zeros": "\0" * 500, "digits": "9" * 5000, "half a text": '"x', "null": "null",
    "NUL": '{"\\u0000": "\\u0000"}',
}  # fmt: skip
DIGITS = (
    "0x" + "f" * 5000,
    "0b" + "1" * 20_000,
    "1" + ":59" * 5000,
    "9" * 5000,
    "-0x" + "1" * 4000,
    "1e999999",
)
NAMES = (
    "a" * 300, "x/" * 3000, '"a\\0b"', "~nobody/x", "/dev/zero", "pipe", "loop", '"\\ud800"', "/proc/self/mem",
    "folder",
)  # fmt: skip
RUN_FILES = (
    ".digests.json", ".lock", "devrf.log", "events.jsonl", "ingest/stamp.json", "ingest/health.json",
    "ingest/ingest.json", ".failed-ingest.json", "sync/sync.json",
)  # fmt: skip

Result = tuple[str, Outcome, tuple[int, ...]]
"""Name of an input, how it was taken, and the exit codes that belong there."""

Thought = tuple[str, Callable[[Path], Any], tuple[str, ...], tuple[int, ...]]
"""Name of an input, what it changes in a scene's folder, the command, and the exit codes that belong there."""


def main() -> None:
    """Give every input, print the rows and write them."""
    chosen = arguments(__doc__, only="")
    with tempfile.TemporaryDirectory() as folder, fuzzer() as run:
        place = Path(folder)
        base = session(place / "base")
        results = [*thought_of(run, base, place / "scene", chosen.only)]
    finish("fuzz", rows_of(results), chosen.json)


def rows_of(results: list[Result]) -> list[Row]:
    """What was taken wrongly, and the extremes of all."""
    faults = [
        (name, fault)
        for name, outcome, allowed in results
        if (fault := fault_of(outcome, allowed)) is not None
    ]
    told = [outcome for _, outcome, _ in results if outcome.code != 0]
    worked, memory = max((o.worked_s for o in told), default=0), max((o.peak_mb for o in told), default=0)
    return [
        *(Row(f"fuzz/{name}: {fault}", 1, "fault").at_most(0) for name, fault in faults),
        Row("fuzz/inputs", len(results), "inputs"),
        Row("fuzz/faults", len(faults), "faults").at_most(0),
        Row("fuzz/most work before a message", round(worked, 1), "s").at_most(MOST_S),
        Row("fuzz/most memory before a message", round(memory), "MB").at_most(MOST_MB),
    ]


def fault_of(outcome: Outcome, allowed: tuple[int, ...]) -> str | None:
    """What is wrong with how an input was taken, or None."""
    fault = outcome.fault(allowed)
    if fault is None and outcome.code != 0 and (outcome.worked_s > MOST_S or outcome.peak_mb > MOST_MB):
        fault = f"{outcome.worked_s:.0f} s and {outcome.peak_mb:.0f} MB before a message"
    return fault


def thought_of(run: Fuzzer, base: Path, scene: Path, only: str) -> Iterator[Result]:
    """How each input that somebody thought of is taken."""
    inputs = itertools.chain(of_texts(), of_tables(), of_rigs(), of_run_folders())
    for name, change, command, allowed in inputs:
        if only in name:
            shutil.rmtree(scene, ignore_errors=True)
            shutil.copytree(base, scene, symlinks=True)
            change(scene)
            yield name, run.command(*(word.replace("SCENE", str(scene)) for word in command)), allowed


def of_texts() -> Iterator[Thought]:
    """Numbers and names in scene.yaml, and files that are none of what they should be."""
    for digits in DIGITS:
        line = f"\nreconstruct: {{seed: {digits}}}\n"
        yield f"scene.yaml: {digits[:6]}", added("scene.yaml", line), DRY, (2,)
    for name in NAMES:
        yield f"path: {name[:9]}", odd_names, (*DRY, "--set", f"capture.timestamps={name}"), (2,)
    for (what, text), (key, file) in itertools.product(ODD.items(), OPTIONS.items()):
        yield f"{file}: {what}", written(file, text), (*DRY, "--set", f"{key}={file}"), (2,)


def of_tables() -> Iterator[Thought]:
    """Tables of times that are none."""
    n = range(FRAMES)
    tables = {
        "one row at 0": rows(n, [0, *(1.7e9 + i / 10 for i in n[1:])]),
        "a year apart": rows(n, [3.2e7 * i for i in n]),
        "beyond all numbers": rows(n, [1e307 * i for i in n]),
        "from below zero": rows(n, [-1e308, *n[1:-1], 1e308]),
        "nanoseconds": rows(n, [1.7e18 + 1e8 * i for i in n]),
        "indices of no clip": rows([i + 1000 for i in n], n),
        "indices of thirty digits": rows([10**30 + i for i in n], n),
        "digits without end": rows(["9" * 5000, *n[1:]], n),
    }
    for what, text in tables.items():
        yield (
            f"table: {what}",
            written("times.csv", text),
            (*DRY, "--set", "capture.timestamps=times.csv"),
            (2,),
        )


def of_rigs() -> Iterator[Thought]:
    """A given rig.json in which one number is another."""
    for key, value in itertools.product(("K", "distortion", "cam_from_world", "width", "factor"), NUMBERS):
        command = (*DRY, "--set", "calibration.rig.given=rig.json")
        yield f"rig: {key} is {value[:8]}", odd_rig(key, value or "null"), command, (0, 2)


def of_run_folders() -> Iterator[Thought]:
    """Files of a run folder that are deep, or a folder."""
    for (what, text), file in itertools.product([*DEEP.items(), ("a folder", None)], RUN_FILES):
        change = folder_instead(f"run/{file}") if text is None else written(f"run/{file}", text)
        for command in ("status", "report"):
            yield f"{command} with {file}: {what}", change, (command, "SCENE"), (0, 1, 2)


def added(file: str, text: str) -> Callable[[Path], Any]:
    """Text at the end of a file."""
    return lambda scene: (scene / file).write_text((scene / file).read_text() + text)


def written(file: str, text: str) -> Callable[[Path], Any]:
    """Text in place of a file's."""
    return lambda scene: (scene / file).write_text(text)


def folder_instead(file: str) -> Callable[[Path], Any]:
    """A folder in place of a file."""

    def change(scene: Path) -> None:
        (scene / file).unlink()
        (scene / file / "x").mkdir(parents=True)

    return change


def odd_names(scene: Path) -> None:
    """What can have a name and is no file."""
    os.mkfifo(scene / "pipe")
    (scene / "loop").symlink_to("loop")
    (scene / "folder").mkdir()


def odd_rig(key: str, value: str) -> Callable[[Path], Any]:
    """One number of a rig.json, as text."""

    def change(scene: Path) -> None:
        content = json.loads((scene / "rig.json").read_text())
        here: Any = content["scale"] if key == "factor" else content["cameras"]["cam0"]
        place: Any = key
        while isinstance(here[place], list):
            here, place = here[place], 0
        here[place] = "HOLE"
        (scene / "rig.json").write_text(json.dumps(content).replace('"HOLE"', value))

    return change


def session(folder: Path) -> Path:
    """Two short clips, files beside them, and a run folder with files of two stages."""
    scene = scene_yaml(folder, capture={"cameras": CLIPS})
    for clip in CLIPS.values():
        write_video(folder / clip, pictures(), 10.0)
    (folder / "times.csv").write_text(rows(range(FRAMES), [n / 10 for n in range(FRAMES)]))
    pose = np.eye(4).tolist()
    truth = {"static": [pose], "cams": {"cam0": {"pose": pose, "offset_s": 0.1, "drift_ppm": 3.0}}}
    (folder / "truth.json").write_text(json.dumps(truth))
    rig = {name: RigCamera(camera, "given") for name, camera in cameras().items()}
    write_rig(folder / "rig.json", Rig(rig, ARBITRARY))
    for file in RUN_FILES:
        (folder / "run" / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / "run" / file).write_text("{}" if file.endswith(".json") else "")
    return scene


def cameras() -> dict[str, Camera]:
    """Two cameras side by side."""
    K = np.array([[90.0, 0, SIZE[0] / 2], [0, 90.0, SIZE[1] / 2], [0, 0, 1]])
    pose = np.column_stack([np.eye(3), [0, 0, 2.0]])
    return {name: Camera(*SIZE, K, pose + 0.3 * n * np.eye(3, 4, 3)) for n, name in enumerate(CLIPS)}


def rows(indices: Iterable[Any], times: Iterable[Any]) -> str:
    """A table of times, the same for both cameras."""
    lines = [f"{n},{t}" for n, t in zip(indices, times, strict=True)]
    return "\n".join(["camera,frame_index,time_s", *(f"{name},{line}" for name in CLIPS for line in lines)])


if __name__ == "__main__":
    main()
