"""A session that takes seconds: the waving sheet of tests/sheet, two of its cameras, every second of their pictures."""

import shutil
from fractions import Fraction
from pathlib import Path

import av
import yaml

from devrf.capture.photos.picture_files import write_png
from devrf.capture.video.video_writer import X264

SHEET = Path(__file__).resolve().parents[1] / "sheet"
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


def write_small_session(folder: Path) -> Path:
    """Write scene.yaml, the sweep's pictures, the clips and the truth into a folder; the path of scene.yaml."""
    (folder / "static").mkdir(parents=True)
    with av.open(str(SHEET / "static.mp4")) as container:
        for n, frame in enumerate(container.decode(video=0)):
            write_png(folder / "static" / f"{n:03d}.png", frame.to_ndarray(format="rgb24"))
    for name in (*CAMERAS, WITNESS):
        _write_clip(SHEET / f"{name}.mp4", folder / f"{name}.mp4")
    shutil.copyfile(SHEET / "ground_truth.json", folder / "ground_truth.json")
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


def _write_clip(source: Path, target: Path) -> None:
    """Every second picture of a clip, its sound as it is."""
    with av.open(str(source)) as whole, av.open(str(target), "w") as part:
        video = part.add_stream("libx264", rate=8, options={**X264, "crf": "14"})
        sound = part.add_stream_from_template(whole.streams.audio[0])
        video.width, video.height = whole.streams.video[0].width, whole.streams.video[0].height
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
                kept = av.VideoFrame.from_ndarray(frame.to_ndarray(format="rgb24"), format="rgb24")
                kept.pts, kept.time_base = round(frame.time * 90_000), Fraction(1, 90_000)
                part.mux(video.encode(kept))
        part.mux(video.encode(None))
