"""Files of every kind that a user can hand in, whole, each with the way in that reads it."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import yaml
from PIL import Image
from tests.faults.mutations import BINARY, JSON, TEXT, Mutation
from tests.make.datasets import write_set
from tests.make.rigs import RIG_LAYOUTS

from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, write_rig
from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.video.video_writer import write_video
from devrf.flow.store import write_pair

SIZE = (96, 72)
FRAMES = 12
REAL_PACKETS = 12  # of a real clip
RUN, DRY = (0, 1, 2, 3), (0, 2)


@dataclass(frozen=True)
class Target:
    """A file to damage.

    Attributes:
        file: The file.
        mutations: What fits its kind.
        scene: Folder with the scene.yaml that names it; None for a reader.
        arguments: After the command and the folder.
        command: Of `devrf-pipeline`.
        template: Run folder that lies there before each case, and holds the file.
        reader: Name of a reader, where there is no scene.
        allowed: Exit codes.
        named: An error says one of these words: the file's name, or that of what it is.
    """

    file: Path
    mutations: tuple[Mutation, ...]
    scene: Path | None = None
    arguments: tuple[str, ...] = ()
    command: str = "run"
    template: Path | None = None
    reader: str = ""
    allowed: tuple[int, ...] = RUN
    named: Sequence[str] = field(default_factory=tuple)


def targets(folder: Path, odd_scene: Scene, repository: Path, data: Path) -> dict[str, Target]:
    """Make the files, some of them of the real captures in `data`."""
    out: dict[str, Target] = {}
    _clips(folder / "clips", repository, data, out)
    _photos(folder / "photos", data, out)
    _tables(folder, out)
    _data_sets(folder / "sets", odd_scene, out)
    _calibrations(folder / "rigs", data, out)
    _models(folder / "models", out)
    _small_files(folder / "small", repository, data, out)
    _other_commands(folder / "other", out)
    return out


def pictures(count: int = FRAMES) -> list[np.ndarray]:
    """Texture that wanders."""
    rng = np.random.default_rng(1)
    wide = cv2.resize(rng.integers(0, 255, (20, 40, 3)).astype(np.uint8), (SIZE[0] + 60, SIZE[1]))
    return [np.ascontiguousarray(wide[:, 3 * n : 3 * n + SIZE[0]]) for n in range(count)]


def scene_yaml(folder: Path, **keys: Any) -> Path:
    """A folder with a scene.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.yaml").write_text(
        yaml.safe_dump({"name": "x", "output": "run", "preset": "tiny", **keys})
    )
    return folder


def _clips(folder: Path, repository: Path, data: Path, out: dict[str, Target]) -> None:
    folder.mkdir(parents=True)
    write_video(folder / "static.mp4", pictures(), 10.0)
    made = {"mp4": ("libx264", "aac"), "mkv": ("libx264", "pcm_s16le"), "avi": ("mpeg4", "mp3"),
            "ts": ("mpeg2video", "mp2"), "mov": ("mjpeg", "pcm_s16be"), "webm": ("libvpx", "libopus")}  # fmt: skip
    for ending, codecs in made.items():
        _encode(folder / f"made.{ending}", *codecs)
    real = {
        "example": repository / "examples/workshop/cam0.mp4",
        "webcam": data / "caliscope_charuco_calibration/calibration/extrinsic/cam_0.mp4",
        "qualisys": data / "pose2sim_single/videos/cam01.mp4",
    }
    for name, source in real.items():
        _cut(source, folder / f"{name}.mp4")
    for name in (*(f"made.{ending}" for ending in made), *(f"{name}.mp4" for name in real)):
        capture = {"static": "../static.mp4", "cameras": {"damaged": f"../{name}"}}
        scene = scene_yaml(folder / name.replace(".", "_"), capture=capture)
        arguments = ("--until", "ingest", "--set", "calibration.sync.method=auto")
        out[f"clip {name}"] = Target(folder / name, BINARY, scene, arguments, named=(name, "damaged"))


