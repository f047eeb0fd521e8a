"""What a run works on, as far as it is known before: sizes and numbers of pictures, from headers alone.

Once `ingest` and `scene` are made their own files are read, which know better.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal

from devrf.capture.errors import DevrfError
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.frames import SWEEP, FrameSet, Role
from devrf.capture.ingest import MAX_BOARD_FRAMES, MAX_JOINT_FRAMES, MAX_SWEEP_FRAMES
from devrf.capture.pictures import list_pictures, probe_picture
from devrf.capture.raw import is_raw
from devrf.capture.scene import Scene, image_scale_for
from devrf.capture.session import CaptureSession
from devrf.capture.video import VideoInfo, probe_video
from devrf.pipelines.capture_session import capture_session
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.configured_dataset import configured_dataset
from devrf.pipelines.stages.scene import MAX_PIXELS, auto_image_scale

TRAINED = ("canonical", "deformation")  # stages that train

# Bytes on disk for each pixel of a picture
STORED = 0.4  # out of a clip: 0.22 to 0.36 at 1080p (docs/ingest.md)
DEVELOPED = 2.0  # of a developed RAW photo, a PNG: 3 bytes of colour, of which it saves a third
USUAL_FPS = 30.0  # where a file announces neither the number of its pictures nor their rate
UNKNOWN_S = 60.0  # length of a clip that announces none


@dataclass(frozen=True)
class Source:
    """A clip or a folder of photos.

    Attributes:
        role: What it shows.
        kind: How its pictures come.
        width, height: Of its pictures, pixels.
        pictures: In the file.
        used: That `ingest` keeps.
        bits: Of a colour of a stored picture: 8, or more.
        bytes_each: Of a kept picture on disk.
        sound_s: Length of its sound, seconds; 0 without.
    """

    role: Role
    kind: Literal["clip", "photos", "raw"]
    width: int
    height: int
    pictures: int
    used: int
    bytes_each: float
    bits: int = 8
    sound_s: float = 0.0

    @property
    def pixels(self) -> int:
        """Of a picture."""
        return self.width * self.height


@dataclass(frozen=True)
class Trained:
    """A trained model, as its metrics.json has it.

    Attributes:
        vertices: Of the finest grid; of the motion at one key time.
        keys: Key times of the motion.
        channels: Features of a vertex at rest.
        around: Vertices along an axis of the surroundings.
    """

    vertices: int
    keys: int
    channels: int
    around: int


@dataclass(frozen=True)
class Material:
    """All that a run works on.

    Attributes:
        sources: Name -> clip or folder; empty for data sets.
        at_rest, in_motion: Pictures that the scene consists of, without those of test cameras.
        tested: Test pictures.
        pixels: Of a picture as the model is trained on it.
        full_pixels: Of the largest picture of a moving camera as it is.
        cameras: Cameras that are trained on.
        scene: The finished scene, where it is known.
        trained: Stage -> what it has trained, where that is finished.
    """

    sources: Mapping[str, Source]
    at_rest: int
    in_motion: int
    tested: int
    pixels: int
    full_pixels: int
    cameras: int
    scene: Scene | None = None
    trained: Mapping[str, Trained] = field(default_factory=dict)

    @property
    def sweep(self) -> Source | None:
        """The sweep."""
        return self.sources.get(SWEEP)


def find_material(
    config: SceneConfig, scene_dir: Path, run_dir: Path, anew: Collection[str] = ()
) -> Material:
    """Look at headers, or at what finished stages found.

    Args:
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        run_dir: The run folder.
        anew: Stages that are about to run: what they left before says nothing of what they will.
    Raises:
        DevrfError: A raw file or data set cannot be read.
    """
    sources = {} if config.dataset is not None else find_sources(config, scene_dir, run_dir, anew)
    scene = None if "scene" in anew else _finished_scene(run_dir)
    if scene is None and config.dataset is not None:
        scene = configured_dataset(config, scene_dir)
    found = planned_material(config, sources) if scene is None else _of_scene(config, scene, sources)
    made = {stage: _trained(run_dir / stage) for stage in TRAINED if stage not in anew}
    return replace(found, trained={stage: model for stage, model in made.items() if model is not None})


def planned_material(config: SceneConfig, sources: Mapping[str, Source]) -> Material:
    """What the scene will consist of, by its sources."""
    moving = [source for source in sources.values() if source.role == "camera"]
    tested = [source for source in sources.values() if source.role == "test"]
    sweep = sources.get(SWEEP)
    at_rest = 0 if sweep is None else sweep.used
    held_out = -(-at_rest // config.evaluate.holdout_every)
    seen = [*moving, *tested, *([] if sweep is None else [sweep])]
    largest = max(seen, key=lambda source: source.pixels)
    scale = config.reconstruct.image_scale or image_scale_for(
        largest.width, largest.height, MAX_PIXELS[config.preset]
    )
    return Material(
        sources,
        at_rest - held_out,
        sum(source.used for source in moving),
        sum(source.used for source in tested) + held_out,
        int(largest.pixels * scale**2),
        max((source.pixels for source in (*moving, *tested)), default=0),
        len(moving),
    )


def _of_scene(config: SceneConfig, scene: Scene, sources: Mapping[str, Source]) -> Material:
    scale = scene.image_scale if scene.image_scale < 1 else auto_image_scale(config, scene.frames)
    moving = [f for f in scene.dynamic if f.split == "train"]
    return Material(
        sources,
        sum(f.split == "train" for f in scene.static),
        len(moving),
        sum(f.split == "test" for f in scene.frames),
        int(max(f.camera.width * f.camera.height for f in scene.frames) * scale**2),
        max((f.camera.width * f.camera.height for f in scene.dynamic), default=0),
        len({f.camera_name for f in moving}),
        replace(scene, image_scale=scale),
    )


def _finished_scene(run_dir: Path) -> Scene | None:
    try:
        return read_scene(run_dir / "scene")
    except (DevrfError, OSError):
        return None


def _trained(folder: Path) -> Trained | None:
    try:
        found = json.loads((folder / "metrics.json").read_text())
        x, y, z = map(int, found["grid"])
        options = found["options"]
        numbers = (found.get("keys", 0), options.get("channels", 0), options.get("shell_resolution", 0))
        return Trained(x * y * z, *map(int, numbers))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
        return None


def find_sources(
    config: SceneConfig, scene_dir: Path, run_dir: Path, anew: Collection[str] = ()
) -> dict[str, Source]:
    """Every clip and folder of photos, by the name that it has in the ingest folder; arguments as `find_material`'s.

    Raises:
        DevrfError: One cannot be read.
    """
    session = capture_session(config, scene_dir)
    try:
        frames = None if "ingest" in anew else FrameSet.read(run_dir / "ingest")
    except (DevrfError, OSError):
        frames = None
    sources = {}
    for name, path, role, most in _files(session):
        found = _photos(path, role, session) if path.is_dir() else _clip(path, role, most, session)
        known = None if frames is None else frames.cameras.get(name)
        if known is not None and known.used:
            files = [run_dir / "ingest" / frame.file for frame in known.used[:20] if frame.file is not None]
            sizes = [file.stat().st_size for file in files if file.is_file()]
            each = sum(sizes) / len(sizes) if sizes else found.bytes_each
            found = replace(found, used=len(known.used), bytes_each=each)
        sources[name] = found
    return sources


def _files(session: CaptureSession) -> list[tuple[str, Path, Role, int | None]]:
    """Name in the ingest folder, file, role, and the most pictures that are kept."""
    found: list[tuple[str, Path, Role, int | None]] = []
    if session.static is not None:
        found.append((SWEEP, session.static, "sweep", MAX_SWEEP_FRAMES))
    for name, path in session.cameras.items():
        found.append((name, path, "test" if name in session.test_names else "camera", None))
    for name, path in session.board_clips.items():
        found.append((f"board_{name}", path, "board", MAX_BOARD_FRAMES))
    for name, path in session.joint_clips.items():
        if not session.shares_joint_clip(name):
            found.append((f"joint_{name}", path, "joint", MAX_JOINT_FRAMES))
    return found


def _clip(path: Path, role: Role, most: int | None, session: CaptureSession) -> Source:
    info = _header(path, path.stat().st_mtime_ns if path.is_file() else 0)
    length_s = info.duration_s or UNKNOWN_S
    count = info.announced_frames or max(1, round(length_s * (info.fps or USUAL_FPS)))
    used = count if most is None else min(count, most)
    if most is None and session.range_s is not None:
        from_s, to_s = session.range_s
        used = min(count, max(1, round(count * (to_s - from_s) / max(length_s, 1e-3))))
    sound_s = length_s if info.has_audio and role in ("camera", "test", "joint") else 0.0
    stored = STORED * info.width * info.height
    return Source(role, "clip", info.width, info.height, count, used, stored, info.bits, sound_s)


@cache
def _header(path: Path, mtime_ns: int) -> VideoInfo:
    """What a clip says of itself: asked for before every stage, read once."""
    return probe_video(path)


def _photos(folder: Path, role: Role, session: CaptureSession) -> Source:
    photos = list_pictures(folder)
    first = probe_picture(photos[0])
    pixels = first.width * first.height
    raw = is_raw(photos[0])
    each = sum(photo.stat().st_size for photo in photos) / len(photos)
    if raw:
        each = DEVELOPED * pixels
    most = len(photos) if role == "sweep" else MAX_BOARD_FRAMES
    count = len(photos)
    return Source(role, "raw" if raw else "photos", first.width, first.height, count, min(count, most), each)
