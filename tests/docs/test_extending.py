"""docs/extending.md as it stands: flow method and motion model are installed, method and stage put in; all are run."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.conftest import Command
from tests.docs.pages import REPOSITORY, blocks

from devrf.flow.store import read_flows

PAGE = REPOSITORY / "docs" / "extending.md"
INSERT = re.compile(r"^In `(\S+)`, before `(.+?)`:\n\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)
TRAINED = """
import sys
from pathlib import Path

from devrf.capture.formats.datasets import read_dataset
from devrf.flow.dis import DisFlow
from devrf.lab.methods.method_table import METHODS
from devrf.lab.methods.protocol import MethodTask, TimeBudget
from devrf.reconstruct.options import preset

scene = read_dataset("nerfstudio", Path(sys.argv[1]))
task = MethodTask(scene, {}, "joint", "small", "cpu", 0, preset, DisFlow)
model = METHODS["grids"].load().train(task, TimeBudget(600.0, steps=3))
assert model.render(task.boxed.dynamic[0].camera, 0.5)[0].shape == (80, 128, 3) and model.megabytes > 0.5
"""
STEP = 4  # pixels to the right per time


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set in nerfstudio's layout: nine views at rest, two cameras that see a textured wall slide."""
    folder = tmp_path_factory.mktemp("extended")
    rng = np.random.default_rng(0)
    wide = cv2.resize(
        rng.integers(20, 235, (16, 40, 3)).astype(np.uint8), (200, 80), interpolation=cv2.INTER_CUBIC
    )
    frames = []

    def add(name: str, angle: float, picture: np.ndarray, **more: object) -> None:
        cv2.imwrite(str(folder / f"{name}.png"), picture)
        z = np.array([np.sin(angle), 0.0, np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross([0.0, 1.0, 0.0], z), [0.0, 1.0, 0.0], z], axis=1)
        pose[:3, 3] = 4.0 * z
        frames.append({"file_path": f"{name}.png", "transform_matrix": pose.tolist(), **more})

    for n in range(9):
        add(f"static{n}", 2 * np.pi * n / 9, wide[:, :128])
    for camera, angle in (("cam0", -0.3), ("cam1", 0.3)):
        for n in range(3):
            shown = wide[:, 60 - STEP * n : 188 - STEP * n]
            add(f"{camera}_{n}", angle, shown, camera=camera, frame_index=n, time=n / 2)
    lens = {"fl_x": 120.0, "fl_y": 120.0, "cx": 64.0, "cy": 40.0, "w": 128, "h": 80}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    (folder / "scene.yaml").write_text(
        "name: x\noutput: run\npreset: tiny\ndataset: {format: nerfstudio, path: .}\n"
        "reconstruct: {image_scale: 1.0}\n"
    )
    return folder / "scene.yaml"


def write_files(folder: Path) -> None:
    """The blocks of the page that say which file they are."""
    for block in blocks(PAGE):
        if block.file is not None:
            (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.file).write_text(block.text, encoding="utf-8")


def installed(package: str, folder: Path, patch: pytest.MonkeyPatch) -> Path:
    """A package of the page, written and installed beside devrf for what this process starts; where its module is."""
    write_files(folder)
    offline = ("--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--quiet")
    target = folder / "installed"
    install = [sys.executable, "-m", "pip", "install", *offline, "--target", target, folder / package]
    subprocess.run(install, check=True)
    patch.setenv("PYTHONPATH", str(target))
    return target