def _encode(path: Path, video_codec: str, audio_codec: str) -> None:
    rng, rate = np.random.default_rng(2), 48_000
    with av.open(str(path), "w") as container:
        video = container.add_stream(video_codec, rate=10 if video_codec != "mpeg2video" else 25)
        video.width, video.height = SIZE
        video.pix_fmt = "yuvj420p" if video_codec == "mjpeg" else "yuv420p"
        audio = container.add_stream(audio_codec, rate=rate, layout="mono")
        for picture in pictures():
            container.mux(video.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(video.encode(None))
        samples = rng.integers(-20_000, 20_000, (1, rate)).astype(np.int16)
        block = av.AudioFrame.from_ndarray(samples, format="s16", layout="mono")
        block.sample_rate = rate
        for resampled in av.AudioResampler(audio.codec_context.format, "mono", rate).resample(block):
            size = audio.codec_context.frame_size or resampled.samples
            values = resampled.to_ndarray()
            for at in range(0, values.shape[1] - size + 1, size):
                values_of_piece: Any = np.ascontiguousarray(values[:, at : at + size])
                piece = av.AudioFrame.from_ndarray(values_of_piece, resampled.format.name, "mono")
                piece.sample_rate, piece.pts = rate, at
                container.mux(audio.encode(piece))
        container.mux(audio.encode(None))


def _cut(source: Path, path: Path) -> None:
    """The first pictures of a real clip, as they were coded."""
    with av.open(str(source)) as reader, av.open(str(path), "w") as writer:
        stream = reader.streams.video[0]
        copy = writer.add_stream_from_template(stream)
        for n, packet in enumerate(reader.demux(stream)):
            if n >= REAL_PACKETS or packet.dts is None:
                break
            packet.stream = copy
            writer.mux(packet)


def _photos(folder: Path, data: Path, out: dict[str, Target]) -> None:
    """A sweep of photos, one of which is damaged."""

    def sweep(name: str, files: Sequence[Path]) -> Path:
        scene = scene_yaml(folder / name, capture={"static": "photos"})
        (scene / "photos").mkdir()
        for n, file in enumerate(files):
            shutil.copy(file, scene / "photos" / f"{n}{file.suffix}")
        (scene / "photos" / f"0{files[0].suffix}").rename(scene / "photos" / f"damaged{files[0].suffix}")
        return scene

    plain = folder / "plain"
    plain.mkdir(parents=True)
    image = Image.fromarray(pictures()[0])
    exif = image.getexif()
    exif[0x0112], exif[0x010F], exif[0x0110] = 6, "Maker", "Model"
    exif.get_ifd(0x8769).update({0xA405: 35, 0x829A: 0.01, 0x8827: 200, 0x829D: 2.8})
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 1.0, 2.0), 3: "E", 4: (2.0, 3.0, 4.0), 6: 100.0})
    image.save(plain / "a.jpg", exif=exif)
    image.convert("RGBA").save(plain / "a.png")
    image.save(plain / "a.tif", compression="tiff_lzw")
    image.save(plain / "a.webp")
    image.save(plain / "a.bmp")
    cv2.imwrite(str(plain / "deep.png"), np.asarray(image)[..., ::-1].astype(np.uint16) * 257)
    kinds: dict[str, list[Path]] = {p.name: [p] * 6 for p in sorted(plain.iterdir())}
    kinds["real.jpg"] = sorted((data / "fox_static/images").glob("*.jpg"))[:4]
    kinds["real.kdc"] = [data / "raw/RAW_KODAK_DC50.KDC"] * 4
    for name, files in kinds.items():
        scene = sweep(name.replace(".", "_"), files)
        damaged = next((scene / "photos").glob("damaged*"))
        out[f"photo {name}"] = Target(
            damaged, BINARY, scene, ("--until", "ingest"), named=("damaged", "photos")
        )


def _tables(folder: Path, out: dict[str, Target]) -> None:
    rows = [f"{name},{n},{n / 10:.4f}" for name in ("cam0", "cam1") for n in range(FRAMES)]
    clips = {
        "static": "../clips/static.mp4",
        "cameras": {"cam0": "../clips/made.mp4", "cam1": "../clips/made.mkv"},
    }
    scene = scene_yaml(folder / "table", capture={**clips, "timestamps": "times.csv"})
    (scene / "times.csv").write_text("\n".join(["camera,frame_index,time_s", *rows]))
    named = ("times.csv", "timestamps", "cam0", "cam1", "sync")
    arguments = ("--until", "sync", "--set", "calibration.sync.method=timestamps")
    out["timestamps"] = Target(scene / "times.csv", TEXT, scene, arguments, named=named)


