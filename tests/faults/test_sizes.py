"""Small files that claim to be large: refused by their headers, with the file, the claim and the limit in the message,
and without the memory that they ask for."""

import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib import format as npy
from PIL import Image
from tests.faults.fuzz_material import pictures, scene_yaml
from tests.faults.fuzzing import Fuzzer
from tests.make.clips import film
from tests.refused import refused as raises

from devrf.calibration.formats import find_calibration
from devrf.calibration.rigs.rig import read_rig
from devrf.capture.colour.light_course import LightCourse
from devrf.capture.formats.datasets import read_dataset
from devrf.capture.formats.llff import read_rows
from devrf.capture.formats.parts.files import read_header, read_json
from devrf.capture.formats.parts.flow_files import read_flow_file
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.photos.upright_pictures import probe_picture, read_grey, read_picture
from devrf.capture.system import arrays, durable, limits
from devrf.capture.system.arrays import ArrayError, npz_shapes, read_npy, read_npz
from devrf.capture.system.errors import CaptureError, DevrfError, FlowError, InputError, ReconstructError
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.timestamps import read_timestamps
from devrf.capture.video.video_writer import write_video
from devrf.flow.raft import weights_file
from devrf.flow.raft.weights_file import read_weights
from devrf.pipelines.config.error import ConfigError
from devrf.pipelines.config.text import read_yaml
from devrf.pipelines.stamps.stamp import read_stamp
from devrf.reconstruct.storage.model_io import FORMAT, load_rest

LITTLE_MB = 700  # the libraries, and a few pictures; what these files claim is a hundred times that
WIDE = 60_000


def refused(run: Fuzzer, code: int, *words: str, arguments: tuple[object, ...]) -> None:
    """The command ends with a message, and has taken no memory."""
    outcome = run.command(*[str(a) for a in arguments])
    assert outcome.fault((code,)) is None, (outcome.fault((code,)), outcome.said)
    assert all(word in outcome.said for word in words), outcome.said
    assert outcome.peak_mb < LITTLE_MB


# --- pictures ---


def png(side: int) -> bytes:
    data = bytearray(saved("PNG"))
    data[16:24] = struct.pack(">II", side, side)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def jpeg(side: int) -> bytes:
    data = bytearray(saved("JPEG"))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", side, side)
    return bytes(data)


def tiff(side: int) -> bytes:
    data = bytearray(saved("TIFF"))
    (directory,) = struct.unpack_from("<I", data, 4)
    for n in range(struct.unpack_from("<H", data, directory)[0]):
        at = directory + 2 + 12 * n
        if struct.unpack_from("<H", data, at)[0] in (256, 257):  # ImageWidth, ImageLength
            struct.pack_into("<HII", data, at + 2, 4, 1, side)
    return bytes(data)


def bmp(side: int) -> bytes:
    data = bytearray(saved("BMP"))
    data[18:26] = struct.pack("<ii", side, side)
    return bytes(data)


def saved(kind: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pictures(1)[0]).save(file, kind)
    return file.getvalue()


@pytest.mark.parametrize("make", [png, jpeg, tiff, bmp])
def test_pictures(make: Callable[[int], bytes], tmp_path: Path, run: Fuzzer) -> None:
    """3.6 thousand million pixels in a few kilobytes; a picture of the largest medium format is let in."""
    path = tmp_path / f"bomb.{make.__name__}"
    path.write_bytes(make(WIDE))
    assert path.stat().st_size < 25_000
    for read in (read_pixels, read_picture, read_grey, probe_picture, read_header):
        with raises(
            "picture-too-large", path, "60000x60000", "3600 million", "250 million", kind=CaptureError
        ):
            read(path)
    scene = scene_yaml(tmp_path / "scene", capture={"static": "photos"})
    (scene / "photos").mkdir()
    for name in ("a", "b", "c"):
        (scene / "photos" / f"{name}.{make.__name__}").write_bytes(make(WIDE))
    refused(run, 2, "60000x60000", "photos", arguments=("run", scene, "--dry-run"))
    path.write_bytes(make(14_204))  # 201 million: more than Pillow lets in
    assert read_header(path).width == 14_204


