"""A run folder with every artifact, written without a run: what the tests of the report read."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.colour.correction import Look
from devrf.capture.formats import write_scene
from devrf.capture.scene import PosedFrame, Scene
from devrf.flow.store import BEST, pair_path, write_pair
from devrf.pipelines.stages import stage_names

NASTY = "<script>alert('x')</script> & \"friends\""
WIDTH, HEIGHT = 48, 36


def write_run(run: Path) -> None:
    """Write a run folder with every artifact, as docs/formats.md describes them."""
    rng = np.random.default_rng(0)
    cameras = {"static": 6, "cam0": 4, "wit<b>ness": 4}
    frames: dict[str, list[Path]] = {}
    for name, count in cameras.items():
        folder = run / "ingest" / "frames" / name
        folder.mkdir(parents=True)
        frames[name] = [folder / f"{n:06d}.png" for n in range(count)]
        for path in frames[name]:
            cv2.imwrite(str(path), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    write_json(
        run / "ingest/ingest.json",
        {
            "cameras": {
                name: {
                    "role": "sweep" if name == "static" else "camera",
                    "source": f"raw/{name}.mp4",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "fps_mean": 29.97,
                    "variable_rate": name == "cam0",
                    "has_audio": True,
                    "exif_focal_px": None,
                    "rotation_deg": 0,
                    "frames": [
                        {"index": n, "time_s": n / 30, "sharpness": 1.0, "used": True,
                         "file": f"frames/{name}/{n:06d}.png"}
                        for n in range(count)
                    ],
                    "notes": [NASTY],
                }
                for name, count in cameras.items()
            }
        },
    )  # fmt: skip
    write_json(
        run / "static_poses/static_poses.json",
        {"registered": 6, "given": 7, "mean_reprojection_px": 0.512, "mean_track_length": 4.2,
         "median_triangulation_angle_deg": 8.5, "points": 3, "models": [6], "mapper": "incremental",
         "frames": {}, "cameras": {}, "unregistered": ["static/000006.png"]},
    )  # fmt: skip
    points = struct.pack("<Q", 3)
    for n in range(3):
        points += struct.pack("<QdddBBBdQ", n, n, 0.0, 1.0, 9, 8, 7, 0.3, 0)
    (run / "static_poses/colmap").mkdir()
    (run / "static_poses/colmap/points3D.bin").write_bytes(points)
    write_scene(run / "scene", _scene(frames))
    write_json(
        run / "rig/rig.json",
        {
            "cameras": {
                "cam0": {"model": "OPENCV", "K": [[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]],
                         "distortion": [0] * 5, "width": WIDTH, "height": HEIGHT,
                         "std": {"rotation_deg": 0.031, "position": 0.0021},
                         "intrinsics": "board", "inliers": 321, "rms_px": 0.25}
            },
            "scale": {"metric": True, "source": "board", "factor": 2.0, "std": 0.004},
        },
    )  # fmt: skip
    write_json(
        run / "sync/sync.json",
        {
            "cameras": {
                "cam0": {"offset_s": 0.0, "drift_ppm": 0.0, "std_s": 0.0, "method": "reference",
                         "confidence": 1.0, "basis": "the reference"},
                "wit<b>ness": {"offset_s": -0.125, "drift_ppm": 23.5, "std_s": 0.00025, "method": "audio",
                               "confidence": 0.97, "basis": NASTY},
            },
            "reference": "cam0", "loop_s": None, "notes": [],
        },
    )  # fmt: skip
    curve = {
        "first": "cam0",
        "second": "wit<b>ness",
        "method": "audio",
        "delay_s": -0.125,
        "quality": 9.0,
        "accepted": True,
        "lags_s": [-0.25, -0.125, 0.0, 0.125],
        "values": [0.0, 1.0, 0.1, 0.0],
    }
    write_json(run / "sync/curves.json", {"curves": [curve]})
    for stage in ("canonical", "deformation"):
        rows = [
            {"iteration": n, "seconds": n, "level": n // 2, "psnr": 20.0 + n, "mse": 0.01 / (n + 1)}
            for n in range(4)
        ]
        write_json(run / stage / "metrics.json", {"seconds": 100.5, "iterations": 4, "curve": rows})
    flow = np.zeros((3, HEIGHT, WIDTH, 2), np.float32)
    flow[1, 5:20, 5:20] = (3.0, -1.0)
    valid = np.ones((3, HEIGHT, WIDTH), bool)
    for n in range(3):
        write_pair(pair_path(run / "flow", "cam0", n + 1), flow[n], BEST * valid[n].astype(np.uint8), {})
    write_json(
        run / "flow/flow.json",
        {"method": "dis", "cameras": {"cam0": {"pairs": 3, "gaps": 0, "supported": 0.9, "valid": 0.81,
                                               "moving": 0.1, "moving_valid": 0.7, "round_trip_px": 0.2,
                                               "warp_ratio": 0.4, "large": 0.0}}},
    )  # fmt: skip
    _write_evaluate(run, rng)
    (run / "render").mkdir()
    (run / "render/orbit.mp4").write_bytes(b"not really a film")
    write_json(
        run / "colour/colour.json",
        {"reference": "static", "total": {"points": 40, "before": 0.0625, "after": 0.015625}, "cameras": {
            "static": {"source": "reference", "kind": "none"},
            "cam0": {"source": "points", "kind": "gain", "stops": -0.375, "fitted": 120,
                     "apart": {"points": 40, "before": 0.0625, "after": 0.015625}},
            "wit<b>ness": {"source": "none", "kind": "none", "stops": 0.125, "fitted": 0,
                           "apart": {"points": 30, "before": 0.03125, "after": 0.03125}}}},
    )  # fmt: skip
    for stage in stage_names():
        if (run / stage).is_dir():
            stamp = {
                "id": f"id-{stage}",
                "run": "night-1",
                "finished": "2026-11-22 23:15:00",
                "seconds": 12.5,
            }
            write_json(run / stage / "stamp.json", stamp | {"identity": {}})
            write_json(run / stage / "health.json", {"stage": stage, "rows": [_row("ok"), _row("warn")]})


def write_json(path: Path, value: object) -> None:
    """Write a file of the run folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def _scene(frames: dict[str, list[Path]]) -> Scene:
    K = np.array([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]])

    def posed(name: str, n: int, split: str, time: float | None) -> PosedFrame:
        pose = np.column_stack([np.eye(3), [0.1 * n, 0.0, 2.0]])
        camera = Camera(WIDTH, HEIGHT, K, pose)
        look = Look(gains=(1.25, 1.25, 1.25)) if name == "cam0" else None
        return PosedFrame(frames[name][n], camera, name, n, time, time, split, look=look)  # type: ignore[arg-type]

    sweep = [posed("static", n, "test" if n == 0 else "train", None) for n in range(6)]
    fixed = [
        posed(name, n, "train" if name == "cam0" else "test", n / 3)
        for name in frames
        if name != "static"
        for n in range(4)
    ]
    return scene_of(sweep, fixed, 2.0, near=0.5, far=6.0, metric=True)


