"""How good the scene at rest is in furnished rooms and in two captures, by this version and by others beside it.

    python benchmarks/at_rest.py --work DIR [--cases shelves,kuka_room] [--programs before=PYTHON,now=PYTHON]
        [--seeds 1] [--json FILE]

The rooms are simulated once and their look is fixed; each program runs its own stages up to `canonical`. What it
renders is measured here, the same way for all: the test camera's clean plate (`reconstruct.still_picture`), whole and
by the outline of the scene box; the held-out sweep; the fixed cameras against the truth; seconds of training.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from golden_cases import REPOSITORY, Case, cases
from script import arguments, finish

from devrf.calibration.truth import read_truth
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.scene import load_image
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.stages.evaluate import compare
from devrf.reconstruct.metrics import psnr
from devrf.reconstruct.rays import camera_rays, intersect
from devrf.reconstruct.still_picture import still_picture

ROOMS = {  # arguments of simulate; chosen before the first training
    "shelves": "--scene tumbling --seed 11",
    "window": "--scene sheet --seed 12",
    "narrow": "--scene column --seed 13",
}
CAPTURES = ("kuka_room", "yard")
RENDER = """
import sys
from pathlib import Path
import numpy as np
from devrf.capture.formats.scene_files import read_scene
from devrf.pipelines.trained_model import load_renderer
run, out = Path(sys.argv[1]), Path(sys.argv[2])
scene, render = read_scene(run / "scene").in_box_frame(), load_renderer(run, "cpu")
first = {f.camera_name: f for f in sorted(scene.dynamic, key=lambda f: -f.time) if f.split == "test"}
found = {name: render(f.camera.scaled(scene.image_scale), None) for name, f in first.items()}
for f in scene.static:
    if f.split == "test":
        found[f"static/{f.index}"] = render(f.camera.scaled(scene.image_scale), None)
np.savez(out, **found)
"""


def session(name: str, work: Path, data: Path) -> Path:
    """The scene.yaml of a case, whose material is made where it is not there."""
    folder = work / "sessions" / name
    if not (folder / "scene.yaml").is_file():
        if name in ROOMS:
            options = f"{ROOMS[name]} --set room={name} --set board=false --quiet".split()
            _call([sys.executable, "-m", "devrf.pipelines.cli", "simulate", str(folder), *options], None)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            case: Case = next(case for case in cases() if case.name == name)
            case.prepare(folder, data)
    return folder / "scene.yaml"


def measured(name: str, scene_yaml: Path, program: str, run: Path, seed: int) -> dict[str, Any]:
    """What one program makes of one case with one seed."""
    log = run.with_suffix(".log")
    run.parent.mkdir(parents=True, exist_ok=True)
    if seed and not run.is_dir():
        shutil.copytree(run.with_name(f"{name}-0"), run)  # the cameras are the same
    options = f"--preset tiny --device cpu --until canonical --allow-unhealthy --set reconstruct.seed={seed}"
    command = [program, "-m", "devrf.pipelines.cli", "run", str(scene_yaml), *options.split()]
    _call([*command, "--set", f"output={run}"], log)
    renders = run.with_suffix(".npz")
    _call([program, "-c", RENDER, str(run), str(renders)], log)
    seconds = float(json.loads((run / "canonical" / "metrics.json").read_text())["seconds"])
    return _scores(run, np.load(renders)) | _cameras(scene_yaml, run) | {"seconds": seconds}


def _scores(run: Path, renders: Any) -> dict[str, float]:
    # Versions differ in when they take the scene to be at rest: all are compared with clean plates.
    scene = replace(read_scene(run / "scene").in_box_frame(), rest_time=None)
    aabb = torch.tensor(scene.aabb, dtype=torch.float32)
    whole, inside, outside = [], [], []
    tested = sorted((f for f in scene.dynamic if f.split == "test"), key=lambda f: f.time or 0.0)
    for camera in dict.fromkeys(f.camera_name for f in tested):
        mine = [f for f in tested if f.camera_name == camera]
        still = still_picture(scene, mine)
        assert still is not None
        view = mine[0].camera.scaled(scene.image_scale)
        meets = intersect(*camera_rays(view), aabb, scene.near)[2].numpy().reshape(view.height, view.width)
        for found, where in (
            (whole, still.known),
            (inside, still.known & meets),
            (outside, still.known & ~meets),
        ):
            if where.any():
                found.append(psnr(renders[camera][where], still.picture[where]))
    sweep = [
        psnr(
            renders[f"static/{f.index}"],
            load_image(f, scene.image_scale, scene.background).astype(np.float32) / 255,
        )
        for f in scene.static
        if f.split == "test"
    ]
    named = {"test_rest": whole, "inside": inside, "outside": outside, "sweep": sweep}
    return {key: statistics.mean(values) for key, values in named.items() if values}


def _cameras(scene_yaml: Path, run: Path) -> dict[str, float]:
    """Rotations of the fixed cameras against the truth, where there is one."""
    truth = load_scene(scene_yaml).truth_path(scene_yaml.parent)
    if truth is None:
        return {}
    found = compare(read_truth(truth), read_scene(run / "scene"), run)
    return {
        key: found[key] for key in ("rig_rotation_deg", "rig_rotation_deg_median") if found[key] is not None
    }


def _call(command: list[str], log: Path | None) -> None:
    with open(log or os.devnull, "a") as file:
        subprocess.run(command, check=True, stdout=file, stderr=subprocess.STDOUT)


def main() -> None:
    """Run every case with every program and print the rows."""
    asked = arguments(
        __doc__, work=".at_rest", data=str(REPOSITORY.parent / "shared" / "data"),
        cases=",".join((*ROOMS, *CAPTURES)), programs=f"now={sys.executable}", seeds=1,
    )  # fmt: skip
    work, rows = Path(asked.work).resolve(), []
    for name in asked.cases.split(","):
        scene_yaml = session(name, work, Path(asked.data))
        for spoken in asked.programs.split(","):
            program, python = spoken.split("=")
            found = [
                measured(name, scene_yaml, python, work / program / f"{name}-{seed}", seed)
                for seed in range(asked.seeds)
            ]
            for key in found[0]:
                values = [each[key] for each in found]
                unit = "s" if key == "seconds" else "°" if "deg" in key else "dB"
                row = Row(f"at_rest/{name}/{program}/{key}", statistics.median(values), unit)
                rows.append(row)
                print(row.name, f"{row.value:.3f}", unit, [round(v, 3) for v in values], flush=True)
    finish("at_rest", rows, asked.json)


if __name__ == "__main__":
    main()
