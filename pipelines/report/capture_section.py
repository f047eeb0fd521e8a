"""What cameras recorded: a few of their pictures, with their mattes, and as they are used after colour correction."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from devrf.capture.frames import SWEEP
from devrf.capture.scene import PosedFrame, by_camera, read_matte
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.spread import spread
from devrf.pipelines.report.data_uris import file_uri, picture_uri, read_picture, shrink
from devrf.pipelines.report.run_reader import RunFolder

INGEST = "ingest/ingest.json"
WIDTH, HALVES_WIDTH = 200, 380
OF_SWEEP, OF_CAMERA = 8, 3  # pictures
MAX_CAMERAS = 12  # keeps the page small for a capture of forty cameras
DIMMED = 0.25  # of its brightness, under a tint that no picture has all over
TINT = np.array([0, 90, 60], np.float32)

Reel = tuple[str, list[tuple[str, str]]]  # name of a camera, and its pictures with their captions


def capture(run: RunFolder) -> dict[str, Any]:
    """Pictures of cameras those that filmed the scene, of boards, and with mattes."""
    cameras = run.cameras(INGEST)
    boards = {n: c for n, c in cameras.items() if c.get("role") in ("board", "joint")}
    filmed = {n: c for n, c in cameras.items() if n not in boards}
    static, dynamic = (run.scene.static, run.scene.dynamic) if run.scene is not None else ((), ())
    from_scene = _reels(static, OF_SWEEP, _posed) + _reels(dynamic, OF_CAMERA, _posed)
    matted = [frame for frame in (*static, *dynamic) if frame.matte is not None]
    return {
        "filmed": _ingested(run, filmed) if cameras else from_scene,
        "boards": _ingested(run, boards),
        "mattes": _reels(matted, OF_CAMERA, _dimmed),
    }


def colours(run: RunFolder) -> dict[str, Any]:
    """The first picture of each corrected camera: its left half as filmed, its right half as it is used."""
    frames = [] if run.scene is None else [f for f in run.scene.dynamic if f.look is not None]
    return {"SWEEP": SWEEP, "halves": _reels(frames, 1, _halves)}


def _ingested(run: RunFolder, cameras: dict[str, Any]) -> list[Reel]:
    """Pictures that stage ingest left."""
    reels: list[Reel] = []
    for name, camera in list(cameras.items())[:MAX_CAMERAS]:
        frames = [f for f in camera.get("frames") or [] if f.get("file")]
        some = spread(frames, OF_SWEEP if camera.get("role") == "sweep" else OF_CAMERA)
        files = [run.folder("ingest") / f["file"].removeprefix("ingest/") for f in some]
        captions = [_caption(f.get("index"), f.get("time_s")) for f in some]
        reels.append(
            (name, [(file_uri(file, WIDTH), said) for file, said in zip(files, captions, strict=True)])
        )
    return reels


def _reels(
    frames: Iterable[PosedFrame], most: int, shown: Callable[[PosedFrame], tuple[str, str]]
) -> list[Reel]:
    """Of each camera some of its frames, evenly spread."""
    some = list(by_camera(frames).items())[:MAX_CAMERAS]
    return [(name, [shown(frame) for frame in spread(of_camera, most)]) for name, of_camera in some]


def _posed(frame: PosedFrame) -> tuple[str, str]:
    return file_uri(frame.path, WIDTH), _caption(frame.index, frame.time_s)


def _halves(frame: PosedFrame) -> tuple[str, str]:
    picture = read_picture(frame.path)
    if picture is None or frame.look is None:
        return "", ""
    middle = picture.shape[1] // 2
    halves = np.concatenate([picture[:, :middle], frame.look.apply(picture)[:, middle:]], axis=1)
    return picture_uri(halves, HALVES_WIDTH), "left as filmed, right as used"


def _dimmed(frame: PosedFrame) -> tuple[str, str]:
    """The picture, small, what is not the subject dimmed."""
    picture = read_picture(frame.path)
    if picture is None or frame.matte is None:
        return "", ""
    try:
        matte = read_matte(frame.matte, picture.shape[:2])
    except CaptureError:
        return "", ""
    small, opacity = (shrink(p, WIDTH).astype(np.float32) for p in (picture, matte))
    shown = opacity[..., None] / 255
    dimmed = shown * small + (1 - shown) * (DIMMED * small + TINT)
    return picture_uri(dimmed.round().clip(0, 255).astype(np.uint8), WIDTH), f"matte, frame {frame.index}"


def _caption(index: object, time_s: object) -> str:
    return f"frame {index}" + (f", {time_s:.3f} s" if isinstance(time_s, (int, float)) else "")
