"""`bench ingest`: speed against plain decoding, memory against length, RAW photos, and what storing pictures costs."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np

from devrf.capture.ingest.ingest import write_frames
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.session import CaptureSession
from devrf.capture.video.reader import VideoReader
from devrf.lab.bench.accuracy.cases import Cases
from devrf.lab.bench.accuracy.ingest_clips import BIT_RATE, film, filmed
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.session.dng import DngTags, mosaic, write_dng

REPETITIONS = 5  # in turns; the fastest of each counts: what else the machine does only slows
SHORT_FRAMES, LONGER = 60, 4
BIT_RATES = {"16 Mbit/s": BIT_RATE, "50 Mbit/s": 50_000_000}  # what phones, and what cameras write at 1080p30
SPEED_GOAL = 0.6
MEMORY_GOAL = 1.05  # a list of times and sharpnesses grows; pictures must not
LOSS_GOAL_DB = 0.1  # a tenth of what a doubling of the bit rate changes
FEW_PHOTOS, MANY_PHOTOS = 4, 12
PHOTO_SIZE, PHOTO_TILES = (750, 1000), 4  # of a piece, and pieces across and down: 12 megapixels
REAL_CLIPS = ("pose2sim_single/videos/cam03.mp4", "pose2sim_single/videos/cam04.mp4")
INGEST_ONE = """
import os, sys, time
from pathlib import Path
from devrf.capture.ingest.ingest import write_frames
from devrf.capture.session import CaptureSession
source, out, cores = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
session = CaptureSession(static=source) if source.is_dir() else CaptureSession(cameras={"cam0": source})
begun = time.perf_counter()
write_frames(session, {}, out, source.parent)
print(time.perf_counter() - begun, Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
"""  # getrusage would tell of the parent's memory too


def speed(cases: Cases) -> list[Row]:
    """Pictures a second of ingest, all of them stored, over those of decoding to RGB by PyAV, in the same run."""
    folder, frames = cases.folder("speed"), LONGER * SHORT_FRAMES
    clips = {f"1080p, {name}": film(folder / f"{rate}.mp4", frames, rate) for name, rate in BIT_RATES.items()}
    if cases.data is not None:
        clips |= {name: clip for name in REAL_CLIPS if (clip := cases.data / name).is_file()}
    rows = []
    for name, clip in clips.items():
        plain, ours = [], []
        for _ in range(REPETITIONS):
            plain.append(_seconds(_decode, clip))
            shutil.rmtree(folder / "ingest", ignore_errors=True)
            ours.append(_seconds(_ingest, clip, folder))
        (plain_s, plain_cpu_s), (ours_s, ours_cpu_s) = np.min([plain, ours], axis=1).tolist()
        spread = float(np.std([p[0] / o[0] for p, o in zip(plain, ours, strict=True)]))
        bytes_ = [p.stat().st_size for p in (folder / "ingest/frames/cam0").iterdir()]
        ratio = Row(f"ingest/{name}, speed over decoding to RGB", plain_s / ours_s, "", spread)
        rows += [
            ratio.at_least(SPEED_GOAL),
            Row(f"ingest/{name}, the same in processor time", plain_cpu_s / ours_cpu_s, ""),
            Row(f"ingest/{name}, decoding to RGB", len(bytes_) / plain_s, "pictures/s"),
            Row(f"ingest/{name}, ingest", len(bytes_) / ours_s, "pictures/s"),
            Row(f"ingest/{name}, stored", float(np.mean(bytes_)) / 1e3, "kB/picture"),
        ]
    return rows


def memory(cases: Cases) -> list[Row]:
    """Peak resident memory of a process that ingests a clip, and one four times as long."""
    folder, few, many = cases.folder("memory"), SHORT_FRAMES, LONGER * SHORT_FRAMES
    short_mb, long_mb = (_apart(film(folder / f"{n}.mp4", n), folder)[1] for n in (few, many))
    more = Row("ingest/peak memory of the longer clip over the shorter one's", long_mb / short_mb, "")
    return [
        Row(f"ingest/1080p, {few} frames, peak memory", short_mb, "MB"),
        Row(f"ingest/1080p, {many} frames, peak memory", long_mb, "MB"),
        more.at_most(MEMORY_GOAL),
    ]


def raw(cases: Cases) -> list[Row]:
    """Folders of RAW photos of 12 megapixels: time on one core and on all, peak memory of few and of many."""
    folder, rng = cases.folder("raw"), np.random.default_rng(0)
    levels = {"black": (512, 512, 512, 512), "white": 16383}
    piece = mosaic(rng.uniform(0.05, 0.8, (*PHOTO_SIZE, 3)), "RGGB", *levels.values())
    write_dng(folder / "photo.dng", np.tile(piece, (PHOTO_TILES, PHOTO_TILES)), DngTags(**levels))
    for count in (FEW_PHOTOS, MANY_PHOTOS):
        for n in range(count):
            shutil.copyfile(folder / "photo.dng", cases.folder(f"raw/{count}") / f"{n}.dng")
    cores = len(os.sched_getaffinity(0))
    one_s, _ = _apart(folder / str(FEW_PHOTOS), folder, cores=1)
    few_s, few_mb = _apart(folder / str(FEW_PHOTOS), folder)
    _, many_mb = _apart(folder / str(MANY_PHOTOS), folder)
    more = Row("ingest/peak memory of more RAW photos over that of few", many_mb / few_mb, "")
    return [
        Row("ingest/RAW of 12 megapixels, one core", one_s / FEW_PHOTOS, "s/photo"),
        Row(f"ingest/RAW of 12 megapixels, {cores} cores", few_s / FEW_PHOTOS, "s/photo"),
        Row(f"ingest/{FEW_PHOTOS} RAW photos, peak memory", few_mb, "MB"),
        Row(f"ingest/{MANY_PHOTOS} RAW photos, peak memory", many_mb, "MB"),
        more.at_most(MEMORY_GOAL),
    ]


def quality(cases: Cases) -> list[Row]:
    """How far pictures are from what was filmed: decoded, and decoded and stored; and the flow between them."""
    folder = cases.folder("quality")
    clip = film(folder / "short.mp4", SHORT_FRAMES)
    _ingest(clip, folder)
    scores, flow_px = [], []
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    last: tuple[np.ndarray, np.ndarray] | None = None
    with VideoReader(clip) as reader:
        for truth, frame in zip(filmed(SHORT_FRAMES), reader, strict=True):
            rgb, stored = frame.rgb, read_pixels(folder / f"ingest/frames/cam0/{frame.index:06d}.jpg")
            scores.append((cv2.PSNR(rgb, truth), cv2.PSNR(stored, truth), cv2.PSNR(stored, rgb)))
            greys = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY)
            if last is not None and frame.index % 10 == 0:
                a, b = (flow.calc(now, before, None) for now, before in zip(greys, last, strict=True))  # type: ignore
                flow_px.append(np.linalg.norm(a - b, axis=-1).mean())
            last = greys
    decoded_db, stored_db, between_db = np.mean(scores, axis=0).tolist()
    apart = "ingest/1080p, flow of stored against flow of decoded pictures, mean"
    return [
        Row("ingest/1080p, decoded against what was filmed", decoded_db, "dB"),
        Row("ingest/1080p, stored against what was filmed", stored_db, "dB"),
        Row("ingest/1080p, loss by storing", decoded_db - stored_db, "dB").at_most(LOSS_GOAL_DB),
        Row("ingest/1080p, stored against decoded", between_db, "dB"),
        Row(apart, float(np.mean(flow_px)), "px"),
    ]


def _decode(clip: Path) -> None:
    """What anyone writes who wants RGB pictures, with all threads."""
    with av.open(str(clip)) as container:
        container.streams.video[0].thread_type = "AUTO"
        for frame in container.decode(video=0):
            frame.to_ndarray(format="rgb24")


def _ingest(clip: Path, folder: Path) -> None:
    write_frames(CaptureSession(cameras={"cam0": clip}), {}, folder / "ingest", folder)


def _apart(source: Path, folder: Path, cores: int = 1024) -> tuple[float, float]:
    """Seconds and peak memory (MB) of a process that ingests a clip or a folder on at most `cores` cores."""
    out = folder / "ingest"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-c", INGEST_ONE, str(source), str(out), str(cores)]
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, kibibytes = said.stdout.split()
    return float(seconds), int(kibibytes) * 1024 / 1e6


def _seconds(work: Callable[..., None], *arguments: Path) -> tuple[float, float]:
    """Seconds on the clock, and of processors."""
    clock, used = time.perf_counter(), time.process_time()
    work(*arguments)
    return time.perf_counter() - clock, time.process_time() - used