def _data_sets(folder: Path, odd_scene: Scene, out: dict[str, Target]) -> None:
    files = {  # of each format: a file, or the last of a pattern; how it is damaged; what it is called
        "nerfstudio": [
            ("transforms.json", JSON, "transforms.json"), ("images/static/000000.png", BINARY, "picture"),
        ],
        "devrf": [
            ("dynamic_2views/transforms_train.json", JSON, "transforms_train.json"),
            ("dynamic_2views/train_flow/*.npz", BINARY, "flow"),
        ],
        "blender": [("transforms_train.json", JSON, "transforms_train.json")],
        "llff": [("poses_bounds.npy", BINARY, "poses_bounds.npy")],
        "colmap": [(f"sparse/0/{part}.bin", BINARY, part) for part in ("cameras", "images", "points3D")],
    }  # fmt: skip
    for name, found in files.items():
        scene = scene_yaml(folder / name, dataset={"format": name, "path": "set"})
        write_set(name, odd_scene, scene / "set")
        for pattern, mutations, title in found:
            file = sorted((scene / "set").glob(pattern))[-1]
            named = (file.name, name, "dataset")
            out[f"{name} {title}"] = Target(file, mutations, scene, ("--until", "scene"), named=named)
    _model_as_text(folder, out)


def _model_as_text(folder: Path, out: dict[str, Target]) -> None:
    """COLMAP's text form of the cameras and images, keypoints left out."""
    from devrf.capture.formats.colmap.colmap_model import read_model

    scene = scene_yaml(folder / "colmap_text", dataset={"format": "colmap", "path": "set"})
    shutil.copytree(folder / "colmap" / "set", scene / "set")
    place = scene / "set" / "sparse" / "0"
    model = read_model(place)
    cameras = [
        f"{n} {c.model} {c.width} {c.height} {' '.join(map(repr, c.params))}"
        for n, c in model.cameras.items()
    ]
    images = [
        f"{n} {' '.join(repr(float(v)) for v in (*i.quat_wxyz, *i.translation))} {i.camera_id} {i.name}\n"
        for n, i in model.images.items()
    ]
    for file in place.glob("*.bin"):
        file.unlink()
    (place / "cameras.txt").write_text("\n".join(["# cameras", *cameras]))
    (place / "images.txt").write_text("\n".join(["# images", *images]))
    for name in ("cameras.txt", "images.txt"):
        out[f"colmap {name}"] = Target(
            place / name, TEXT, scene, ("--until", "scene"), named=(name, "colmap", "dataset")
        )


def _calibrations(folder: Path, data: Path, out: dict[str, Target]) -> None:
    """Given rigs, in every format."""
    folder.mkdir()
    cameras = {}
    for n, name in enumerate(("cam0", "cam1")):
        pose = np.array([[1, 0, 0, 0.3 * n], [0, 1, 0, 0], [0, 0, 1, 2.0]])
        K = np.array([[90.0, 0, SIZE[0] / 2], [0, 90.0, SIZE[1] / 2], [0, 0, 1]])
        cameras[name] = Camera(*SIZE, K, pose, np.array([-0.1, 0.01, 0.0, 0.0, 0.0]))
    clips = {"cam0": "../../clips/made.mp4", "cam1": "../../clips/made.mkv"}
    for name, write in RIG_LAYOUTS.items():
        place = scene_yaml(folder / name)
        (place / "given").mkdir()
        write(place / "given", cameras, True)
        files = sorted(p for p in (place / "given").rglob("*") if p.is_file())
        given = "given" if len(files) > 1 else f"given/{files[0].name}"
        scene_yaml(place, capture={"cameras": clips}, calibration={"rig": {"given": given}})
        for file in files[:2]:
            mutations = BINARY if file.suffix == ".bin" else TEXT
            named = (file.name, "given", "camera")
            arguments = ("--dry-run", "--until", "flow")
            out[f"{name} {file.name}"] = Target(file, mutations, place, arguments, allowed=DRY, named=named)
    write_rig(folder / "rig.json", Rig({n: RigCamera(c, "given") for n, c in cameras.items()}, ARBITRARY))
    out["rig.json"] = Target(folder / "rig.json", JSON, reader="rig", named=("rig.json",))
    real = {"qualisys": "pose2sim_single/calibration/Calib.qca.txt",
            "stereo": "opencv_stereo_chessboard/intrinsics.yml",
            "caliscope": "caliscope_charuco_calibration/camera_array.toml"}  # fmt: skip
    for name, source in real.items():
        file = folder / Path(source).name
        file.write_bytes((data / source).read_bytes())
        out[f"calibration {name}"] = Target(file, TEXT, reader="calibration", named=(file.name,))