def test_postscript_is_no_picture(tmp_path: Path) -> None:
    """Pillow would call ghostscript."""
    path = tmp_path / "a.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    for read in (read_pixels, read_picture, read_grey, probe_picture, read_header):
        with raises("picture-unreadable", path, kind=CaptureError):
            read(path)


# --- clips ---


def test_a_clip_of_huge_pictures(tmp_path: Path, run: Fuzzer) -> None:
    path = tmp_path / "wide.y4m"
    path.write_bytes(b"YUV4MPEG2 W16000 H16000 F25:1 Ip A1:1 C420jpeg\nFRAME\n" + bytes(1000))
    scene = scene_yaml(tmp_path / "scene", capture={"static": "../wide.y4m"})
    refused(run, 2, "wide.y4m", "16000x16000", "100 million", arguments=("run", scene, "--dry-run"))


def test_a_picture_that_is_huge_only_later(tmp_path: Path) -> None:
    """Motion JPEG has its size in every picture; the header of the file is that of the first."""
    path = film(tmp_path / "grows.avi", pictures(3), "mjpeg", 10, pix_fmt="yuvj420p")
    data = bytearray(path.read_bytes())
    second = data.index(b"\xff\xc0", data.index(b"\xff\xc0") + 2) + 5
    data[second : second + 4] = struct.pack(">HH", 12_000, 12_000)  # ffmpeg alone lets 268 million in
    path.write_bytes(data)
    with VideoReader(path) as reader:
        sizes = [frame.size for frame in reader]
        ended = reader.ended_early
    assert set(sizes) <= {(96, 72)} and ended is not None


def test_times_that_are_years_apart(tmp_path: Path, run: Fuzzer) -> None:
    years_s = [n * 1e6 for n in range(4)]
    film(tmp_path / "years.mkv", pictures(4), rate=10, times_s=years_s, base=Fraction(1, 1000))
    scene = scene_yaml(tmp_path / "scene", capture={"static": "../years.mkv"})
    refused(run, 1, "years.mkv", "14400", "[clip-too-long]", arguments=("run", scene, "--until", "ingest"))


# --- arrays, weights, models ---


def npy_header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue()


def test_arrays_that_claim_a_terabyte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("flow.npy", npy_header((1 << 20, 1 << 18)) + bytes(1000))
        archive.writestr("bomb.npy", npy_header((10_000_000,)) + bytes(40_000_000))
        archive.writestr("code.npy", npy_header((1,), "|O") + b"cos\nsystem\n(S'id'\ntR.")
    with raises("file-damaged", path, "[1048576, 262144]", "1000 bytes", kind=ArrayError):
        read_npz(path, ["flow"])
    with monkeypatch.context() as patch, raises("file-too-large", path, "40 MB", "1 MB", kind=ArrayError):
        patch.setattr(arrays, "ARRAY_BYTES", 1_000_000)
        read_npz(path, ["bomb"])
    with raises("file-damaged", path, "object", kind=ArrayError):
        read_npz(path, ["code"], text=True)
    assert npz_shapes(path, ["flow"]) == [(1 << 20, 1 << 18)]
    plain = tmp_path / "a.npy"
    plain.write_bytes(npy_header((1 << 20, 1 << 18)) + bytes(1000))
    with raises("file-damaged", plain, kind=ArrayError):
        read_npy(plain)
    np.save(plain, np.arange(6.0).reshape(2, 3))
    assert read_npy(plain).shape == (2, 3)


WORDS = np.full((4, 20), "words")


