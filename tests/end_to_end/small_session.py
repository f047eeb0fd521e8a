"""A session that takes seconds: the example at half its size, a third of its sweep, two of its cameras."""

import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import yaml

from devrf.capture.photos.picture_files import write_png

VIEWS = 24  # of the sweep, spread evenly over the example's
CAMERAS = ("cam0", "cam2")
WITNESS = "witness"
SETTINGS = {
    "image_scale": 0.5,
    "resolution": 48,
    "rays": 1024,
    "canonical_iterations": 150,
    "motion_iterations": 20,
    "key_times": 6,
}


def write_small_session(example: Path, folder: Path) -> Path:
    """Write scene.yaml, the sweep's pictures, the clips and the truth.

    Args:
        example: Folder of the example session.
        folder: Where to write.
    Returns:
        scene.yaml.
    """
    (folder / "static").mkdir(parents=True)
    truth = json.loads((example / "ground_truth.json").read_text())
    step = len(truth["static"]) // VIEWS
    with av.open(str(example / "static.mp4")) as container:
        for n, frame in enumerate(container.decode(video=0)):
            if n % step == 0:
                write_png(folder / "static" / f"{n:03d}.png", _half(frame))
    for name in (*CAMERAS, WITNESS):
        _write_clip(example / f"{name}.mp4", folder / f"{name}.mp4")
    truth["static"] = truth["static"][::step]
    truth["width"], truth["height"] = truth["width"] // 2, truth["height"] // 2
    half = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])  # the centre of the first pixel is at 0
    truth["K"] = (half @ truth["K"]).tolist()
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    scene = {
        "name": "small",
        "output": "run",
        "preset": "tiny",
        "capture": {
            "static": "static",
            "cameras": {name: f"{name}.mp4" for name in CAMERAS},
            "test_cameras": {WITNESS: f"{WITNESS}.mp4"},
            "rest": "start",
        },
        "reconstruct": SETTINGS,
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return folder / "scene.yaml"


def _half(frame: av.VideoFrame) -> np.ndarray:
    return cv2.resize(frame.to_ndarray(format="rgb24"), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _write_clip(source: Path, target: Path) -> None:
    """Every second picture of a clip at half its size, its sound as it is."""
    with av.open(str(source)) as whole, av.open(str(target), "w") as part:
        video = part.add_stream("libx264", rate=8, options={"crf": "14"})
        sound = part.add_stream_from_template(whole.streams.audio[0])
        video.width, video.height = whole.streams.video[0].width // 2, whole.streams.video[0].height // 2
        video.time_base = video.codec_context.time_base = Fraction(1, 90_000)
        number = -1
        for packet in whole.demux():
            if packet.stream.type == "audio":
                if packet.dts is not None:
                    packet.stream = sound
                    part.mux(packet)
                continue
            for frame in packet.decode():
                number += 1
                if number % 2:
                    continue
                small = av.VideoFrame.from_ndarray(_half(frame), format="rgb24")
                small.pts, small.time_base = round(frame.time * 90_000), Fraction(1, 90_000)
                part.mux(video.encode(small))
        part.mux(video.encode(None))
