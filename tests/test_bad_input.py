"""Bad input through the real command line: which exit code, what is said, and that nothing made is lost.

The inputs are made here: a corner of a room whose three walls are textured planes, drawn by homographies.
"""

import json
import os
import re
import shutil
import subprocess
import threading
import wave
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from tests.refused import refused
from tests.waiting import wait_for

from devrf.capture.system.errors import InputError
from devrf.capture.video.reader import probe_video
from devrf.capture.video.video_writer import write_video
from devrf.capture.view_axes import look_at

SIZE = (320, 240)
K = np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
SWEEP_FRAMES = 14
CLIP_FRAMES = 12


# --- drawing ---


def texture(rng: np.random.Generator, side: int = 700) -> np.ndarray:
    """Noise of many sizes: every place looks different from near and from far."""
    picture = np.zeros((side, side, 3))
    for cells in (6, 18, 50, 140, 350):
        noise = rng.random((cells, cells, 3))
        picture += cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    picture -= picture.min()
    return (255 * picture / picture.max()).astype(np.uint8)


def draw(textures: list[np.ndarray], centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The corner of three walls (planes x = 0, y = 0, z = 0, sides of 2 m) seen from a place, z up."""
    rotation = look_at(centre, target)[:, :3]
    picture = np.full((SIZE[1], SIZE[0], 3), 127, np.uint8)
    axes = np.eye(3) * 2.0
    for n, image in enumerate(textures):
        u, v = axes[(n + 1) % 3], axes[(n + 2) % 3]
        side = image.shape[0]
        plane = np.column_stack([u / side, v / side, np.zeros(3)])
        H = K @ (rotation @ plane - np.outer(rotation @ centre, [0, 0, 1]))
        ones = np.full((side, side), 255, np.uint8)
        wall = cv2.warpPerspective(image, H, SIZE, flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(ones, H, SIZE, flags=cv2.INTER_NEAREST) > 0
        picture[inside] = wall[inside]
    return picture


def places(count: int) -> list[np.ndarray]:
    """Camera centres on an arc before the corner, at changing height."""
    angles = np.radians(np.linspace(22, 68, count))
    heights = 1.6 + 0.35 * np.sin(np.linspace(0, 6, count))
    return [np.array([2.6 * np.cos(a), 2.6 * np.sin(a), h]) for a, h in zip(angles, heights, strict=True)]


def clip(path: Path, pictures: list[np.ndarray], fps: float = 10.0, sound: bool = True) -> None:
    """An mp4, with a second track of noise and one click where it is to have sound."""
    write_video(path, pictures, fps)
    if not sound:
        return
    silent = path.with_suffix(".silent.mp4")
    path.rename(silent)
    rate, rng = 48_000, np.random.default_rng(len(path.name))
    samples = rng.normal(0, 200, int(rate * len(pictures) / fps))
    samples[rate // 3 : rate // 3 + 900] += rng.normal(0, 12_000, 900)
    with av.open(str(silent)) as source, av.open(str(path), "w") as target:
        video = source.streams.video[0]
        copy = target.add_stream_from_template(video)
        audio = target.add_stream("aac", rate=rate, layout="mono")
        for packet in source.demux(video):
            if packet.dts is not None:
                packet.stream = copy
                target.mux(packet)
        frame = av.AudioFrame.from_ndarray(
            samples.clip(-32_000, 32_000).astype(np.int16)[None], format="s16", layout="mono"
        )
        frame.sample_rate = rate
        target.mux(audio.encode(frame))
        target.mux(audio.encode(None))
    silent.unlink()


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good sweep and two good clips of the corner, and material that is wrong in one way each."""
    folder = tmp_path_factory.mktemp("material")
    rng = np.random.default_rng(0)
    walls = [texture(rng) for _ in range(3)]
    target = np.array([0.35, 0.35, 0.6])
    clip(folder / "sweep.mp4", [draw(walls, place, target) for place in places(SWEEP_FRAMES)], sound=False)
    for name, place in (("cam0", places(7)[2]), ("cam1", places(7)[4])):
        view = draw(walls, place, target)
        frames = []
        for n in range(CLIP_FRAMES):
            frame = view.copy()
            cv2.circle(frame, (90 + 10 * n, 140), 18, (230, 60, 40), -1)
            frames.append(frame)
        clip(folder / f"{name}.mp4", frames)
        clip(folder / f"silent_{name}.mp4", frames, sound=False)
    blank = [np.full((SIZE[1], SIZE[0], 3), 200 + n % 3, np.uint8) for n in range(SWEEP_FRAMES)]
    clip(folder / "blank.mp4", blank, sound=False)
    elsewhere = [texture(rng)[: SIZE[1], : SIZE[0]]] * CLIP_FRAMES
    clip(folder / "elsewhere.mp4", elsewhere)
    (folder / "text.mp4").write_text("This is no video.\n" * 50)
    (folder / "empty.mp4").write_bytes(b"")
    whole = (folder / "cam1.mp4").read_bytes()
    (folder / "truncated.mp4").write_bytes(whole[: len(whole) // 2])
    long = [texture(np.random.default_rng(n))[: SIZE[1], : SIZE[0]] for n in range(6)]
    clip(folder / "long.mp4", long, sound=False)
    bytes_ = (folder / "long.mp4").read_bytes()  # its index is in front: it opens, and then ends
    (folder / "ends_early.mp4").write_bytes(bytes_[: len(bytes_) * 2 // 3])
    only_sound(folder / "only_sound.mp4")
    return folder


def only_sound(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=48_000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 48_000), np.int16), format="s16", layout="mono")
        frame.sample_rate = 48_000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def scene(folder: Path, material: Path, **capture: object) -> Path:
    """scene.yaml of a capture of the corner; `capture` replaces or adds keys, None removes."""
    cameras = {name: str(material / f"{name}.mp4") for name in ("cam0", "cam1")}
    given = {"static": str(material / "sweep.mp4"), "cameras": cameras} | capture
    keys = {key: value for key, value in given.items() if value is not None}
    value = {"name": "corner", "output": str(folder / "run"), "preset": "tiny", "capture": keys}
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(value))
    return path


def cameras(material: Path, second: str) -> dict[str, str]:
    return {"cam0": str(material / "cam0.mp4"), "cam1": str(material / second)}


# --- seen before anything is started: 2 ---


@pytest.mark.parametrize(
    ("name", "refusal"),
    [
        ("gone.mp4", "file-missing"),
        ("text.mp4", "file-is-text"),
        ("empty.mp4", "file-empty"),
        ("truncated.mp4", "file-cut-short"),
        ("only_sound.mp4", "video-missing"),
    ],
)
def test_a_clip_that_is_none(
    devrf: Callable, tmp_path: Path, material: Path, name: str, refusal: str
) -> None:
    result = devrf("run", scene(tmp_path, material, cameras=cameras(material, name)))
    assert result.code == 2, result.said
    with refused(refusal, name, kind=InputError) as why:
        probe_video(material / name)
    if name == "gone.mp4":  # seen as the configuration is read
        assert f"capture.cameras.cam1: '{material / name}': " in result.err
        assert "[configuration]" in result.err
    else:
        assert f"cam1: {why.value} [inputs-unusable]" in result.err
    assert "Traceback" not in result.said
    assert not (tmp_path / "run" / "ingest").exists()


def test_all_wrong_clips_at_once(devrf: Callable, tmp_path: Path, material: Path) -> None:
    wrong = {"cam0": str(material / "text.mp4"), "cam1": str(material / "only_sound.mp4")}
    result = devrf("run", scene(tmp_path, material, cameras=wrong, static=str(material / "empty.mp4")))
    assert result.code == 2
    assert all(name in result.err for name in ("text.mp4", "only_sound.mp4", "empty.mp4")), result.err


def test_misspelt_unknown_and_out_of_range_keys(devrf: Callable, tmp_path: Path, material: Path) -> None:
    path = scene(tmp_path, material)
    path.write_text(path.read_text() + "reconstruct: {resolutoin: 160, rays: -5}\nfrobnicate: 1\n")
    result = devrf("run", path)
    assert result.code == 2
    assert re.search(r"scene\.yaml: reconstruct\.resolutoin: .*\bresolution\b", result.err)
    assert "scene.yaml: reconstruct.rays: -5; " in result.err
    assert "scene.yaml: frobnicate: " in result.err and "[configuration]" in result.err


def test_a_board_no_marker_of_which_exists(devrf: Callable, tmp_path: Path, material: Path) -> None:
    board = {"squares": [8, 6], "square_m": 0.06, "marker_m": 0.045, "dictionary": "DICT_4X4_77"}
    result = devrf("run", scene(tmp_path, material, board=board))
    assert result.code == 2 and not (tmp_path / "run" / "ingest").exists()
    assert re.search(r"DICT_4X4_77\b.*DICT_4X4_[15].*\[inputs-unusable\]", result.err)


def test_joint_clips_of_some_cameras_without_a_sweep(devrf: Callable, tmp_path: Path, material: Path) -> None:
    clip = str(material / "elsewhere.mp4")
    board = {"squares": [8, 6], "square_m": 0.06, "marker_m": 0.045, "joint_clips": {"cam0": clip}}
    path = scene(tmp_path, material, board=board, cameras={"cam0": clip, "cam1": clip}, static=None)
    result = devrf("run", path)
    assert result.code == 2
    assert re.search(r"capture\.board\.joint_clips: .*\bcam1\b.*\[configuration\]", result.err)


def test_an_output_that_cannot_be_written(devrf: Callable, tmp_path: Path, material: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    output = tmp_path / "file" / "run"
    result = devrf("run", scene(tmp_path, material), "--set", f"output={output}", "--until", "ingest")
    assert result.code == 2
    assert str(output) in result.err and "output:" in result.err and "[folder-unwritable]" in result.err


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator may write anywhere"
)
def test_an_output_without_permission(devrf: Callable, tmp_path: Path, material: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    result = devrf("run", scene(tmp_path, material), "--set", f"output={tmp_path / 'locked' / 'run'}")
    assert result.code == 2 and str(tmp_path / "locked") in result.err and "[folder-unwritable]" in result.err


# --- found while a stage runs: 1, or 3 where the material itself is at fault ---


def test_a_clip_that_ends_early(devrf: Callable, tmp_path: Path, material: Path) -> None:
    """Its index promises more than there is: never taken for whole."""
    path = scene(tmp_path, material, cameras=cameras(material, "ends_early.mp4"))
    result = devrf("run", path, "--until", "ingest")
    assert result.code == 1, result.said
    assert re.search(r"ends_early\.mp4 .*\b[1-6]\b.*\[clip-too-damaged\]", result.err)
    assert "Traceback" not in result.said


@pytest.mark.full
def test_clips_without_sound_fall_back_to_motion(devrf: Callable, tmp_path: Path, material: Path) -> None:
    silent = {name: str(material / f"silent_{name}.mp4") for name in ("cam0", "cam1")}
    path = scene(tmp_path, material, cameras=silent)
    result = devrf("run", path, "--until", "sync", "--allow-unhealthy")
    assert result.code in (0, 3), result.said
    assert "(cam1)" in result.said and "calibration.sync.method" in result.said
    sync = json.loads((tmp_path / "run" / "sync" / "sync.json").read_text())
    assert sync["cameras"]["cam1"]["method"] != "audio"


def test_clips_without_sound_that_are_to_be_heard(devrf: Callable, tmp_path: Path, material: Path) -> None:
    path = scene(tmp_path, material, cameras=cameras(material, "silent_cam1.mp4"))
    result = devrf("run", path, "--set", "calibration.sync.method=audio")
    assert result.code == 2 and not (tmp_path / "run" / "ingest").exists(), result.said
    assert re.search(
        r"calibration\.sync\.method: .*\bcam1 \(.*/silent_cam1\.mp4\).*\[inputs-unusable\]", result.err
    )


def deaf(source: Path, path: Path) -> None:
    """A copy whose sound track is noise that no decoder takes."""
    rng = np.random.default_rng(0)
    with av.open(str(source)) as given, av.open(str(path), "w") as copy:
        streams = {s.index: copy.add_stream_from_template(s) for s in given.streams}
        for packet in given.demux():
            if packet.dts is None:
                continue
            new = av.Packet(rng.bytes(packet.size)) if packet.stream.type == "audio" else packet
            new.pts, new.dts, new.time_base = packet.pts, packet.dts, packet.time_base
            new.stream = streams[packet.stream.index]
            copy.mux(new)


@pytest.mark.full
def test_sound_that_does_not_decode_is_left_out(devrf: Callable, tmp_path: Path, material: Path) -> None:
    """Where it is asked for, what is proposed instead leads on."""
    deaf(material / "cam1.mp4", tmp_path / "deaf.mp4")
    path = scene(tmp_path, material, static=None, cameras=cameras(material, str(tmp_path / "deaf.mp4")))
    rig = {
        "width": SIZE[0],
        "height": SIZE[1],
        "K": [[300, 0, SIZE[0] / 2], [0, 300, SIZE[1] / 2], [0, 0, 1]],
    }
    poses = {f"cam{n}": rig | {"cam_from_world": np.eye(4)[:3].tolist()} for n in range(2)}
    poses["cam1"]["cam_from_world"][0][3] = 1.0
    (tmp_path / "rig.json").write_text(json.dumps({"cameras": poses, "scale": {"metric": True}}))
    command = ["run", path, "--until", "sync", "--set", f"calibration.rig.given={tmp_path / 'rig.json'}"]
    asked = devrf(*command, "--set", "calibration.sync.method=audio")
    assert asked.code == 1 and re.search(
        r"\bcam1\b.* calibration\.sync\.method .*motion.*\[sound-missing\]", asked.err
    )
    camera = json.loads((tmp_path / "run" / "ingest" / "ingest.json").read_text())["cameras"]["cam1"]
    assert [f["code"] for f in camera["faults"]] == ["not-used"] and "decode" in camera["faults"][0]["value"]
    for method in ("auto", "flash", "motion"):
        done = devrf(*command, "--set", f"calibration.sync.method={method}")
        assert done.code in (0, 3) and "sound-missing" not in done.said, done.said


def test_a_range_outside_the_table_of_times(devrf: Callable, tmp_path: Path, material: Path) -> None:
    rows = [f"{name},{n},{40 + n / 10}" for name in ("cam0", "cam1") for n in range(CLIP_FRAMES)]
    (tmp_path / "times.csv").write_text("\n".join(["camera,frame_index,time_s", *rows]))
    path = scene(tmp_path, material, timestamps=str(tmp_path / "times.csv"), range_s=[0, 1])
    result = devrf("run", path)
    assert result.code == 2 and not (tmp_path / "run" / "ingest").exists(), result.said
    assert re.search(
        r"capture\.range_s: \[0, 1\]: .*\bcam1\b.* 40\.00 .* 41\.10 s.*\[inputs-unusable\]", result.err
    )


@pytest.mark.parametrize("range_s", [[50, 60], [-9, -2]])
def test_a_range_outside_the_first_clip(
    devrf: Callable, tmp_path: Path, material: Path, range_s: list[float]
) -> None:
    path = scene(tmp_path, material, range_s=range_s)
    for command in (["run", path, "--dry-run"], ["check", path]):
        result = devrf(*command)
        assert result.code == 2, result.said
        named = f"capture.range_s: {range_s}: ", "cam0", " 0.00 ", f" {(CLIP_FRAMES - 1) / 10:.2f} s"
        assert all(name in result.err for name in (*named, "[inputs-unusable]")), result.err
    overlaps = devrf("run", scene(tmp_path, material, range_s=[0.5, 60]), "--dry-run")
    assert overlaps.code == 0, overlaps.said


def test_a_blank_wall_cannot_be_registered(devrf: Callable, tmp_path: Path, material: Path) -> None:
    path = scene(tmp_path, material, static=str(material / "blank.mp4"), cameras=None)
    result = devrf("run", path, "--until", "static_poses")
    assert result.code == 3, result.said
    assert result.err.startswith("static_poses: ") and f"0 of {SWEEP_FRAMES} " in result.err
    assert "[sweep-unregistered]" in result.err
    assert (tmp_path / "run" / "ingest" / "stamp.json").exists()


@pytest.mark.full
def test_a_board_that_is_never_seen(devrf: Callable, tmp_path: Path, material: Path) -> None:
    board = {
        "squares": [8, 6],
        "square_m": 0.06,
        "marker_m": 0.045,
        "clips": {"cam0": str(material / "elsewhere.mp4")},
    }
    path = scene(tmp_path, material, board=board)
    result = devrf("run", path, "--until", "rig")
    assert result.code == 3, result.said
    assert "'cam0'" in result.err and "capture.board" in result.err and f"0 of {CLIP_FRAMES} " in result.err
    assert "[board-never-seen]" in result.err


@pytest.mark.full
def test_a_camera_that_shares_no_view_with_the_sweep(devrf: Callable, tmp_path: Path, material: Path) -> None:
    path = scene(tmp_path, material, cameras=cameras(material, "elsewhere.mp4"))
    settings = ("--set", "calibration.sync.method=none", "--set", "capture.rest=start")
    result = devrf("run", path, "--until", "rig", *settings)
    assert result.code == 3, result.said
    few = re.search(r"^rig: .*\bcam1\b.* (\d+) inliers, need 30 ", result.err)  # chance agrees on some
    assert few is not None and int(few[1]) < 10 and "[rig-unlinked-camera]" in result.err
    assert (tmp_path / "run" / "static_poses" / "stamp.json").exists() and "capture.cameras" in result.err
    without = scene(tmp_path, material, cameras={"cam0": str(material / "cam0.mp4")})  # as is proposed
    assert devrf("run", without, "--until", "rig", *settings).code == 0


# --- a full disk ---


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 60 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    command = [str(mount), "-t", "tmpfs", "-o", "size=60m", "tmpfs", str(folder)]
    if mount is None or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("a small disk can be mounted only by the administrator")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], capture_output=True)


def fill(folder: Path) -> None:
    """Leave no room on a disk."""
    with (folder / "filler").open("wb") as file:
        try:
            while file.write(b"0" * 65536):
                file.flush()
        except OSError:
            pass


@pytest.mark.full
def test_a_full_disk(devrf: Callable, tmp_path: Path, material: Path, small_disk: Path) -> None:
    """Found before the start, or while a stage writes: folder and remedy are named, what was made is kept."""
    path, run_dir = scene(tmp_path, material), small_disk / "run"
    run = ("run", path, "--set", f"output={run_dir}", "--until")
    assert devrf(*run, "ingest").code == 0

    def fill_while_it_writes() -> None:
        wait_for(lambda: list(run_dir.glob(".new-static_poses-*")))
        fill(small_disk)

    filler = threading.Thread(target=fill_while_it_writes, daemon=True)
    filler.start()
    writing = devrf(*run, "static_poses")
    filler.join()
    before = devrf(*run, "static_poses")
    assert (writing.code, before.code) == (1, 1), writing.said + before.said
    for result in (writing, before):
        assert str(small_disk) in result.err and "[disk-full]" in result.err
        assert "Traceback" not in result.said
    assert (run_dir / "ingest/stamp.json").exists() and not list(run_dir.glob(".new-*"))
    (small_disk / "filler").unlink()
    again = devrf(*run, "static_poses")
    assert again.code == 0 and "ingest: skipped" in again.out, again.said


def test_wave_files_are_not_videos(devrf: Callable, tmp_path: Path, material: Path) -> None:
    path = tmp_path / "sound.wav"
    with wave.open(str(path), "wb") as file:
        file.setparams((1, 2, 8000, 0, "NONE", ""))
        file.writeframes(b"\0\0" * 800)
    result = devrf("run", scene(tmp_path, material, static=str(path), cameras=None))
    assert result.code == 2 and "sound.wav" in result.err
