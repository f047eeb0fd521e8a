"""What `golden.py` compares: values out of run folders, exports and what was said, as a flat table of names."""

import json
import re
import struct
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Values = dict[str, Any]


def run_values(run: Path) -> Values:
    """Quality, errors against the truth, clocks, poses and health of one run folder.

    Poses are rotation vectors of `cam_from_world` by camera or picture; a health row is its code and its verdict, all
    verdicts where rows share a code.
    """
    metrics = _json(run / "evaluate" / "metrics.json") or _json(run / "metrics.json")
    blocks = {key: metrics.get(key) for key in ("static_baseline", "truth") if metrics.get(key)}
    blocks |= {key: block for key, block in metrics.items() if key.startswith("test") and block}
    values = {key: value for key, value in _leaves(blocks) if ".why" not in key}
    for name, clock in _json(run / "sync" / "sync.json").get("cameras", {}).items():
        values[f"clock.{name}.offset_s"] = clock["offset_s"]
    for key, file, inner, pose in (
        ("poses.sweep", "static_poses/static_poses.json", "frames", "camera_from_world"),
        ("poses.rig", "rig/rig.json", "cameras", "cam_from_world"),
    ):
        if found := _json(run / file).get(inner):
            turned = Rotation.from_matrix([np.array(one[pose])[:, :3] for one in found.values()]).as_rotvec()
            values[key] = {
                name: " ".join(f"{x:.6f}" for x in r) for name, r in zip(found, turned, strict=True)
            }
    verdicts: dict[str, list[str]] = defaultdict(list)
    for file in sorted(run.glob("*/health.json")):
        for row in _json(file)["rows"]:
            verdicts[f"health.{file.parent.name}.{row['code']}"].append(row["verdict"])
    return values | {name: " ".join(sorted(found)) for name, found in verdicts.items()}


def turned_deg(was: dict[str, str], now: dict[str, str]) -> float:
    """Largest angle between two sets of poses, after the rotation of the world that brings all of them together.

    Returns:
        Degrees; infinite where one set has a camera more.
    """
    if was.keys() != now.keys():
        return float("inf")
    a, b = (Rotation.from_rotvec([np.fromstring(poses[n], sep=" ") for n in was]) for poses in (was, now))
    world = (a.inv() * b).mean()
    return float(np.degrees((b * (a * world).inv()).magnitude()).max())


def said_values(file: Path, mistakes: bool) -> Values:
    """Exit code of each command of one process, and the number of lines on its standard error."""
    values: Values = {}
    for one in json.loads(file.read_text()):
        values[f"{one['name']}.exit"] = one["exit"]
        if mistakes:
            values[f"{one['name']}.mistakes"] = sum(bool(line.strip()) for line in one["said"].splitlines())
    return values


def export_values(folder: Path) -> Values:
    """What lies in the folder of an export: files by ending, what their headers count, and names of keys and arrays."""
    counts: Counter[str] = Counter()
    names: set[str] = set()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        counts[f"files{path.suffix}"] += 1
        counted, named = READERS[path.suffix](path) if path.suffix in READERS else ({}, ())
        counts.update(counted)
        names.update(named)
    return {**counts, **{f"name.{name}": "there" for name in sorted(names)}}


Facts = tuple[dict[str, int], list[str]]  # what is counted, and names of keys and arrays


def _ply(path: Path) -> Facts:
    header = path.read_bytes().partition(b"end_header")[0].decode()
    counts = {f"ply_{name}": int(count) for name, count in re.findall(r"element (\w+) (\d+)", header)}
    return counts, re.findall(r"property .* (\w+)\n", header)


def _glb(path: Path) -> Facts:
    data = path.read_bytes()
    scene = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    part, sizes = scene["meshes"][0]["primitives"][0], [accessor["count"] for accessor in scene["accessors"]]
    vertices, corners = sizes[part["attributes"]["POSITION"]], sizes[part["indices"]]
    counts = {"glb_vertex": vertices, "glb_face": corners // 3, "glb_targets": len(part.get("targets", ()))}
    return counts, [*scene, *part["attributes"]]


def _keys(path: Path) -> Facts:
    content = json.loads(path.read_text())
    if not isinstance(content, dict):
        return {f"entries_{path.name}": len(content)}, []
    return {"frames": len(content.get("frames", ()))}, list(content)


def _colmap(path: Path) -> Facts:
    return {f"colmap_{path.stem}": struct.unpack("<Q", path.read_bytes()[:8])[0]}, []


READERS = {".ply": _ply, ".glb": _glb, ".json": _keys, ".bin": _colmap}


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.is_file() else {}


def _leaves(tree: dict[str, Any], above: str = "") -> list[tuple[str, Any]]:
    found = []
    for key, value in tree.items():
        found += _leaves(value, f"{above}{key}.") if isinstance(value, dict) else [(above + key, value)]
    return found