@pytest.mark.parametrize(
    "values", [WORDS, WORDS.astype("S"), np.zeros((4, 20), [("a", "f4")]), np.zeros((4, 20), "M8[s]")]
)
def test_arrays_of_something_else_than_numbers(values: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", flow=values, mask=values)
    readers = [
        lambda: LightCourse.read(tmp_path / "a.npy"),
        lambda: read_rows(tmp_path / "a.npy", 20),
        lambda: read_flow_file(tmp_path / "a.npz"),
        lambda: read_npz(tmp_path / "a.npz"),
    ]
    for read in readers:
        with raises("file-damaged", tmp_path / "a.np", values.dtype, kind=CaptureError):
            read()
    np.savez(tmp_path / "text.npz", words=WORDS)
    assert read_npz(tmp_path / "text.npz", text=True)["words"].tolist() == WORDS.tolist()


def test_weights_that_unpack_to_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.pth"
    torch.save({"a": torch.zeros(1).expand(10**12)}, path)
    with raises("file-damaged", path, "[1000000000000]", kind=FlowError):
        read_weights(path)
    torch.save({"a": torch.zeros(1000)}, path)
    assert isinstance(read_weights(path), dict)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data/1", bytes(50_000_000))
    monkeypatch.setattr(weights_file, "WEIGHT_BYTES", 1_000_000)
    with raises("file-too-large", path, "50 MB", "1 MB", kind=CaptureError):
        read_weights(path)


def test_models_that_claim_more(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    for header in (b"", b'{"a":{"dtype":"F32","shape":[1099511627776],"data_offsets":[0,4398046511104]}}'):
        path.write_bytes(struct.pack("<Q", len(header) or 1 << 60) + header + bytes(16))
        with raises("file-damaged", path, kind=ReconstructError):
            load_rest(path)
    numbers = json.dumps(
        {"format": FORMAT, "kind": "rest", "channels": 10**6, "mlp_width": 10**6, "view_frequencies": 10**6}
    )
    header = json.dumps({"__metadata__": {"devrf": numbers}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    with raises("file-damaged", path, " fit ", kind=ReconstructError):
        load_rest(path)


# --- texts ---


def test_texts_that_are_too_long_or_too_deep(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text('{"frames": ' + "[" * 100_000)
    with raises("file-damaged", path, kind=CaptureError):
        read_json(path)
    with path.open("wb") as file:
        file.truncate(limits.TEXT_BYTES + 1)  # a file with a hole: it takes no disk
    with raises("file-too-large", path, "100 MB", kind=CaptureError):
        read_json(path)
    with raises("file-too-large", path, "100 MB", kind=CaptureError):
        read_timestamps(path, ["cam0"])


@pytest.mark.parametrize(
    ("name", "read", "error"),
    [
        ("transforms.json", lambda path: read_dataset("nerfstudio", path.parent), CaptureError),
        ("cameras.txt", lambda path: read_dataset("colmap", path.parent), CaptureError),
        ("rig.json", read_rig, CaptureError),
        ("camchain.yaml", find_calibration, InputError),
        ("times.csv", lambda path: read_timestamps(path, ["cam0"]), DevrfError),
        ("scene.yaml", read_yaml, ConfigError),
        ("metrics.json", durable.read_json, ValueError),
    ],
)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_not_waited_for(
    name: str, read: Callable, error: type, kind: str, tmp_path: Path
):
    if kind == "pipe":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).symlink_to("/dev/zero")
    for other in {"images.txt", "points3D.txt"} if name == "cameras.txt" else set[str]():
        (tmp_path / other).write_text("")
    with pytest.raises(error):
        read(tmp_path / name)


def test_a_pipe_in_place_of_a_stamp_is_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "stamp.json")
    assert read_stamp(tmp_path) is None


@pytest.mark.full
def test_a_table_beside_clips_that_is_too_long_is_not_used(tmp_path: Path, run: Fuzzer) -> None:
    write_video(tmp_path / "sweep.mp4", pictures(), 10.0)
    write_video(tmp_path / "cam0.mp4", pictures(1) * 12, 10.0)
    with (tmp_path / "times.csv").open("wb") as file:
        file.truncate(limits.TEXT_BYTES + 1)
    refused(run, 0, "times.csv", "100 MB", arguments=("init", tmp_path))


LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))
CALIBRATIONS = {
    "billion laughs": f'<?xml version="1.0"?><!DOCTYPE c [<!ENTITY l0 "ha">{LAUGHS}]><calibration><cameras><camera '
    'serial="&l9;"/></cameras></calibration>',
    "external entity": '<?xml version="1.0"?><!DOCTYPE c [<!ENTITY e SYSTEM "file:///etc/passwd">]><calibration><cameras>'
    '<camera serial="&e;"/></cameras></calibration>',
    "aliases": "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{','.join([f'*{chr(97 + n)}'] * 10)}]\n" for n in range(8))
    + "cam0: {camera_model: pinhole, intrinsics: *i, resolution: *i}\n",
    "yaml, brackets": "%YAML:1.0\ncamera_matrix: " + "[" * 100_000,
    "yaml, indents": "%YAML:1.0\n---\n" + "\n".join(" " * n + "a:" for n in range(3000)),
    "yaml, dashes": "%YAML:1.0\n---\na:\n   " + "- " * 100_000,
    "xml": '<?xml version="1.0"?><opencv_storage>' + "<a>" * 100_000,
    "json": '{"camera_matrix":' * 100_000,
    "toml": "matrix = " + "[" * 100_000,
}


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_calibrations(kind: str, tmp_path: Path, run: Fuzzer) -> None:
    path = tmp_path / "given.yml"
    path.write_text(CALIBRATIONS[kind])
    outcome = run.read("calibration", path)
    assert outcome.fault((1,)) is None, (outcome.fault((1,)), outcome.said)
    assert "given.yml" in outcome.said and "root:" not in outcome.said and outcome.peak_mb < LITTLE_MB


