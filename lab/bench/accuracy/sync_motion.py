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
from devrf.calibration.truth import Truth, compare_clocks, read_truth
from devrf.capture.camera import Camera
from devrf.capture.frames import FrameSet
from devrf.capture.ingest.ingest import read_motion, write_frames
from devrf.capture.session import CaptureSession
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.video_writer import write_video
from devrf.lab.bench.accuracy.cases import Cases, not_there
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.session.simulate_session import simulate_session
from devrf.pipelines.stages.scene.clock_check import timed_pictures
from devrf.pipelines.stages.sync import used_times

TRUTH = "ground_truth.json"
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


def motion(cases: Cases) -> list[Row]:
    """Largest errors of clocks: by motion energies alone, and with cameras known."""
    rows: list[Row] = []
    for scene, seed in SESSIONS:
        folder = cases.folder("motion") / f"{scene}_{seed}"
        if not (folder / TRUTH).is_file():
            simulate_session(folder, Simulation(scene, 4, seed, SIZE, OPTIONS))
        title = f"sync/motion, simulated {scene} (seed {seed})"
        truth = read_truth(folder / TRUTH)
        rows += _measured(title, folder, _true_cameras(folder), truth, SIMULATED_GOAL_MS)
    capture = cases.real("pose2sim_single")
    if capture is None:
        return [*rows, not_there("sync/motion, real", "ms", "pose2sim_single")]
    found = find_calibration(capture / "calibration" / "Calib.qca.txt").cameras
    for title, (stride, starts) in COPIES.items():
        folder = cases.folder(f"motion/pose2sim_{stride}")
        cameras, clocks = {}, {}
        for (name, lens), start in zip(found.items(), starts, strict=True):
            assert lens.cam_from_world is not None
            size = write_copy(capture / "videos" / f"{name}.mp4", folder, start, stride)
            K = np.diag([REAL_SCALE, REAL_SCALE, 1.0]) @ lens.K  # the clips miss some columns on the right
            cameras[name] = Camera(*size, K, lens.cam_from_world, lens.distortion)
            clocks[name] = Clock((start - starts[0]) / REAL_FPS, 0.0)
        goal_ms = 1e3 * stride / REAL_FPS / 2
        rows += _measured(f"sync/motion, real, {title}", folder, cameras, Truth({}, {}, clocks), goal_ms)
    return rows


def _measured(
    title: str, folder: Path, cameras: dict[str, Camera], truth: Truth, goal_ms: float
) -> list[Row]:
    """Largest error of all clocks but the first."""
    session = CaptureSession(cameras={n: folder / f"{n}.mp4" for n in cameras})
    ingest = folder / "ingest"
    frames: FrameSet = write_frames(session, {}, ingest, folder)
    energies = read_motion(ingest, frames)
    spans = {n: (float(t[0]), float(t[-1])) for n, c in frames.moving.items() if len(t := used_times(c))}
    alone = synchronise(spans, {}, energies).cameras
    views = timed_pictures(ingest, frames.moving, cameras, alone, energies)
    known = refined(alone, check_clocks(views, alone))

    def row(how: str, clocks: dict[str, Clock]) -> Row:
        off = compare_clocks(truth, clocks, spans)
        worst = max((e for n, e in off.items() if n != next(iter(clocks))), default=None)
        return Row(f"{title}, {how}, largest", worst, "ms", anchor=VISUALSYNC_MS, source=VISUALSYNC)

    return [row("energies alone", alone), row("cameras known", known).at_most(goal_ms)]


def _true_cameras(folder: Path) -> dict[str, Camera]:
    truth = json.loads((folder / TRUTH).read_text())
    cameras = {}
    for name, entry in truth["cams"].items():
        K = np.array(entry["K"])
        K[:2, 2] += 0.5  # the file has OpenCV's centres
        pose = np.linalg.inv(np.array(entry["pose"]))[:3]
        lens = np.array([entry["k1"], 0, 0, 0, 0])
        cameras[name] = Camera(truth["width"], truth["height"], K, pose, lens)
    return cameras


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
