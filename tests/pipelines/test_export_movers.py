"""Rigid parts in every format that reads the model: each thing where its motion takes it, once, and at all times."""

import base64
import json
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.make.glb import read_glb
from tests.make.models import (
    AABB,
    BALL,
    CENTRES,
    REST,
    SIZES,
    SLAB,
    STICK,
    motion_at,
    moving_parts,
    outside,
)
from tests.pipelines.trained_run import SCALE, write_trained

from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.terminal.console import Talk
from devrf.reconstruct.fields.shading import Shading

TIMES = (REST, 1.0)
Shown = Iterator[tuple[float, np.ndarray, np.ndarray]]
"""Times in [0, 1], points in the box frame and their colours in [0, 1]."""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trained(tmp_path_factory.mktemp("parts"), model=moving_parts()).parent / "run"


def _clouds(folder: Path, facts: dict[str, Any]) -> Shown:
    plyfile = pytest.importorskip("plyfile")
    for entry in facts["files"]:
        vertex = plyfile.PlyData.read(str(folder / entry["file"]))["vertex"]
        xyz = np.stack([vertex[axis] for axis in "xyz"], axis=1)
        if "f_dc_0" in vertex:
            rgb = 0.5 + 0.28209479177387814 * np.stack([vertex[f"f_dc_{k}"] for k in range(3)], 1)
        else:
            rgb = np.stack([vertex[name] for name in ("red", "green", "blue")], 1) / 255
        yield entry["time"], xyz * SCALE, rgb


def _animated(folder: Path, facts: dict[str, Any]) -> Shown:
    mesh = read_glb(folder / "scene.glb")
    assert mesh.names == ["what stands", "part 1", "part 2"]
    for time_s, shape in zip(mesh.times_s, mesh.shapes, strict=True):
        yield facts["first_time_s"] + time_s, shape * SCALE, mesh.rgb


def _played(folder: Path, facts: dict[str, Any]) -> Shown:
    page = (folder / "player.html").read_text()
    about = json.loads(re.findall(r'id="about">(.*?)</script>', page, re.S)[0])
    data = zlib.decompress(base64.b64decode(re.findall(r'id="splats">(.*?)</script>', page, re.S)[0]))
    told = about["splats"]
    n, m, shape = told["count"], told["moving"], (told["keys"], told["nodes"], 7)
    places = np.frombuffer(data, "<f4", 3 * n).reshape(n, 3).astype(np.float64)
    rgb = np.frombuffer(data, np.uint8, 3 * n, 20 * n).reshape(n, 3) / 255
    part = np.frombuffer(data, np.uint8, m, 23 * n)
    nodes = np.frombuffer(data, "<f4", int(np.prod(shape)), 23 * n + m).reshape(shape)
    assert len(data) == 23 * n + m + nodes.nbytes and set(part) == {1, 2}
    for time, node in zip(about["times"], nodes, strict=True):
        turned = Rotation.from_quat(node[part - 1, :4], scalar_first=True).apply(places[:m])
        yield time, np.concatenate([turned + node[part - 1, 4:], places[m:]]), rgb


FORMATS: dict[str, Callable[[Path, dict[str, Any]], Shown]] = {
    "ply": _clouds,
    "glb": _animated,
    "splat": _clouds,
    "player": _played,
}


def exported(run: Path, folder: Path, name: str, **options: Any) -> tuple[Path, dict[str, Any]]:
    if name == "glb":
        pytest.importorskip("skimage")
    folder = export(Talk("quiet"), run, ExportOptions(name, folder / name, **options))
    return folder, json.loads((folder / "export.json").read_text())


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.full) if n in ("splat", "player") else n for n in FORMATS]
)
def test_each_thing_is_where_its_motion_takes_it_and_nowhere_else(
    run_dir: Path, tmp_path: Path, name: str
) -> None:
    times = ",".join(f"{time}s" for time in TIMES)
    splats = {"splats": 1500} if name in ("splat", "player") else {}
    folder, facts = exported(run_dir, tmp_path, name, times=times, **splats)
    voxel, found = moving_parts().rest.canonical.voxel, []
    for time, points, rgb in FORMATS[name](folder, facts):
        found.append(time)
        rotations, shifts = motion_at(time)
        for thing in (STICK, BALL, SLAB):
            mine = points[rgb.argmax(1) == thing]
            near = outside(thing, mine, time) < 1.5 * voxel
            # a few splats in a hundred are where two things touch, of the one's colour on the other
            assert near.mean() > (0.97 if splats else 1 - 1e-9), (time, thing)
            mine = mine[near]
            at_rest = (mine - shifts[thing]) @ rotations[thing] - CENTRES[thing]
            ends = np.stack([-at_rest.min(0), at_rest.max(0)])
            np.testing.assert_allclose(ends, np.tile(SIZES[thing], (2, 1)), atol=1.5 * voxel)
    assert found == pytest.approx(list(TIMES))


def test_the_light_of_a_time_is_in_its_colours(tmp_path: Path) -> None:
    model = moving_parts()
    assert model.movers is not None
    model.movers.shading = Shading.none(AABB, 0.0, 1.0, torch.device("cpu"))
    with torch.no_grad():
        model.movers.shading.grid[0, -1] = np.log(0.5)  # what stands, at the end
        model.movers.shading.grid[1, -1] = np.log(0.7)  # what moves
    run = write_trained(tmp_path, model=model).parent / "run"
    folder, facts = exported(run, tmp_path, "ply", times="0s,1s")
    for time, _, rgb in _clouds(folder, facts):
        for thing in (STICK, BALL, SLAB):
            brightest = np.median(rgb[rgb.argmax(1) == thing, thing])
            expected = np.reciprocal(1 + np.exp(-3)) * (1.0 if time == 0 else 0.5 if thing == SLAB else 0.7)
            assert brightest == pytest.approx(expected, abs=0.02), (time, thing)
