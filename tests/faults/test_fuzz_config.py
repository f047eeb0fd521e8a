"""Mutated scene.yaml through `devrf-pipeline run --dry-run`: exit code 0 or 2, a message, never a traceback or a hang.

A mutation that cannot matter (another order, comments, aliases) must end with 0, one that surely is wrong with 2.
A failing case is printed whole; hypothesis makes it small, and seeds are fixed.
"""

import copy
import json
import os
import random
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from tests.conftest import Command, Figures
from tests.faults.fuzzing import Fuzzer
from tests.faults.hostile import NUMBERS, RAW_TEXTS, TEXTS, WORDS

from devrf.capture.formats.datasets import write_dataset
from devrf.capture.photos.picture_files import write_png
from devrf.capture.scene import Scene
from devrf.capture.video.video_writer import write_video

pytestmark = pytest.mark.full

GOOD, WRONG, EITHER = (0,), (2,), (0, 2)

BASES: dict[str, dict[str, Any]] = {
    "dynamic": {
        "name": "kuka",
        "output": "runs/kuka",
        "preset": "tiny",
        "capture": {
            "static": "static.mp4",
            "cameras": {"cam0": "cam0.mp4", "cam1": "cam1.mp4"},
            "test_cameras": {"witness": "witness.mp4"},
            "timestamps": None,
            "range_s": [0, 0.5],
            "rest": "start",
            "board": {
                "type": "charuco", "squares": [8, 6], "square_m": 0.06, "marker_m": 0.045,
                "dictionary": "DICT_5X5_100", "inverted": "auto", "legacy": True, "clips": {"cam0": "board.mp4"},
            },
            "raw": {"white_balance": [2.0, 1.0, 1.5, 1.0]},
        },
        "calibration": {
            "static_poses": {"mapper": "incremental"},
            "sync": {"method": "auto", "av_lag_s": {"cam0": 0.01}, "readout_s": {"cam1": 0.01}},
            "rig": {"method": "auto", "known_distance_m": 1.5},
            "colour": {"method": "auto"},
        },
        "flow": {"method": "dis"},
        "reconstruct": {"image_scale": 0.5, "resolution": 64, "rays": 4096, "seed": 3, "key_times": 5},
        "budget": {"memory_gb": 4, "gpu_memory_gb": 4.0, "disk_gb": 100, "time_minutes": 60},
        "evaluate": {"holdout_every": 8, "lpips_weights": None, "truth": None},
    },
    "sweep of photos": {
        "name": "still life",
        "preset": "fast",
        "capture": {"static": "photos", "mattes": {"method": "chroma", "colour": "#00b140"}},
    },
    "cameras": {
        "name": "only cameras",
        "capture": {"cameras": {"a": "cam0.mp4", "b": "cam1.mp4"}, "timestamps": "times.csv"},
        "calibration": {"rig": {"given": "rig.toml"}, "sync": {"method": "timestamps"}},
    },
    "data set": {
        "name": "finished",
        "dataset": {"format": "nerfstudio", "path": "set", "frame_stride": 1, "background": [1, 1.0, 0.5]},
    },
}  # fmt: skip


values = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.integers(),
    st.floats(),
    st.text(max_size=40),
)
trees = st.recursive(
    values,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8) | values, inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


