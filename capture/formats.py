"""Scenes on disk, in and out: the only place that converts between conventions.

Inside: OpenCV axes, `cam_from_world`. nerfstudio and Blender files: OpenGL axes (x right, y up, z back),
camera-to-world, so the second and third columns change sign. nerfstudio's cx, cy count the centre of the
first pixel as (0.5, 0.5), as we do.
"""

import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.errors import CaptureError
from devrf.capture.scene import Background, PosedFrame, Scene, SparsePoints, Split

DatasetFormat = Literal["devrf", "blender", "nerfstudio"]
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
RIGID_REPAIR = 1e-2  # poses in hand-made files are rounded; beyond this they are not rotations at all


def write_scene(folder: Path, scene: Scene) -> None:
    """Write `scene.json`, `static/transforms.json`, `dynamic/transforms.json`, `points.npz` into `folder`."""
    for part, frames in (("static", scene.static), ("dynamic", scene.dynamic)):
        if frames:
            write_transforms(folder / part / "transforms.json", frames)
    if scene.points is not None:
        points = scene.points
        np.savez(
            folder / "points.npz", xyz=points.xyz, obs_point=points.obs_point, obs_frame=points.obs_frame
        )
    lo, hi = scene.aabb.tolist()
    _write_json(
        folder / "scene.json",
        {
            "box": {"min": lo, "max": hi},
            "box_from_world": scene.box_from_world.tolist(),
            "near": scene.near,
            "far": scene.far,
            "kind": scene.kind,
            "background": scene.background,
            "t0_s": scene.t0_s,
            "t1_s": scene.t1_s,
            "rest_time": scene.rest_time,
            "image_scale": scene.image_scale,
            "metric": scene.metric,
        },
    )


def read_scene(folder: Path) -> Scene:
    """Read what `write_scene` wrote."""
    meta = _read_json(folder / "scene.json")
    parts = {part: folder / part / "transforms.json" for part in ("static", "dynamic")}
    frames = {part: read_transforms(path) if path.is_file() else () for part, path in parts.items()}
    points = None
    if (folder / "points.npz").is_file():
        with np.load(folder / "points.npz") as stored:
            points = SparsePoints(**{key: stored[key] for key in ("xyz", "obs_point", "obs_frame")})
    return Scene(
        static=frames["static"],
        dynamic=frames["dynamic"],
        points=points,
        box_from_world=np.array(meta["box_from_world"], dtype=np.float64),
        aabb=np.array([meta["box"]["min"], meta["box"]["max"]], dtype=np.float64),
        **{
            key: meta[key]
            for key in (
                "near",
                "far",
                "kind",
                "background",
                "t0_s",
                "t1_s",
                "rest_time",
                "image_scale",
                "metric",
            )
        },
    )


def write_transforms(path: Path, frames: tuple[PosedFrame, ...]) -> None:
    """Write nerfstudio's transforms.json: intrinsics per frame, plus `time`, `camera` and `split`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    base = path.parent.resolve()
    rows = []
    for frame in frames:
        camera = frame.camera
        rows.append(
            {
                "file_path": _relative(frame.path, base),
                "transform_matrix": (camera.world_from_cam @ FLIP_YZ).tolist(),
                "camera_model": "OPENCV",
                "w": camera.width,
                "h": camera.height,
                "fl_x": float(camera.K[0, 0]),
                "fl_y": float(camera.K[1, 1]),
                "cx": float(camera.K[0, 2]),
                "cy": float(camera.K[1, 2]),
                **{key: float(value) for key, value in zip(DISTORTION_KEYS, camera.distortion, strict=True)},
                "camera": frame.camera_name,
                "frame_index": frame.index,
                "time_s": frame.time_s,
                "time": frame.time,
                "split": frame.split,
            }
        )
    _write_json(path, {"frames": rows})


def read_transforms(path: Path) -> tuple[PosedFrame, ...]:
    """Read a nerfstudio transforms.json: ours or another program's, global or per-frame intrinsics."""
    meta = _read_json(path)
    model = meta.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise CaptureError(f"{path}: camera_model {model} is not read; expected OPENCV or PINHOLE")
    frames = []
    for number, entry in enumerate(_frames_of(meta, path)):
        file = _existing_picture(path.parent / entry["file_path"])
        camera = _camera_of({**meta, **entry}, file, path)
        time = entry.get("time")
        frames.append(
            PosedFrame(
                path=file,
                camera=camera,
                camera_name=entry.get("camera", "static" if time is None else "camera"),
                index=int(entry.get("frame_index", number)),
                time_s=entry.get("time_s", time),
                time=time,
                split=entry.get("split", "train"),
            )
        )
    return tuple(frames)