def _write_evaluate(run: Path, rng: np.random.Generator) -> None:
    views = []
    for camera, n, time in [("wit<b>ness", 0, 0.0), ("wit<b>ness", 1, 0.5), ("static", 0, None)]:
        files = {}
        for kind in ("true", "rendered", "error", "rest"):
            path = run / "evaluate" / "views" / camera / f"{n:06d}_{kind}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
            files[kind] = path.relative_to(run / "evaluate").as_posix()
        view = {"camera": camera, "index": n, "time": time, "time_s": time, "psnr": 24.5 + n, "ssim": 0.812}
        if time is not None:
            view["static_baseline"] = {"psnr": 19.25, "ssim": 0.7}
        views.append({**view, **files})
    block = {
        "psnr": 25.0625,
        "ssim": 0.8125,
        "lpips_vgg": None,
        "views": 2,
        "why": {"lpips_vgg": "no weights"},
    }
    write_json(
        run / "evaluate/metrics.json",
        {
            "test": block,
            "test_static": {**block, "psnr": 27.375},
            "test_moving": {"psnr": 22.75, "ssim": 0.75},
            "shading": {"psnr": 22.25, "unshaded_psnr": 21.25, "views": 2},
            "static_baseline": {"test": {"psnr": 21.0}, "test_moving": {"psnr": 17.5}},
            "per_view": views,
            "train": {"canonical_s": 100.5, "deformation_s": 200.25, "total_s": 300.75, "iterations": 1000,
                      "rays_per_s": 12345.6, "peak_gpu_gb": None, "peak_rss_gb": 1.25, "device": "cpu"},
            "model_mb": 12.25,
            "render_fps": 0.125,
            "versions": {"devrf": "0.1.0"},
            "seed": 7,
            "truth": {"pose_rotation_deg": 0.0625, "rig_position_m": 0.0078125, "sync_ms": 0.25},
            "confidence": {"moves": True, "unseen_share": 0.125, "seen_by": [{"cameras": 1, "share": 0.875}]},
        },
    )  # fmt: skip


def _row(verdict: str) -> dict:
    return {"code": "x", "check": f"a check {NASTY}", "value": 0.5, "unit": "px", "warn": 0.4, "fail": None,
            "verdict": verdict, "remedy": "" if verdict == "ok" else "Hold the camera still."}  # fmt: skip