def _models(folder: Path, out: dict[str, Target]) -> None:
    from tests.make.models import random_model

    from devrf.reconstruct.storage.checkpoint import Checkpoint, Saved
    from devrf.reconstruct.storage.model_io import save_motion, save_rest
    from devrf.reconstruct.storage.training_log import TrainingLog

    folder.mkdir()
    model = random_model()
    assert model.motion is not None
    save_rest(folder / "rest.safetensors", model.rest)
    save_motion(folder / "motion.safetensors", model.motion, model.rest.canonical.voxel)
    saved = Saved(7, {"a": model.motion.aabb}, {"level": 1, "log": TrainingLog("cpu", 10).state()})
    Checkpoint(folder / "checkpoint.safetensors", "fuzz").write(saved)
    for name in ("rest", "motion", "checkpoint"):
        file = folder / f"{name}.safetensors"
        out[f"model {name}"] = Target(file, BINARY, reader=name, named=(file.name,))


def _small_files(folder: Path, repository: Path, data: Path, out: dict[str, Target]) -> None:
    folder.mkdir()
    steps = np.linspace(-3, 3, 48 * 64 * 2, dtype=np.float32).reshape(48, 64, 2)
    write_pair(folder / "000001.npz", steps, np.full((48, 64), 9, np.uint8), {"a": 1})
    np.savez_compressed(folder / "flow.npz", flow=steps, mask=np.ones((48, 64), bool))
    shutil.copy(repository / "examples/workshop/ground_truth.json", folder / "truth.json")
    cv2.imwrite(str(folder / "matte.png"), np.full((48, 64), 255, np.uint8))
    shutil.copyfile(data / "weights/raft-small.pth", folder / "raft.pth")
    (folder / "lpips").mkdir()
    for file in (data / "weights" / "lpips_ref").glob("*.pth"):
        shutil.copyfile(file, folder / "lpips" / file.name)
    shutil.copyfile(data / "weights/lpips_alex_v0.1.npz", folder / "lpips" / "lpips_alex_v0.1.npz")
    whole = {"pair": "000001.npz", "flow": "flow.npz", "truth": "truth.json", "matte": "matte.png",
             "raft": "raft.pth", "lpips": "lpips/lpips_alex_v0.1.npz"}  # fmt: skip
    for reader, name in whole.items():
        file = folder / name
        mutations = JSON if file.suffix == ".json" else BINARY
        out[f"file {reader}"] = Target(file, mutations, reader=reader, named=(file.name, "LPIPS", "lpips"))


def _other_commands(folder: Path, out: dict[str, Target]) -> None:
    """The same files by way of `check` and `init`; a run folder's own, by `status`, `report` and the next run."""
    for name in ("clip made.mp4", "clip made.ts", "clip example.mp4", "photo a.jpg"):
        out[f"check {name}"] = replace(out[name], command="check", arguments=())
    card = folder / "card"
    card.mkdir(parents=True)
    for source in ("made.mp4", "made.mkv"):
        shutil.copy(folder.parent / "clips" / source, card)
    out["init clip"] = Target(
        card / "made.mkv", BINARY, card, ("--force",), "init", named=("made.mkv", "card")
    )
    capture = {"static": "static.mp4", "cameras": {"cam0": "cam0.mp4"}}
    scene = scene_yaml(folder / "run", capture=capture, calibration={"sync": {"method": "none"}})
    for name, source in (("static", "static.mp4"), ("cam0", "made.mp4")):
        shutil.copy(folder.parent / "clips" / source, scene / f"{name}.mp4")
    line = [sys.executable, "-m", "devrf.pipelines.cli.main", "run", str(scene), "--until", "sync", "--quiet"]
    subprocess.run(line, check=True, timeout=120)
    template = (scene / "run").rename(folder / "template")
    again = ("--until", "sync")
    for file, command, arguments in (
        ("ingest/stamp.json", "status", ()), ("ingest/stamp.json", "run", again), ("ingest/ingest.json", "run", again),
        ("ingest/health.json", "report", ()), ("ingest/ingest.json", "report", ()), ("sync/sync.json", "report", ()),
        ("events.jsonl", "run", again), (".digests.json", "run", again),
    ):  # fmt: skip
        if (template / file).is_file():
            path = template / file
            out[f"{command} {file}"] = Target(path, JSON if path.suffix == ".json" else TEXT, scene, arguments, command,
                                              template, named=(path.name, "ingest", "sync"))  # fmt: skip