SCENES = {
    "aliases": "name: x\na: &a [1,1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{','.join([f'*{chr(97 + n)}'] * 10)}]\n" for n in range(9)),
    "alias of itself": "name: x\ncapture: &a {static: *a}\n",
    "depth": "name: " + "[" * 100_000,
    "depth, closed": "name: " + "[" * 5000 + "]" * 5000,
    "length": "name: x\n" + "# comment\n" * 200_000,
    "many keys": "\n".join(f"k{n}: {n}" for n in range(16_000)),
}


@pytest.mark.parametrize("kind", SCENES)
def test_scene_files(kind: str, tmp_path: Path, run: Fuzzer) -> None:
    (tmp_path / "scene.yaml").write_text(SCENES[kind])
    refused(run, 2, "scene.yaml", arguments=("run", tmp_path, "--dry-run"))


def test_values_of_the_command_line(tmp_path: Path, run: Fuzzer) -> None:
    scene = scene_yaml(tmp_path, capture={"static": "gone.mp4"})
    for value in ("[" * 5000, "2020-13-45", "!!int ''", "&a [*a]", "!!python/object/apply:os.getpid []"):
        refused(run, 2, "--set", arguments=("run", scene, "--dry-run", "--set", f"reconstruct.rays={value}"))


def test_the_limits_themselves(tmp_path: Path) -> None:
    """What is just within is not refused."""
    path = tmp_path / "a"
    limits.check_pixels(path, 25_000, 10_000)
    limits.check_span(path, float(limits.CLIP_S))
    path.write_bytes(b"12345")
    limits.check_bytes(path, 5)
    for code, refuse in (
        ("picture-too-large", lambda: limits.check_pixels(path, 25_000, 10_001)),
        ("file-damaged", lambda: limits.check_pixels(path, 0, 5)),
        ("clip-too-long", lambda: limits.check_span(path, limits.CLIP_S + 0.1)),
        ("clip-too-long", lambda: limits.check_span(path, float("nan"))),
        ("file-too-large", lambda: limits.check_bytes(path, 4)),
    ):
        with raises(code, path):
            refuse()