def read_dataset(
    dataset_format: DatasetFormat, folder: Path, frame_stride: int = 1, holdout_every: int = 8
) -> Scene:
    """Read a finished data set.

    Args:
        dataset_format: `devrf` (static/ and dynamic_4views/ in Blender's layout), `blender`, `nerfstudio`.
        folder: The data set.
        frame_stride: Every n-th time is used, of test views too.
        holdout_every: Every n-th picture of the scene at rest is held out where the set names no test split.
    Raises:
        CaptureError: The folder is not such a data set, or shows nothing at rest.
    """
    if not folder.is_dir():
        raise CaptureError(f"data set {folder}: no such folder; check dataset.path")
    if dataset_format == "devrf":
        return _read_devrf(folder, frame_stride)
    if dataset_format == "blender":
        static = _read_blender(folder, "train")
        has_test = (folder / "transforms_test.json").is_file()
        static += _read_blender(folder, "test") if has_test else ()
        if len({f.time for f in static}) > 1:
            raise CaptureError(
                f"data set {folder}: every picture is of the scene in motion; a sweep of it at rest is needed"
            )
        static = tuple(
            replace(f, time=None, time_s=None, camera_name="static", index=i) for i, f in enumerate(static)
        )
        return _scene_of(static if has_test else _hold_out(static, holdout_every), (), _background(static[0]))
    frames = read_transforms(folder / "transforms.json")
    static = tuple(f for f in frames if f.time is None)
    dynamic = _every_nth_time(tuple(f for f in frames if f.time is not None), frame_stride)
    if not static:
        raise CaptureError(f"data set {folder}: no picture without a time, so none of the scene at rest")
    if all(f.split == "train" for f in static):
        static = _hold_out(static, holdout_every)
    return _scene_of(static, dynamic, _background(static[0]))


def _read_devrf(folder: Path, frame_stride: int) -> Scene:
    moving = sorted(folder.glob("dynamic_*views"))
    if not moving or not (folder / "static").is_dir():
        raise CaptureError(
            f"data set {folder}: expected the folders static/ and dynamic_4views/ (format devrf)"
        )
    static = [
        replace(f, time=None, time_s=None, camera_name="static")
        for split in ("train", "test")
        for f in _read_blender(folder / "static", split)
    ]
    static = tuple(replace(f, index=i) for i, f in enumerate(static))
    dynamic = tuple(f for split in ("train", "test") for f in _read_blender(moving[0], split))
    return _scene_of(static, _every_nth_time(dynamic, frame_stride), _background(static[0]))


def _read_blender(folder: Path, split: Split) -> tuple[PosedFrame, ...]:
    """One split of a Blender data set: one focal length (`camera_angle_x`), centred principal point.

    Training pictures of one pose are one camera (view1, view2, …); test pictures are numbered per time.
    """
    path = folder / f"transforms_{split}.json"
    meta = _read_json(path)
    entries = _frames_of(meta, path)
    names: dict[bytes, str] = {}
    at_time: Counter[float] = Counter()
    times = sorted({float(e["time"]) for e in entries if "time" in e})
    sizes: dict[str, tuple[int, int]] = {}
    frames = []
    for number, entry in enumerate(entries):
        file = _existing_picture(folder / entry["file_path"])
        if "first" not in sizes:
            sizes["first"] = _picture_size(file)
        width, height = sizes["first"]
        focal = 0.5 * width / np.tan(0.5 * float(meta["camera_angle_x"]))
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        matrix = np.array(entry["transform_matrix"], dtype=np.float64)
        time = float(entry["time"]) if "time" in entry else None
        if split == "train":
            name = names.setdefault(matrix.tobytes(), f"view{len(names) + 1}")
        else:
            at_time[time if time is not None else -1.0] += 1
            name = f"test{at_time[time if time is not None else -1.0]}"
        frames.append(
            PosedFrame(
                path=file,
                camera=Camera(width, height, K, _cam_from_world(matrix, path)),
                camera_name=name,
                index=number if time is None else times.index(time),
                time_s=time,
                time=time,
                split=split,
            )
        )
    return tuple(frames)