def nodes(tree: Any, path: tuple = ()) -> list[tuple]:
    """Paths of all values in nested dictionaries and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(place for key, inner in items for place in nodes(inner, (*path, key)))]


def change(tree: Any, path: tuple, action: Callable[[Any, Any], None]) -> None:
    """Call `action(container, key)` at a path of at least one key."""
    for key in path[:-1]:
        tree = tree[key]
    action(tree, path[-1])


def alike(value: Any) -> st.SearchStrategy[Any]:
    """Values of the same kind."""
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, int):
        return st.integers() | st.integers(1, 20) | st.integers(16, 640)
    if isinstance(value, float):
        return st.floats() | st.floats(0, 1) | st.floats(0.02, 1)
    return st.sampled_from(TEXTS + WORDS) if isinstance(value, str) else values


@st.composite
def mutated(draw: st.DrawFn) -> tuple[str, tuple[int, ...]]:
    """Text of a scene.yaml, and the exit codes it may end with."""
    tree = copy.deepcopy(draw(st.sampled_from(list(BASES.values()))))
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        paths = [path for path in nodes(tree) if path]
        if not paths:
            break
        path = draw(st.sampled_from(paths))
        kind = draw(
            st.sampled_from(("alike", "alike", "alike", "replace", "tree", "delete", "key", "add", "copy"))
        )
        new = draw(
            trees if kind in ("tree", "add") else alike(_at(tree, path)) if kind == "alike" else values
        )
        key = draw(st.sampled_from(TEXTS) | st.text(max_size=10) | values)
        other = draw(st.sampled_from(paths))

        def act(here: Any, place: Any, kind=kind, new=new, key=key, other=other, tree=tree) -> None:
            if kind in ("alike", "replace", "tree"):
                here[place] = new
            elif kind == "delete":
                del here[place]
            elif isinstance(here, list):
                here.insert(place, new)
            elif kind == "key":
                here[key] = here.pop(place)
            elif kind == "add":
                here[key] = new
            else:
                source = tree
                for step in other:
                    source = source[step]
                here[place] = copy.deepcopy(source)

        try:
            change(tree, path, act)
        except (KeyError, IndexError, TypeError):
            continue  # what an earlier step took away
    return yaml.safe_dump(tree, allow_unicode=draw(st.booleans()), sort_keys=False), EITHER


@st.composite
def broken_text(draw: st.DrawFn) -> tuple[str, tuple[int, ...]]:
    """A good text with something written into it."""
    text = yaml.safe_dump(draw(st.sampled_from(list(BASES.values()))), sort_keys=False)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(text)))
        kind = draw(st.sampled_from(("insert", "value", "cut", "random", "line")))
        if kind == "insert":
            text = text[:at] + draw(st.sampled_from(RAW_TEXTS)) + text[at:]
        elif kind == "value":
            line_end = (text + "\n").index("\n", at)
            colon = text.rfind(":", 0, line_end)
            text = text[: colon + 1] + " " + draw(st.sampled_from(RAW_TEXTS)) + text[line_end:]
        elif kind == "cut":
            text = text[:at] + text[draw(st.integers(at, len(text))) :]
        elif kind == "random":
            text = text[:at] + draw(st.text(max_size=30)) + text[at:]
        else:
            lines = text.split("\n")
            place = draw(st.integers(0, len(lines)))
            lines.insert(place, draw(st.sampled_from(lines)))
            text = "\n".join(lines)
    return text, EITHER


@st.composite
def harmless(draw: st.DrawFn) -> tuple[str, tuple[int, ...]]:
    """The same configuration written in another way."""
    tree = copy.deepcopy(draw(st.sampled_from(list(BASES.values()))))
    order = draw(st.randoms(use_true_random=False))
    tree = shuffled(tree, order)
    text = yaml.safe_dump(
        tree, default_flow_style=draw(st.sampled_from((None, True, False))), sort_keys=False, width=10**6
    )
    if draw(st.booleans()):
        text = f"# a comment: {draw(st.sampled_from(('x', '{', '名前')))}\n\n{text}\n# the end\n"
    if draw(st.booleans()):
        text = json.dumps(tree)
    return text, GOOD


def shuffled(tree: Any, order: random.Random) -> Any:
    """Keys in another order; cameras keep theirs, because the first one gives the clock."""
    if not isinstance(tree, dict):
        return tree
    keys = list(tree)
    if not any(isinstance(tree[key], str) and tree[key].endswith(".mp4") for key in keys):
        order.shuffle(keys)
    return {key: shuffled(tree[key], order) for key in keys}


@st.composite
def surely_wrong(draw: st.DrawFn) -> tuple[str, tuple[int, ...]]:
    """One value that no configuration can have."""
    tree = copy.deepcopy(draw(st.sampled_from(list(BASES.values()))))
    sections = [path for path in nodes(tree) if isinstance(_at(tree, path), dict) and _fixed(path)]
    _at(tree, draw(st.sampled_from(sections)))["frobnicate"] = draw(values)
    return yaml.safe_dump(tree, sort_keys=False), WRONG


def _at(tree: Any, path: tuple) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def _fixed(path: tuple) -> bool:
    """Whether a section's keys are ours, not names of cameras."""
    return not {"cameras", "test_cameras", "clips", "av_lag_s", "readout_s"} & set(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All files that the configurations name, small."""
    folder = tmp_path_factory.mktemp("fuzz")
    rng = np.random.default_rng(0)
    pictures = [
        np.repeat(rng.integers(0, 255, (4, 6, 3)), 8, 0).repeat(8, 1).astype(np.uint8) for _ in range(6)
    ]
    for n, name in enumerate(("static", "cam0", "cam1", "witness", "board")):
        write_video(folder / f"{name}.mp4", [np.roll(picture, n, axis=1) for picture in pictures], 10.0)
    (folder / "photos").mkdir()
    for n in range(24):
        write_png(folder / "photos" / f"{n}.png", pictures[n % 6])
    shutil.copy(folder / "photos" / "0.png", folder / "photo.png")
    rows = [f"{name},{n},{n / 10}" for name in "ab" for n in range(6)]
    (folder / "times.csv").write_text("\n".join(["camera,frame_index,time_s", *rows]))
    tables = [
        f'[cam_{n}]\nname = "{name}"\nsize = [48, 32]\n'
        "matrix = [[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]\n"
        f"distortions = [0.0, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.{n}, 0.0]\ntranslation = [0.{n}, 0.0, 0.0]\n"
        for n, name in enumerate("ab")
    ]
    (folder / "rig.toml").write_text("\n".join(tables))
    (folder / "link").symlink_to("/etc")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "fifo")
    return folder


@pytest.fixture
def data_set(folder: Path, odd_scene: Scene) -> None:
    if not (folder / "set").exists():
        write_dataset("nerfstudio", odd_scene, folder / "set")


SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
KINDS = {"mutated": mutated(), "broken": broken_text(), "harmless": harmless(), "wrong": surely_wrong()}
SHARES = {"mutated": 0.5, "broken": 0.3, "harmless": 0.1, "wrong": 0.1}
CASES = {"small": 80, "full": 1000}
THROUGH_A_PROCESS = {"small": 2, "full": 20}  # of these, also as a user starts them


@pytest.mark.parametrize("kind", KINDS)
def test_configurations(
    run: Fuzzer,
    folder: Path,
    data_set: None,
    devrf_process: Command,
    kind: str,
    faults: Literal["small", "full"],
    figures: Figures,
) -> None:
    count = int(CASES[faults] * SHARES[kind])
    scene, codes = folder / "scene.yaml", Counter()
    every = count // max(1, round(THROUGH_A_PROCESS[faults] * SHARES[kind]))

    @settings(
        max_examples=count, derandomize=True, database=None, deadline=None, suppress_health_check=SLOW,
        phases=(Phase.generate, Phase.shrink),
    )  # fmt: skip
    @given(KINDS[kind])
    def check(case: tuple[str, tuple[int, ...]]) -> None:
        text, allowed = case
        scene.write_bytes(text.encode("utf-8", "surrogatepass"))
        arguments = ("run", scene, "--dry-run", "--until", "flow")
        outcome = run.command(*arguments)
        codes[str(outcome.code)] += 1
        fault = outcome.fault(allowed)
        if fault is None and codes.total() % every == 0:
            again = devrf_process(*arguments)
            if again.code != outcome.code or "Traceback" in again.said:
                fault = f"in a process of its own: exit code {again.code}\n{again.said[-1000:]}"
        assert fault is None, f"{fault}\n--- it said\n{outcome.said[-3000:]}\n--- scene.yaml\n{text}"

    check()
    figures(fuzzed_configurations=codes.total(), kind=kind, faults=0, exit_codes=dict(codes),
            slowest_s=round(run.slowest_s, 1), most_worked_s=round(run.most_worked_s, 1),
            most_mb=round(run.most_mb))  # fmt: skip
