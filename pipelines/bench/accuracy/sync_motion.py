"""`bench sync`, motion: clips without sound, by motion energies alone and by geometry once cameras are known.

Simulated sessions have offsets of no whole number of frames and clocks that drift. The real clips were filmed
by cameras that are synchronised by hardware; copies of them begin at other frames: whole frames at the full
rate, and every second frame, which shifts by half a frame of the copy.
"""

import json
from pathlib import Path

import cv2
import numpy as np

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.geometry import check_clocks, refined
from devrf.calibration.clocks.sync import synchronise
from devrf.calibration.formats import find_calibration
from devrf.calibration.truth import Clock as TrueClock
from devrf.calibration.truth import Truth, compare_clocks, read_truth
from devrf.capture.camera import Camera
from devrf.capture.frames import FrameSet
from devrf.capture.ingest import read_motion, write_frames
from devrf.capture.session import CaptureSession
from devrf.capture.simulate.session import simulate_session
from devrf.capture.simulate.session_options import SessionOptions
from devrf.capture.video import VideoReader
from devrf.capture.video_writer import write_video
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.rows import Row, with_goal
from devrf.pipelines.clock_check import timed_pictures
from devrf.pipelines.stages.sync import used_times

SESSIONS = (("sheet", 1), ("column", 2), ("sheet", 3))
SIZE = (240, 180)  # a minute or two a session; larger pictures only help
OPTIONS = SessionOptions(
    sweep_frames=2, fps=25, duration_s=4, sound=False, board=False, offset_range_s=0.4, spp=4
)
SIMULATED_GOAL_MS = 3.0
VISUALSYNC_MS = 50.0
VISUALSYNC = "VisualSync (2025): median below 50 ms, on captures of its own, without known cameras"
REAL_FPS = 60.0
REAL_SCALE = 0.5  # of the copies: less to encode
COPIES = {"60 fps, trimmed": (1, (0, 5, 9, 2)), "30 fps, every second frame": (2, (0, 7, 3, 12))}


def rows(cases: Cases) -> list[Row]:
    """Rows about motion."""
    out = []
    for scene, seed in SESSIONS:
        folder = cases.out / "motion" / f"{scene}_{seed}"
        if not (folder / "ground_truth.json").is_file():
            simulate_session(folder, scene, seed=seed, size=SIZE, options=OPTIONS)
        cameras = _true_cameras(folder)
        found = _errors_ms(folder, cameras, read_truth(folder / "ground_truth.json"))
        out += _two_rows(f"sync/motion, simulated {scene} (seed {seed})", found, SIMULATED_GOAL_MS)
    return out + _real(cases)


def _two_rows(name: str, found: tuple[dict[str, float], dict[str, float]], goal_ms: float) -> list[Row]:
    alone, known = (max(errors.values()) if errors else None for errors in found)
    energies = Row(f"{name}, energies alone, largest", alone, "ms", anchor=VISUALSYNC_MS, source=VISUALSYNC)
    geometry = Row(f"{name}, cameras known, largest", known, "ms", anchor=VISUALSYNC_MS, source=VISUALSYNC)
    return [energies, with_goal(geometry, goal_ms, low_is_good=True)]


def _errors_ms(
    folder: Path, cameras: dict[str, Camera], truth: Truth
) -> tuple[dict[str, float], dict[str, float]]:
    """Largest error of each clock but the first by energies alone, and with geometry."""
    session = CaptureSession(cameras={n: folder / f"{n}.mp4" for n in cameras})
    ingest = folder / "ingest"
    frames: FrameSet = write_frames(session, {}, ingest, folder)
    motion = read_motion(ingest, frames)
    spans = {n: (float(t[0]), float(t[-1])) for n, c in frames.moving.items() if len(t := used_times(c))}
    alone = synchronise(spans, {}, motion).cameras
    views = timed_pictures(ingest, frames.moving, cameras, alone, motion)
    known = refined(alone, check_clocks(views, alone))
    return _compare(truth, alone, spans), _compare(truth, known, spans)


def _compare(
    truth: Truth, clocks: dict[str, Clock], spans: dict[str, tuple[float, float]]
) -> dict[str, float]:
    errors = compare_clocks(truth, {n: TrueClock(c.offset_s, c.drift_ppm) for n, c in clocks.items()}, spans)
    return {n: e for n, e in errors.items() if n != next(iter(clocks))}


def _true_cameras(folder: Path) -> dict[str, Camera]:
    truth = json.loads((folder / "ground_truth.json").read_text())
    cameras = {}
    for name, entry in truth["cams"].items():
        K = np.array(entry["K"])
        K[:2, 2] += 0.5  # the file has OpenCV's centres
        pose = np.linalg.inv(np.array(entry["pose"]))[:3]
        lens = np.array([entry["k1"], 0, 0, 0, 0])
        cameras[name] = Camera(truth["width"], truth["height"], K, pose, lens)
    return cameras


def _real(cases: Cases) -> list[Row]:
    capture = cases.real("pose2sim_single")
    if capture is None:
        return [not_there("sync/motion, real", "ms", "pose2sim_single")]
    found = find_calibration(capture / "calibration" / "Calib.qca.txt").cameras
    out = []
    for title, (stride, starts) in COPIES.items():
        folder = cases.out / "motion" / f"pose2sim_{stride}"
        cameras, clocks = {}, {}
        for (name, camera), start in zip(found.items(), starts, strict=True):
            assert camera.cam_from_world is not None and camera.size is not None
            width, height = write_copy(capture / "videos" / f"{name}.mp4", folder, start, stride)
            lens = Camera(*camera.size, camera.K, camera.cam_from_world, camera.distortion)
            cameras[name] = cropped(lens, width, height)
            clocks[name] = TrueClock((start - starts[0]) / REAL_FPS, 0.0)
        errors = _errors_ms(folder, cameras, Truth({}, {}, clocks))
        out += _two_rows(f"sync/motion, real, {title}", errors, 1e3 * stride / REAL_FPS / 2)
    return out


def write_copy(clip: Path, folder: Path, start: int, stride: int) -> tuple[int, int]:
    """Every n-th frame of a clip from `start` on, smaller, its first at file time 0; returns its size."""
    folder.mkdir(parents=True, exist_ok=True)
    with VideoReader(clip) as reader:
        size = (round(reader.info.width * REAL_SCALE), round(reader.info.height * REAL_SCALE))
        pictures = (
            np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            for frame in reader
            if frame.index >= start and (frame.index - start) % stride == 0
        )
        write_video(folder / clip.name, pictures, REAL_FPS / stride)
    return size


def cropped(camera: Camera, width: int, height: int) -> Camera:
    """A calibration of the whole sensor for copies of clips that miss some columns on the right."""
    K = np.diag([REAL_SCALE, REAL_SCALE, 1.0]) @ camera.K
    return Camera(width, height, K, camera.cam_from_world, camera.distortion)