def _scene_of(
    static: tuple[PosedFrame, ...], dynamic: tuple[PosedFrame, ...], background: Background
) -> Scene:
    """A loose box around what all cameras look at: centred at the focus of the view axes."""
    cameras = [f.camera for f in static]
    axes = np.stack([c.cam_from_world[2, :3] for c in cameras])
    centres = np.stack([c.centre for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.solve(across.sum(0) + 1e-9 * np.eye(3), (across @ centres[:, :, None]).sum(0)[:, 0])
    distance = np.linalg.norm(centres - focus, axis=1)
    half_angle = np.array([max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2 for c in cameras])
    half_side = float((distance * half_angle).max())
    box_from_world = np.eye(4)
    box_from_world[:3] = np.column_stack([np.eye(3), -focus]) / half_side
    reach = np.sqrt(3) * half_side
    times = [f.time for f in dynamic if f.time is not None]
    return Scene(
        static=static,
        dynamic=dynamic,
        box_from_world=box_from_world,
        aabb=np.array([[-1.0] * 3, [1.0] * 3]),
        near=max(float(distance.min() - reach), 0.02 * half_side) / half_side,
        far=float(distance.max() + reach) / half_side,
        kind="inward" if np.linalg.norm(axes.mean(0)) < 0.85 else "forward",
        background=background,
        t0_s=0.0,
        t1_s=1.0,
        rest_time=min(times) if times else None,
        image_scale=1.0,
    )


def _every_nth_time(frames: tuple[PosedFrame, ...], stride: int) -> tuple[PosedFrame, ...]:
    times = sorted({f.time for f in frames if f.time is not None})
    kept = set(times[::stride])
    return tuple(f for f in frames if f.time in kept)


def _hold_out(frames: tuple[PosedFrame, ...], every: int) -> tuple[PosedFrame, ...]:
    return tuple(replace(f, split="test") if i % every == 0 else f for i, f in enumerate(frames))


def _background(frame: PosedFrame) -> Background:
    """White behind pictures with alpha (the published data sets are composited so), else the surroundings."""
    image = cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED)
    return "white" if image is not None and image.ndim == 3 and image.shape[2] == 4 else "shell"


def _camera_of(entry: dict[str, Any], file: Path, path: Path) -> Camera:
    width, height = int(entry.get("w", 0)), int(entry.get("h", 0))
    if not width or not height:
        width, height = _picture_size(file)
    if "fl_x" not in entry and "camera_angle_x" not in entry:
        raise CaptureError(f"{path}: neither fl_x nor camera_angle_x given for {file.name}")
    fl_x = float(entry["fl_x"] if "fl_x" in entry else 0.5 * width / np.tan(0.5 * entry["camera_angle_x"]))
    K = np.array(
        [
            [fl_x, 0, float(entry.get("cx", width / 2))],
            [0, float(entry.get("fl_y", fl_x)), float(entry.get("cy", height / 2))],
            [0, 0, 1],
        ]
    )
    distortion = np.array([float(entry.get(key, 0.0)) for key in DISTORTION_KEYS])
    matrix = np.array(entry["transform_matrix"], dtype=np.float64)
    return Camera(width, height, K, _cam_from_world(matrix, path), distortion)


def _cam_from_world(matrix: Float[np.ndarray, "rows 4"], path: Path) -> Float[np.ndarray, "3 4"]:
    """OpenGL camera-to-world to OpenCV world-to-camera; rounded rotations are made exact."""
    full = np.vstack([matrix[:3], [0, 0, 0, 1]]) @ FLIP_YZ
    u, s, vt = np.linalg.svd(full[:3, :3])
    if np.abs(s - 1).max() > RIGID_REPAIR:
        raise CaptureError(f"{path}: transform_matrix is not rigid (singular values {s.tolist()})")
    R = (u @ vt).T
    return np.column_stack([R, -R @ full[:3, 3]])


def _frames_of(meta: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    entries = meta.get("frames")
    if not entries:
        raise CaptureError(f"{path}: no frames listed")
    return entries


def _existing_picture(file: Path) -> Path:
    """The file itself, or with .png or .jpg added (Blender's layout names pictures without extension)."""
    for candidate in (file, file.with_name(file.name + ".png"), file.with_name(file.name + ".jpg")):
        if candidate.is_file():
            return candidate.resolve()
    raise CaptureError(f"{file}: picture not found (nor with .png or .jpg added)")


def _picture_size(file: Path) -> tuple[int, int]:
    from PIL import Image

    with Image.open(file) as image:
        return image.size


def _relative(path: Path, base: Path) -> str:
    """`path` relative to `base`, so that a run folder can be moved together with its pictures."""
    return Path(os.path.relpath(path.resolve(), base)).as_posix()


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise CaptureError(f"{path}: file not found") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not a JSON file ({error})") from None


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1))