@pytest.mark.full
def test_the_flow_method(
    scene: Path, tmp_path: Path, devrf_process: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = installed("one-shift", tmp_path, monkeypatch)
    subprocess.run([sys.executable, tmp_path / "try_it.py"], check=True)

    method = ("--set", "flow.method=one-shift")
    result = devrf_process("run", scene, "--until", "flow", *method)
    assert result.code == 0, result.said
    flows = read_flows(scene.parent / "run" / "flow")
    middle = np.median(flows["cam0"].flow.astype(np.float32), axis=(0, 1, 2))
    np.testing.assert_allclose(middle, [-STEP, 0], atol=0.1)
    assert json.loads((scene.parent / "run" / "flow" / "flow.json").read_text())["method"] == "one shift"
    with (target / "one_shift.py").open("a") as module:
        module.write("# another version\n")
    (reason,) = why(devrf_process, scene, "flow", *method)
    assert "one_shift" in reason


@pytest.mark.full
def test_the_motion_model(
    scene: Path, tmp_path: Path, devrf_process: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = ("reconstruct.canonical_iterations=50", "reconstruct.resolution=32", "reconstruct.motion=drift")
    settings = [word for key in short for word in ("--set", key)]
    assert "devrf.motion" in devrf_process("run", scene, *settings, "--dry-run").said
    target = installed("drift", tmp_path, monkeypatch)
    result = devrf_process("run", scene, "--until", "evaluate", "--allow-unhealthy", *settings)
    assert result.code == 0, result.said
    metrics = json.loads((scene.parent / "run" / "deformation" / "metrics.json").read_text())
    assert metrics["decisions"] == ["motion: by drift (drift:create)"] and metrics["largest_motion"] > 0
    assert "reconstruct.motion" in " ".join(why(devrf_process, scene, "deformation", *settings[:4]))
    with (target / "drift.py").open("a") as module:
        module.write("# another version\n")
    (reason,) = why(devrf_process, scene, "deformation", *settings)
    assert "drift" in reason


def why(devrf_process: Command, scene: Path, stage: str, *arguments: str) -> list[str]:
    """Why a stage is stale."""
    result = devrf_process("status", scene, "--json", *arguments)
    assert result.code == 0, result.said
    return {now["stage"]: now["why"] for now in json.loads(result.out)["stages"]}[stage]


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder for PYTHONPATH: devrf with what the page puts into the repository."""
    folder = tmp_path_factory.mktemp("source")
    (folder / "devrf").mkdir()
    shutil.copy(REPOSITORY / "src" / "devrf" / "__init__.py", folder / "devrf")
    for room in ("capture", "calibration", "flow", "reconstruct"):
        os.symlink(REPOSITORY / room, folder / "devrf" / room)
    for room in ("pipelines", "lab"):
        shutil.copytree(REPOSITORY / room, folder / "devrf" / room)
    write_files(folder / "devrf")
    insertions = INSERT.findall(PAGE.read_text(encoding="utf-8"))
    assert len(insertions) == 5
    for file, before, text in insertions:
        path = folder / "devrf" / file
        source = path.read_text(encoding="utf-8")
        words = re.findall(r"\w+|[^\w\s]", before)
        (place,) = re.finditer(r"\s*".join(map(re.escape, words)), source)
        start = source.rindex("\n", 0, place.start()) + 1
        path.write_text(source[:start] + text + source[start:], encoding="utf-8")
    return folder


@pytest.mark.full
def test_the_method(scene: Path, extended: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(extended))
    subprocess.run([sys.executable, "-c", TRAINED, scene.parent], check=True)


def test_the_stage(
    scene: Path, extended: Path, devrf_process: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(extended))

    result = devrf_process("run", scene, "--until", "contact_sheet")
    assert result.code == 0 and "contact_sheet: done" in result.said, result.said
    sheet = cv2.imread(str(scene.parent / "run" / "contact_sheet" / "sheet.png"))
    assert sheet is not None and sheet.shape == (2 * 90, 8 * 120, 3)
    assert sheet[45].reshape(8, 120, 3).std(axis=1).min() > 5, "a picture is missing"
    (row,) = json.loads((scene.parent / "run" / "contact_sheet" / "health.json").read_text())["rows"]
    assert row["code"] == "sweep-dark" and row["verdict"] == "ok"
    narrow = ("--set", "contact_sheet.width_px=64")
    (reason,) = why(devrf_process, scene, "contact_sheet", *narrow)
    assert reason.startswith("contact_sheet.width_px: ") and "120" in reason and "64" in reason
    refused = devrf_process("status", scene, "--set", "contact_sheet.width_px=3")
    assert refused.code == 2 and "contact_sheet.width_px: 3; " in refused.said
